"""What needs neither SocketCAN nor a call of POSIX works where those are hidden, and what needs them says so.

`other_system` imitates Windows in a child process. What is asked for here runs there as a user would type it.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from network_buses import group  # noqa: F401

IMITATION = Path(__file__).parents[1] / "support" / "other_system"
FAULT = "this is a fault of canprobe itself"


def environment() -> dict[str, str]:
    """Environment of a process on the imitated system."""
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(IMITATION), *sys.path]), "PYTHONIOENCODING": "cp1252"}
    env.pop("PYTEST_VERSION", None)
    return env


def typed(folder: Path, *words: str, program: tuple[str, ...] = ("-m", "canprobe")) -> tuple[int, str]:
    """Status and output of a command on the imitated system."""
    done = subprocess.run(
        [sys.executable, *program, *words], cwd=folder, env=environment(), capture_output=True, check=False, timeout=120
    )
    return done.returncode, (done.stdout + done.stderr).decode("cp1252")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run in `first`, and a scene with a bridge."""
    folder = tmp_path_factory.mktemp("there")
    (folder / "fed.toml").write_text('[scene]\nname = "fed"\n[task]\nkind = "free"\n[bridge]\nuse = ["mcap"]\n')
    quick = ("--set", "task.clearance_mm=0.3", "--set", "cycle.rate_hz=200", "--set", "shape.also=[]")
    status, said = typed(folder, "run", "cylinder", *quick, "--duration", "0.3", "--no-figures", "--out", "first")
    assert status == 0, said
    return folder


SHORT = ("--duration", "0.2", "--no-figures", "--out")
COMMANDS = (
    ("plan", "press"),
    ("run", "free", "--bus", "direct", *SHORT, "direct"),
    ("init", "cell", "--eds", "puma260_joint"),
    ("replay", "first"),
    ("judge", "--record", "first/bus.log", "cylinder"),
    ("adapters",),
    ("view", "first", "--html", "page.html"),
    ("move", "puma260", "--joint", "1", "--by", "1deg", "--yes"),
    ("check", "free"),
    ("tare", "puma260", "--yes"),
    ("schema", "scene"),
    ("eds", "list"),
)
ONE_BY_ONE = """
import json, sys
from canprobe.cli import main
sys.exit(next((number for number, words in enumerate(json.loads(sys.argv[1]), 1) if main(words) != 0), 0))
"""


def test_what_needs_no_posix_works_without_it(folder):
    failed, said = typed(folder, json.dumps(COMMANDS), program=("-c", ONE_BY_ONE))
    assert failed == 0, f"{COMMANDS[failed - 1]}: {said}"


MISSING = {
    "PCAN-Basic of peak-system.com is not installed": ("scan", "--bus", "pcan", "--channel", "PCAN_USBBUS1"),
    "canprobe replay FOLDER --bridge NAME": ("run", "free", "--bridge", "mcap", *SHORT, "fed"),
    "bridge mcap: its process is fed by a pipe": ("run", "fed.toml", *SHORT, "fed"),
    "no SocketCAN": ("up", "free", "--bus", "socketcan", "--channel", "can0"),
}
EACH = """
import contextlib, io, json, sys
from canprobe.cli import main
for words in json.loads(sys.argv[1]):
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(said):
        status = main(words)
    print(json.dumps((status, said.getvalue())))
"""


def test_what_is_missing_is_named(folder):
    _, answers = typed(folder, json.dumps([*MISSING.values()]), program=("-c", EACH))
    for says, answer in zip(MISSING, answers.splitlines(), strict=True):
        status, said = json.loads(answer)
        assert status in (2, 3) and says in said and FAULT not in said


class Beside:
    """A command on the imitated system, with pipes."""

    def __init__(self, *words: str) -> None:
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen([sys.executable, "-m", "canprobe", *words], env=environment(), **pipes)

    def send_break(self) -> None:
        """CTRL_BREAK, which stands for SIGWINCH in the imitation."""
        self.process.send_signal(signal.SIGWINCH)

    def type(self, line: str) -> None:
        self.process.stdin.write(line.encode() + b"\n")
        self.process.stdin.flush()

    def until(self, word: str) -> str:
        """The line with this word, which it prints."""
        for line in self.process.stdout:
            if word.encode() in line:
                return line.decode()
        pytest.fail(f"no {word}: {self.process.stderr.read().decode()}")

    def moves(self) -> None:
        """Let joint 1 of a console move."""
        self.type("enable")
        self.until("[yes, no]")
        self.type("yes")
        self.until('"state":"holds"')
        self.type("jog 1 +")
        self.until('"state":"moves"')


@pytest.mark.parametrize(("ends", "status"), [("quit", 0), ("input", 0), ("break", 143)])
def test_a_console_needs_no_posix(ends, status):
    """It ends by a word, by the end of its input, and by CTRL_BREAK."""
    console = Beside("console", "puma260", "--json")
    console.moves()
    if ends == "quit":
        console.type("quit")
    elif ends == "break":
        console.send_break()
        console.process.wait(timeout=60)  # before its input ends, too
    out, errors = console.process.communicate(timeout=60)
    assert (console.process.returncode, errors) == (status, b"")
    assert json.loads(out.splitlines()[-1]) == {"says": "stop and disable the drives"}


def test_a_console_ends_with_whoever_reads_it():
    console = Beside("console", "puma260", "--json")
    console.moves()
    console.process.stdout.close()
    console.process.wait(timeout=60)
    _, errors = console.process.communicate()
    assert (console.process.returncode, errors) == (0, b"")


def test_a_console_writes_in_the_encoding_of_its_terminal():
    console = Beside("console", "puma260", "--plain")
    console.type("where")
    out, errors = console.process.communicate(timeout=60)
    assert console.process.returncode == 0 and " ± " in out.decode("cp1252"), errors


def test_a_console_that_nobody_reads_does_what_is_typed_and_ends():
    """Its answers are more than a pipe holds."""
    console = Beside("console", "puma260", "--json")
    for line in (*["help"] * 100, "enable", "yes", "jog 1 +", "quit"):
        console.type(line)
    assert console.process.wait(timeout=60) == 0
    out, errors = console.process.communicate()
    assert out.count(b"print this list") < 100 and not errors


def test_a_bus_of_python_can_is_scanned_and_a_device_on_it_examined(folder, group):
    served = ("--bus", "udp_multicast", "--channel", group)
    device = Beside("emulate", "--eds", "puma260_joint", "--node-id", "5", *served)
    try:
        while b"serving" not in device.process.stderr.readline():
            assert device.process.poll() is None
        status, said = typed(folder, "scan", *served)
        assert status == 0 and "canprobe PUMA 260 joint" in said
        status, said = typed(
            folder, "conform", "--node", "5", "--eds", "puma260_joint", *served, "--points", "12", "--listen", "0.1"
        )
        assert status == 0 and "1 pass" in said
    finally:
        device.send_break()
    device.process.communicate(timeout=60)
    assert device.process.returncode == 143


def test_a_plan_says_what_its_system_cannot_do(folder):
    status, said = typed(folder, "plan", "fed.toml")
    assert status == 0 and "bridge mcap" in said and "a pipe that never waits, which this system lacks" in said
