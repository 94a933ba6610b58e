"""The cell in several processes on a real vcan0: starting them, watching the bus, reading what a run left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from patience import patience_s as stretched
from slow_scene import write_slow_scene
from waiting import wait_until

from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, DriveState, state_of

ROOT = Path(__file__).parents[2]
CHANNEL = "vcan0"
PATIENCE_S = 60.0
DRIVES = (1, 2, 3, 4, 5, 6)
EXPECTED_WARNINGS = ("warning: arm.missed_syncs = ", "warning: whether the arm moves as its file says is not known: ")


class Command:
    """One `canprobe` process in a session of its own; its output goes to files."""

    def __init__(self, folder: Path, words: tuple[str, ...]) -> None:
        self._out, self._err = folder / "stdout", folder / "stderr"
        temporary = self.temporary = folder / "temporary"
        temporary.mkdir()
        environment = {
            **{name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"},
            **{"PYTHONPATH": str(ROOT), "TMPDIR": str(temporary)},
        }
        with self._out.open("wb") as out, self._err.open("wb") as err:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "canprobe", *words],
                cwd=folder.parent,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=err,
                start_new_session=True,
            )

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def children(self) -> list[int]:
        """Process ids of the emulators that this command started."""
        mine = b"--parent\0%d\0" % self._process.pid
        found = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                if mine in path.read_bytes():
                    found.append(int(path.parent.name))
            except OSError:
                continue
        return found

    def until_told(self, text: str) -> Command:
        """Until this stands on stderr."""
        wait_until(lambda: text in self.err, lambda: self.running, lambda: self.err)
        return self

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self, patience_s: float = PATIENCE_S) -> int:
        """Wait for the end; return the exit status. Nothing may be left of it."""
        status = self._process.wait(stretched(patience_s))
        assert self.children == []
        return status

    def end(self, status: int) -> list[str]:
        """Wait for the end with this status. Nothing may be left of it.

        Returns:
            The lines on stderr, without the warnings of the patience that the scenes of a slow machine need, and of
            joints that nobody has checked.
        """
        ended = self._process.wait(stretched(PATIENCE_S))
        assert ended == status, f"ended with {ended}: {self.err}"
        assert "Traceback" not in self.err
        assert self.children == []
        assert list(self.temporary.iterdir()) == [], "temporary files are left"
        return [line for line in self.err.splitlines() if not line.startswith(EXPECTED_WARNINGS)]

    def kill(self) -> None:
        for pid in self.children:
            os.kill(pid, signal.SIGKILL)
        if self.running:
            self._process.kill()
            self._process.wait()


class Starter:
    """Starts `canprobe WORDS...`, and at last kills whatever still runs."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: list[Command] = []

    def __call__(self, *words: object) -> Command:
        own = self._folder / f"process{len(self._started)}"
        own.mkdir()
        self._started.append(command := Command(own, tuple(map(str, words))))
        return command

    def kill(self) -> None:
        for command in self._started:
            command.kill()


@pytest.fixture(scope="module")
def start_shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Starter]:
    """Starts processes that all tests of a module use."""
    starter = Starter(tmp_path_factory.mktemp("shared"))
    yield starter
    starter.kill()


class Bus:
    """What passes on vcan0, read by a socket of the test's own.

    Attributes:
        last: the last data of each identifier that was seen.
    """

    def __init__(self) -> None:
        self.clock = MonotonicClock()
        self.port = SocketCanPort(CHANNEL, self.clock)
        self.last: dict[int, bytes] = {}

    def hear(self) -> list[TimedFrame]:
        """What has come since the last call; a look now and then leaves the processor to those who work."""
        self.clock.sleep_until_ns(self.clock.now_ns() + 20_000_000)
        frames = self.port.drain()
        self.last.update((can_id, data) for can_id, data, _ in frames)
        return frames

    def until(self, done: Callable[[TimedFrame], bool], *alive: Command) -> None:
        """Until `done` holds for a frame; the commands must keep running until then."""
        deadline_ns = self.clock.now_ns() + round(stretched(PATIENCE_S) * 1e9)
        while not any([done(frame) for frame in self.hear()]):
            for command in alive:
                assert command.running, f"ended too early: {command.err}"
            assert self.clock.now_ns() < deadline_ns, f"not seen on the bus within {PATIENCE_S:g} s"

    def until_booted(self, *node_ids: int, by: Command) -> None:
        """Until each node has sent its boot-up."""
        waiting = {0x700 + node_id for node_id in node_ids}

        def done(frame: TimedFrame) -> bool:
            if frame[1] == b"\0":
                waiting.discard(frame[0])
            return not waiting

        self.until(done, by)

    def until_enabled(self, node_id: int, by: Command, cycles: int = 50) -> None:
        """Until the drive has reported operation enabled in this many cycles."""
        left = cycles

        def done(frame: TimedFrame) -> bool:
            nonlocal left
            left -= frame[0] == 0x180 + node_id and drive_state(frame[1]) is DriveState.OPERATION_ENABLED
            return left <= 0

        self.until(done, by)


def drive_state(tpdo: bytes) -> DriveState:
    """CiA 402 state in a drive's TPDO1."""
    return state_of(int.from_bytes(tpdo[:2], "little"))


class Results:
    """The folder that a run has left behind; every file that belongs there must be."""

    def __init__(self, folder: Path) -> None:
        for name in ("bus.log", "log.npz", "scene.toml", "summary.json"):
            assert (folder / name).stat().st_size > 0, name
        self.summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
        self.frames = sorted(read_candump(folder / "bus.log"), key=lambda row: row[0])
        self.last = {can_id: data for _, _, can_id, data in self.frames}


class Bench:
    """What a test works with: processes, the bus, scenes and results, all in the test's folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.bus = Bus()
        self.start = Starter(folder)

    def scene(self, name: str, *, rate_hz: int = 100, emulated: bool = True, eds: str = "", **options: Any) -> Path:
        """A packaged scene as `write_slow_scene` alters it."""
        path = self.folder / f"{name}-{rate_hz}-{emulated}-{bool(eds)}.toml"
        return write_slow_scene(path, name, rate_hz=rate_hz, emulated=emulated, eds=eds, **options)

    def results(self, name: str) -> Results:
        return Results(self.folder / name)

    @staticmethod
    def assert_left_safe(last: dict[int, bytes], *node_ids: int) -> None:
        """By the last frames on the bus: no drive has power, and every node is pre-operational."""
        for node_id in node_ids:
            if node_id in DRIVES:
                assert drive_state(last[0x180 + node_id]) not in POWERED_STATES, f"node {node_id}"
            assert last[0x700 + node_id] == b"\x7f", f"node {node_id}"


@pytest.fixture
def bench(vcan0: str, tmp_path: Path) -> Iterator[Bench]:
    """Everything for a test; whatever it started is killed at its end."""
    bench = Bench(tmp_path)
    yield bench
    bench.start.kill()
    bench.bus.port.close()
