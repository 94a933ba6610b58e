"""The first hour with an arm, typed on a terminal, on a real bus: from a scan to a run, as docs/hands.md has it.

`canprobe vcan -- python -m pytest -n0 -s tests/vcan/test_first_hour.py -m ''` prints the times of keys and stops.
"""

from __future__ import annotations

import json
import os
import pty
import select
import statistics
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from patience import patience_s
from waiting import LOOK_S

from canprobe.cell.scene.load import packaged_files
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import TimedFrame

pytestmark = pytest.mark.vcan
ROOT = Path(__file__).parents[2]
ON_VCAN0 = ("--bus", "socketcan", "--channel", "vcan0")
TARGETS, PLACES = 0x201, 0x181
"""The frames that have the target and the place of joint 1."""
TIMES = 8
"""How often a time is measured."""


class Terminal:
    """A command on a terminal of its own, typed line by line.

    Attributes:
        said: what it has printed since the last line.
    """

    def __init__(self, folder: Path, *words: object) -> None:
        self._end, slave = pty.openpty()
        command = [sys.executable, "-m", "canprobe", *map(str, words)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        streams = dict.fromkeys(("stdin", "stdout", "stderr"), slave)
        self._process = subprocess.Popen(command, cwd=folder, env=environment, start_new_session=True, **streams)
        os.close(slave)
        self._clock = MonotonicClock()
        self.said = ""

    def type(self, line: str) -> int:
        """Type a line; return when, ns."""
        self.said = ""
        t_ns = self._clock.now_ns()
        os.write(self._end, f"{line}\n".encode())
        return t_ns

    def until(self, text: str, every: str | None = None) -> None:
        """Until it says this; meanwhile a line is typed again and again."""
        deadline_ns = self._clock.now_ns() + round(1e9 * patience_s(60.0))
        heard = ""
        while text not in heard:
            ended = self._process.poll() is not None
            heard += (more := self._heard())
            assert (more or not ended) and self._clock.now_ns() < deadline_ns, f"no {text!r}: {heard}"
            if every is not None:
                self.type(every)
        self.said += heard

    def _heard(self) -> str:
        if not select.select([self._end], [], [], LOOK_S)[0]:
            return ""
        try:
            return os.read(self._end, 4096).decode(errors="replace")
        except OSError:  # it has ended, and nothing is left to read
            return ""

    def answer(self, question: str, answer: str) -> None:
        self.until(question)
        self.type(answer)

    def end(self) -> None:
        """Wait until it has ended well."""
        deadline_ns = self._clock.now_ns() + round(1e9 * patience_s(60.0))
        while self._process.poll() is None:
            self.said += self._heard()
            assert self._clock.now_ns() < deadline_ns, f"has not ended: {self.said}"
        assert self._process.returncode == 0, self.said

    def kill(self) -> None:
        """Kill it if it still runs: a master that is left on the bus fails the tests behind this one."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._end)


@pytest.fixture
def on_terminal(bench: Any) -> Iterator[Callable[..., Terminal]]:
    """Starts commands on terminals; what still runs at the end is killed."""
    with ExitStack() as started:

        def start(*words: object) -> Terminal:
            terminal = Terminal(bench.folder, *words)
            started.callback(terminal.kill)
            return terminal

        yield start


def write_cell(path: Path) -> Path:
    """The packaged cell with its nodes on a bus, slow enough for a busy machine; joint 6 is homed where it stands."""
    text = packaged_files("cells")["puma260"].read_text()
    text = text.replace("[arm]\n", "[arm]\nemulated = false\nmissed_syncs = 20\n")
    text = text.replace("[sensor]\n", "[sensor]\nemulated = false\nrate_hz = 50\n")
    text = text.replace("[joints.joint_6]\n", '[joints.joint_6]\nzero = "homing"\nhoming_method = 35\nhome_deg = 0\n')
    path.write_text(f"{text}\n[cycle]\nrate_hz = 100\n\n[limits]\nlate_cycles_max_percent = 100\n")
    return path


def changes(frames: list[TimedFrame], can_id: int) -> list[int]:
    """When the data of an identifier changed, ns."""
    own = [(data[2:6], t_ns) for one, data, t_ns in frames if one == can_id]
    return [t_ns for (before, _), (after, t_ns) in pairwise(own) if before != after]


def step_and_stop(bench: Any, console: Terminal, sign: str) -> tuple[float, float, float]:
    """A jog that nobody renews after 0.3 s: from the key to its first target, and from the last key to the last
    target and until the joint stands, s."""
    frames = bench.bus.hear()
    first_ns = last_ns = console.type(f"jog 1 {sign}")
    while last_ns - first_ns < 300e6:
        frames += bench.bus.hear()
        last_ns = console.type("renew")
    console.until("paused")
    frames += bench.bus.hear()
    told, stood = changes(frames, TARGETS), changes(frames, PLACES)
    return tuple(1e-9 * t_ns for t_ns in (told[0] - first_ns, told[-1] - last_ns, stood[-1] - last_ns))


@pytest.mark.slow(reason="an hour's commands, one after the other, on a real bus")
@pytest.mark.timeout(600)
def test_the_first_hour(bench: Any, on_terminal: Callable[..., Terminal], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(bench.folder / "state"))
    cell = write_cell(bench.folder / "mine.toml")
    served = bench.start("emulate", cell, "--channel", "vcan0", "--nodes", "1-6,16").until_told("serving nodes")

    scan = bench.start("scan", *ON_VCAN0, "--json")
    scan.end(0)
    assert [node["node_id"] for node in json.loads(scan.out)] == [1, 2, 3, 4, 5, 6, 16]

    home = on_terminal("home", cell, *ON_VCAN0)
    home.answer("home it by method 35", "y")
    home.until("joint 6 (joint_6) is homed")
    home.end()

    checked = bench.start("up", cell, "--check-joints", "--yes", *ON_VCAN0)
    checked.end(0)

    console = on_terminal("console", cell, "--plain", *ON_VCAN0)
    console.until("`enable` begins")
    console.type("enable")
    console.answer("is the arm free to move? [yes, no]", "yes")
    bench.bus.until_enabled(1, by=served)
    console.type("step 10")
    times = [step_and_stop(bench, console, sign) for sign in TIMES // 2 * "+-"]
    columns = list(zip(*times, strict=True))
    for what, seconds in zip(("key to frame", "key to last frame", "key to standstill"), columns, strict=True):
        print(f"{what}: median {1e3 * statistics.median(seconds):.0f} ms, highest {1e3 * max(seconds):.0f} ms")
    key, last, stands = map(statistics.median, columns)
    assert key > 0.0 and 0.0 < last <= stands

    console.type("teach there")
    console.until("there is ")
    console.type("jog 1 -")
    console.until("paused")
    console.type("move there")
    console.answer("move? it goes on", "yes")
    console.until("the arm stands at ", every="")  # an empty line goes on with a motion that paused, too
    console.type("tare")
    console.answer("may this be zero?", "yes")
    console.until("tared: ")
    console.type("quit")
    console.end()
    taught = tomllib.loads(cell.read_text())["postures"]["there"]

    moved = on_terminal("move", cell, "start", *ON_VCAN0)
    moved.answer("move? [", "y")
    moved.until("the arm stands at 90.0")
    moved.end()
    bench.start("move", cell, "there", "--yes", *ON_VCAN0).end(0)
    bench.start("tare", cell, "--yes", *ON_VCAN0).end(0)
    listened = bench.start("listen", cell, "--duration", 0.5, "--json", *ON_VCAN0)
    listened.end(0)
    assert all(json.loads(line)["force_n"] < 0.1 for line in listened.out.splitlines())
    bench.start("run", cell, *ON_VCAN0, "--set", "task.start_posture=there", "--duration", 1, "--out", "ran").end(0)
    results = bench.results("ran")
    assert results.summary["completed"]
    bench.assert_left_safe(results.last, *range(1, 7))
    assert abs(taught[0] - 90.0) < 40.0 and served.running
