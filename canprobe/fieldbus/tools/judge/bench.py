"""Looks on while emulated nodes are served to a master: keeps the frames, runs its command, throws faults."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import IO

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import CandumpWriter
from canprobe.fieldbus.bus.files import writing
from canprobe.fieldbus.bus.port import Port, TimedFrame
from canprobe.fieldbus.bus.system import system
from canprobe.fieldbus.bus.tapped import TappedPort
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.protocol.cia402 import DriveCommand, command_of
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.tools.faults import FaultSpan, FaultyNodes
from canprobe.fieldbus.tools.faults.motor_faults import FaultyMotor
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.bus_state import BusState
from canprobe.fieldbus.tools.judge.events import ControlSeen, NmtSeen, RequestSeen
from canprobe.fieldbus.tools.judge.injections import Injections
from canprobe.fieldbus.tools.judge.judging import Judge
from canprobe.fieldbus.tools.judge.seen_motor import MotorSeen, SeenMotor
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_AFTER_NS = 500_000_000
"""Time for which the nodes are served after the end of the command."""
_ANSWER_NS = 5_000_000_000
"""Time after the end of a fault up to which the master may answer it."""
_HABIT_NS = 1_000_000_000
"""Time without a request after which the next one is something else than before."""
_START = 100_000
"""Place of a drive at first, counts, where its limits do not ask for less."""
_START_RAD = 0.3
"""Place of a motor that speaks no CANopen at first."""
_FORCES = ((0.0, signal.SIGINT), (5.0, signal.SIGTERM), (7.0, system.KILL))
"""Signals that end a command, and after how many seconds each is sent."""


class MasterCommand:
    """A command that runs beside the served nodes, in a session of its own.

    Args:
        words: the command.
        output: file for its output and errors.

    Raises:
        UsageError: there is no such command.
        ResultsError: the file cannot be written.
    """

    def __init__(self, words: Sequence[str], output: Path) -> None:
        self.words = list(words)
        self.output = output
        with writing(output):
            self._file: IO[bytes] = output.open("wb")
        try:
            self._process = subprocess.Popen(
                self.words, stdin=subprocess.DEVNULL, stdout=self._file, stderr=self._file, **system.OWN_SESSION
            )
        except OSError as error:
            self._file.close()
            raise UsageError(f"{self.words[0]}: cannot be started: {error.strerror}") from error
        self._ending_s: float | None = None
        self._sent = 0

    @property
    def status(self) -> int | None:
        """Exit status, negative after a signal; None while it runs."""
        return self._process.poll()

    def last_lines(self) -> list[str]:
        """Last lines of its output."""
        return self.output.read_text(encoding="utf-8", errors="replace").splitlines()[-20:]

    def press_on(self) -> bool:
        """End it: send the signals whose time has come since the first call. Whether it has ended."""
        if self.status is not None:
            return True
        now_s = time.monotonic()
        self._ending_s = now_s if self._ending_s is None else self._ending_s
        while self._sent < len(_FORCES) and now_s - self._ending_s >= _FORCES[self._sent][0]:
            system.end_session(self._process, _FORCES[self._sent][1])
            self._sent += 1
        return False

    def close(self) -> None:
        """End it and wait for its end, end what it left running, and close the file."""
        try:
            while not self.press_on():
                time.sleep(0.02)
        finally:  # a second Ctrl-C leaves nothing behind, too
            system.end_session(self._process, system.KILL)
            self._file.close()


class HeardPort(TappedPort):
    """The port of served nodes, whose frames are kept with their direction.

    Args:
        port: port to use.
        frames: list that takes the frames.
    """

    def __init__(self, port: Port, frames: list[BusFrame]) -> None:
        super().__init__(port)
        self._frames = frames

    def hear_sent(self, frames: Sequence[Frame], t_ns: int) -> None:
        self._frames += [BusFrame(t_ns, can_id, data, True) for can_id, data in frames]

    def hear_received(self, frames: Sequence[TimedFrame]) -> None:
        self._frames += [BusFrame(t_ns, can_id, data, False) for can_id, data, t_ns in frames]


class MasterBench:
    """Judges a master on nodes that are served meanwhile.

    Args:
        command: the master; empty: it is waited for.
        seconds: time after which the bench ends; None: when the command does, or at Ctrl-C.
        faults: faults to throw; None for the standard sequence.
        output: file for the output of the command.

    Attributes:
        frames: frames of the bus.
        asked: whether somebody has asked for the end; the nodes are served until the command has ended.
        timed_out: whether the command was still running after `seconds`.
        status: exit status of the command; None where it was ended by us, or there is none.
    """

    def __init__(
        self, command: Sequence[str], seconds: float | None, faults: Sequence[str] | None, output: Path
    ) -> None:
        self.frames: list[BusFrame] = []
        self.asked = self.timed_out = False
        self.status: int | None = None
        self.command: MasterCommand | None = None
        self.injections: Injections | None = None
        self._words, self._seconds, self._faults, self._output = command, seconds, faults, output
        self._begin_ns = self._last_ns = 0
        self._ended_ns: int | None = None

    def tap(self, port: Port) -> Port:
        """The port in whose place the nodes' frames are kept."""
        return HeardPort(port, self.frames)

    def begin(self, nodes: FaultyNodes, now_ns: int) -> None:
        """Start the command and the faults."""
        self._begin_ns = now_ns
        for node in nodes.nodes:
            if isinstance(node, FaultyMotor):
                node.motor.joint.q = _START_RAD
        self.injections = Injections(nodes, self._faults, now_ns)
        if self._words:
            self.command = MasterCommand(self._words, self._output)

    def look(self, now_ns: int) -> bool:
        """Throw faults, look at the command, and end the bench when its time has come."""
        assert self.injections is not None
        self.injections.look(now_ns)
        self._last_ns = now_ns
        if self._ended_ns is not None:
            return now_ns - self._ended_ns > _AFTER_NS
        over = self._seconds is not None and now_ns - self._begin_ns > self._seconds * 1e9
        if self.command is None:
            return over or self.asked
        if not (over or self.asked or self.timed_out):
            self.status = self.command.status
            self._ended_ns = None if self.status is None else now_ns
            return False
        self.timed_out = self.timed_out or not self.asked
        if self.command.press_on():
            self._ended_ns = now_ns
        return False

    def ask(self) -> None:
        """Ask for the end."""
        self.asked = True

    def close(self) -> None:
        """End the command."""
        if self.command is not None:
            self.command.close()

    def record(self) -> list[BusFrame]:
        """The frames in the order of their times, which count from the beginning."""
        ordered = sorted(self.frames, key=attrgetter("t_ns"))
        return [replace(frame, t_ns=frame.t_ns - self._begin_ns) for frame in ordered]

    def thrown(self) -> list[FaultSpan]:
        """The faults that held, with times from the beginning."""
        return self.injections.thrown(self._begin_ns) if self.injections is not None else []

    def judged(
        self,
        nodes: Mapping[int, Description],
        bitrate: int,
        without: Collection[int] = (),
        motors: Sequence[SeenMotor] = (),
    ) -> Judge:
        """The frames, judged."""
        spans = [(one.begin_ns, one.end_ns) for one in self.thrown()]
        judge = Judge(nodes, served=True, bitrate=bitrate, charges_ns=spans, without=without, motors=motors)
        return judge.hear(self.record(), self._last_ns - self._begin_ns)


def start_position(description: Description) -> int:
    """Place of a served drive at first, counts: away from 0, and within its software limits (607Dh)."""
    limit = description.entry(0x607D, 2)
    high = limit.initial if limit is not None else None
    # at 0 a jump to a target of 0 would not show
    return min(high // 10, _START) if isinstance(high, int) and high > 0 else _START


def write_log(frames: Sequence[BusFrame], path: Path, channel: str) -> None:
    """Write frames as a candump log.

    Raises:
        ResultsError: the file cannot be written.
    """
    with CandumpWriter(path, channel) as writer:
        for frame in frames:
            writer.write(frame.can_id, frame.data, max(frame.t_ns, 0))


def first_answers(
    frames: Sequence[BusFrame],
    thrown: Sequence[FaultSpan],
    nodes: Mapping[int, Description],
    motors: Sequence[SeenMotor] = (),
) -> list[BusFrame | None]:
    """The first frame after each fault by which the master does something else than before; None without one.

    It counts up to the next fault, and up to five seconds after the fault's end: an NMT command, a controlword with
    another command, an SDO request to a node that had none for a second, or a special command to a motor.
    """
    bus = BusState(nodes, served=True, motors=motors)
    answers: list[BusFrame | None] = [None] * len(thrown)
    commands: dict[SeenNode, DriveCommand | None] = {}  # the last one to each node
    asked_ns: dict[SeenNode, int] = {}
    for frame in frames:
        for event in bus.take(frame):
            new = isinstance(event, NmtSeen) or (isinstance(event, MotorSeen) and event.special is not None)
            if isinstance(event, RequestSeen):
                new = event.node not in asked_ns or frame.t_ns - asked_ns[event.node] > _HABIT_NS
                asked_ns[event.node] = frame.t_ns
            elif isinstance(event, ControlSeen):
                command = command_of(event.word)
                new = command is not commands.get(event.node)
                commands[event.node] = command
            before = [number for number, one in enumerate(thrown) if one.begin_ns <= frame.t_ns] if new else []
            if before and answers[before[-1]] is None and frame.t_ns < thrown[before[-1]].end_ns + _ANSWER_NS:
                answers[before[-1]] = event.frame
    return answers
