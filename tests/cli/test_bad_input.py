"""What goes wrong on the command line, as a user sees it: one clear line a problem, the exit status, no traceback.

A signal, a stream, an encoding and one complaint are tried on processes; nothing here needs a CAN interface.
"""

import contextlib
import io
import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_for_size

from canprobe.cli import main
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.real.socketcan import has_socketcan
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of

ROOT = Path(__file__).parents[2]
NO_AF_CAN = pytest.mark.skipif(has_socketcan(), reason="this kernel has SocketCAN; the vcan tests cover it")


def start(folder, *words):
    """`canprobe` in a session of its own, so that a signal to it reaches nobody else."""
    command = [sys.executable, "-m", "canprobe", *map(str, words)]
    return subprocess.Popen(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def lines_of(folder, status, *words):
    """The lines on stderr of a command that must end with `status`; on stdout a plan says only that it does not fit."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        ended = main([*map(str, words)])
    assert ended == status, err.getvalue()
    assert out.getvalue() == "" or ("plan" in words and out.getvalue().endswith(": does not fit\n"))
    return err.getvalue().splitlines()


def test_a_tool_file_that_is_none(tmp_path):
    (tmp_path / "tool.toml").write_text("[probe]\nmass_kg = 1\n")
    (line,) = lines_of(tmp_path, 2, "run", "cylinder", "--tool", "tool.toml")
    assert "tool.toml: expected the section [probe] with centre_offset_mm, centre_lateral_mm" in line
    assert not (tmp_path / "runs").exists()


def test_a_folder_in_the_place_of_a_scene_is_told_with_the_files_in_it(tmp_path):
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "first.toml").write_text("")
    (line,) = lines_of(tmp_path, 2, "run", "cell")
    assert line == "canprobe: cell: is a folder; type the scene file in it: cell/first.toml"


def test_view_says_that_a_folder_was_possible_too(tmp_path):
    (line,) = lines_of(tmp_path, 2, "view", "nope", "--no-open")
    assert "no such scene, cell or file" in line and line.endswith("nor is there a folder of a run of that name")
    (line,) = lines_of(tmp_path, 2, "view", "press", "--set", "task.forc_n=3")
    assert "folder" not in line


@NO_AF_CAN
@pytest.mark.parametrize(
    "words",
    [
        ("run", "press", "--bus", "socketcan", "--channel", "can0", "--out", "results"),
        ("emulate", "press", "--channel", "can0"),
        ("scan",),
    ],
)
def test_no_socketcan_in_this_kernel(words, tmp_path):
    (line,) = lines_of(tmp_path, 3, *words)
    assert line.startswith("canprobe: can0: this kernel has no SocketCAN")
    assert list(tmp_path.iterdir()) == [], "a run that never had a bus leaves no folder"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("up", "press"), "a lockstep bus lives inside one run"),
        (("run", "press", "--duration", "1e9"), "duration_s: expected a number above 0 up to 86400, got 1000000000.0"),
        (("run", "press", "--channel", "ü x"), 'channel: expected text without spaces, in ASCII, got "ü x"'),
        (("plan", "press", "--set", "force"), "expected KEY=VALUE such as task.force_n=3, got 'force'"),
        (("run", "press", "--bus", ""), "argument --bus: expected a name"),
        (("run", "press", "--out", ""), "argument --out: expected a name"),
        (("scan", "--bus", "lockstep"), "lives inside one run"),
        (
            ("plan", "my arm.urdf"),
            "describes an arm, and no scene or cell file; type: canprobe init my-cell --urdf 'my",
        ),
        (("judge", "x.LOG"), "is a log of a bus, and no scene or cell file; type: canprobe replay x.LOG, or canprobe"),
        (("run", "drive.eds"), "describes a device, and no scene or cell file; type: canprobe conform --eds drive.eds"),
        (("conform", "drive.xdd"), "did you mean --eds drive.xdd?"),
        (("conform", "5"), "did you mean --node 5?"),
        (("init", "arm.urdf"), "DIR is the folder to write into; type: canprobe init my-cell --urdf arm.urdf"),
        (("run", "press", "--bus", "virtual", "--channel", "x"), "ends at the process"),
        (("run", "press", "--set", "sensor.eds=nowhere.eds"), "nowhere.eds"),
        (
            (
                *("run", "cylinder", "--set", "object.position_mm=[-0.5,-0.1225,0.374]"),
                "--set=task.start_mm=[-0.5,-0.1225,0.374]",
            ),
            "contact at (-0.5, -0.1, 0.4) mm (are these metres?) out of reach",
        ),
    ],
)
def test_wrong_use(words, text, tmp_path):
    (line,) = lines_of(tmp_path, 2, *words)
    assert text in line


@pytest.mark.parametrize(
    "words",
    [
        ("run", "listen", "--out", "file"),
        ("run", "listen", "--bus", "direct", "--out", "file/x"),
        ("plan", "press", "--export", "dcf", "--out", "file/x"),
        ("plan", "press", "--export", "dbc", "--out", "file"),
        ("plan", "press", "--figure", "file/x.png"),
        ("view", "listen", "--bus", "direct", "--html", "x.html", "--out", "file/x"),
        ("init", "file/x"),
        ("init", "file"),
        ("study", "estimators", "--quick", "--out", "file/x"),
        ("emulate", "press", "--bus", "virtual", "--channel", "x", "--truth", "file/x.npz"),
        ("emulate", "press", "--bus", "virtual", "--channel", "x", "--truth", "folder"),
        ("emulate", "press", "--bus", "virtual", "--channel", "x", "--store", "file"),
    ],
)
def test_every_output_that_cannot_be_written_has_the_same_status(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    assert main(words) == 3
    assert re.fullmatch(r"canprobe: (file|folder)\S*: cannot be written: [A-Z][a-z ]+\n", capsys.readouterr().err)


@pytest.mark.parametrize(
    "words",
    [
        ("plan", "/dev/zero"),
        ("plan", "cylinder", "--cell", "/dev/zero"),
        ("plan", "cylinder", "--set", "sensor.array=/dev/zero"),
        ("plan", "cylinder", "--set", "sensor.calibration=/dev/zero"),
        ("plan", "cylinder", "--set", "sensor.eds=/dev/zero"),
        ("plan", "cylinder", "--set", "arm.urdf=/dev/zero"),
        ("plan", "relief", "--set", "object.file=endless.csv"),
        ("plan", "cylinder", "--measured", "/dev/zero"),
        ("run", "cylinder", "--tool", "/dev/zero"),
        ("replay", "/dev/zero", "--scene", "cylinder"),
        ("emulate", "--bus-yml", "/dev/zero", "--channel", "vcan0"),
        ("emulate", "--eds", "/dev/zero", "--node-id", "3", "--channel", "vcan0"),
        ("eds", "check", "/dev/zero"),
        ("init", "new", "--urdf", "/dev/zero"),
    ],
)
def test_an_input_without_an_end_is_refused(words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("endless.csv")
    assert main(words) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "expected a regular file, got a device or a pipe" in line or "no such file" in line


def test_brackets_without_an_end(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["plan", "press", "--set", f"task.force_n={'[' * 500}"]) == 2
    assert "argument --set: expected KEY=VALUE, got one of too many brackets" in capsys.readouterr().err
    for text in ("[" * 500, "[" * 5000, f"{'[' * 100}{']' * 100}", f"{'{a = ' * 100}1{'}' * 100}"):
        (tmp_path / "deep.toml").write_text(f"x = {text}")
        assert main(["plan", "./deep.toml"]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        where = "" if text.startswith("[" * 500) else "x" + ".a" * 2 * text.startswith("{") + ": "
        assert line == f"canprobe: ./deep.toml: {where}expected tables and lists of at most 32 levels, got more of them"
    assert main(["plan", "press", "--set", f"{'.'.join('a' * 100)}=1"]) == 2
    assert "press.toml as changed: a.a.a: expected tables and lists of at most 32" in capsys.readouterr().err


def test_an_interrupted_run_stops_the_cell_and_keeps_its_files(tmp_path):
    quick = ("--set", "task.clearance_mm=0.1", "--set", "cycle.rate_hz=200")
    process = start(tmp_path, "run", "press", *quick, "--duration", "600", "--no-figures", "--out", "results")
    results = tmp_path / "results"
    wait_for_size(log := results / "bus.log", 3 << 17, process)  # in contact, by its volume
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert (process.returncode, out) == (130, "")
    assert err == "canprobe: interrupted, the cell is stopped; results until then: results\n"
    summary = json.loads((results / "summary.json").read_text())
    assert (summary["completed"], summary["stop_reason"]) == (False, "interrupted")
    assert 0 < summary["cycle"]["cycles"] < 240_000
    assert summary["contact"]["contact_fraction"] == 1.0  # of the hold so far
    with np.load(results / "log.npz") as columns:
        assert len(columns["t_s"]) in (summary["cycle"]["cycles"], summary["cycle"]["cycles"] - 1)  # amid a cycle
    last = {can_id: data for _, _, can_id, data in read_candump(log)}
    for node_id in (1, 2, 3, 4, 5, 6):
        assert state_of(int.from_bytes(last[0x180 + node_id][:2], "little")) not in POWERED_STATES
        assert last[0x700 + node_id] == b"\x7f"
    assert last[0x710] == b"\x7f"


# the C locale without coercion has an ASCII stream whose handler is no "strict" one, and yet raises
ENCODINGS = {
    "cp1252": {"PYTHONIOENCODING": "cp1252"},
    "the C locale": {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
}


def planned(folder, variables, *words):
    """What `canprobe plan free` prints in this environment."""
    command = [sys.executable, "-m", "canprobe", "plan", "free", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    return done.stdout


@pytest.fixture(scope="module")
def in_utf8(tmp_path_factory):
    """The plan for people, and the document."""
    return [
        planned(tmp_path_factory.mktemp("utf8"), {"PYTHONIOENCODING": "utf-8"}, *w) for w in (("--full",), ("--json",))
    ]


@pytest.mark.parametrize("name", ENCODINGS)
def test_what_an_encoding_does_not_have_is_printed_escaped(name, tmp_path, in_utf8):
    encoding = "cp1252" if name == "cp1252" else "ascii"
    whole, document = in_utf8
    escaped = whole.decode().encode(encoding, "backslashreplace")
    assert b"\\u" in escaped, "else nothing is tried"
    assert planned(tmp_path, ENCODINGS[name], "--full") == escaped
    if encoding == "ascii":
        assert json.loads(planned(tmp_path, ENCODINGS[name], "--json")) == json.loads(document)


@pytest.mark.parametrize(
    ("words", "status", "out"),
    [
        ("eds list >&-", 0, ""),
        ("eds list <&- 2>&-", 0, "encoder\nprbt_joint\npuma260_joint\ntactile_array\ntactile_array_fd\n"),
        ("plan cylindre 2>&-", 2, ""),  # a complaint does not go to stdout instead
    ],
)
def test_closed_standard_streams(words, status, out, tmp_path):
    line = f"{sys.executable} -m canprobe {words}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["bash", "-c", line], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (status, out, "")
