"""Both clocks; the monotonic one by its own readings only, never by how long something took."""

from __future__ import annotations

import itertools
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager

import pytest

from canprobe.fieldbus import MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.clock import wake_lateness
from canprobe.fieldbus.bus.joined import JoinedPort
from canprobe.fieldbus.bus.port import Reports
from canprobe.fieldbus.bus.real.mmsg import Row
from canprobe.fieldbus.bus.real.python_can import PythonCanPort
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort, StampClock
from canprobe.fieldbus.protocol.frames import Frame, pack_sync


def test_virtual_time_stands_still_and_jumps() -> None:
    clock = VirtualClock()
    assert (clock.now_ns(), clock.now_ns()) == (0, 0)
    clock.sleep_until_ns(2_500_000)
    clock.sleep_until_ns(1)
    assert clock.now_ns() == 2_500_000
    assert VirtualClock(7).now_ns() == 7


def test_a_loop_that_is_late_passes_over_the_deadlines_that_are_past() -> None:
    asked, naps = list[int](), iter((0, 100, 2600, 0))

    class LateClock(VirtualClock):
        def sleep_until_ns(self, t_ns: int) -> None:
            asked.append(t_ns)
            super().sleep_until_ns(t_ns + next(naps))

    assert wake_lateness(LateClock(), 1000, 4) == [0, 0, 100, 2600]
    assert asked == [1000, 2000, 3000, 6000]


def test_monotonic_sleep_never_ends_early() -> None:
    clock = MonotonicClock()
    for ahead_ns in (-5, 0, 1, 300_000):
        target_ns = time.monotonic_ns() + ahead_ns
        clock.sleep_until_ns(target_ns)
        assert clock.now_ns() >= target_ns
    clock.sleep_until_ns(-1)
    assert clock.now_ns() <= time.monotonic_ns()


@contextmanager
def alarm(action: object, seconds: float) -> Iterator[None]:
    before = signal.signal(signal.SIGALRM, action)  # type: ignore[arg-type]
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_a_signal_that_raises_ends_the_sleep_and_another_does_not() -> None:
    clock = MonotonicClock()
    rung: list[int] = []
    with alarm(lambda number, _: rung.append(number), 0.001):
        target_ns = clock.now_ns() + 20_000_000
        clock.sleep_until_ns(target_ns)
        assert rung == [signal.SIGALRM]
        assert clock.now_ns() >= target_ns

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    with alarm(interrupt, 0.001), pytest.raises(KeyboardInterrupt):
        clock.sleep_until_ns(clock.now_ns() + 3600 * 10**9)


def test_a_time_that_is_past_asks_nothing_of_the_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(time, "sleep", asked.append)
    clock = MonotonicClock()
    clock.sleep_until_ns(clock.now_ns())
    assert not asked
    clock.sleep_until_ns(clock.now_ns() + 10_000_000)
    assert len(asked) == 1


# Stamps of the wall clock, which somebody sets while frames come.

MS = 1_000_000
WALL_NS = 1_700_000_000_000_000_000
STEPS_MS = [-3_600_000, -300, -20, -0.2, 0.2, 20, 300, 1000]


class Machine:
    """A monotonic clock, a wall clock, and a CAN socket whose frames the kernel stamps by the wall clock."""

    def __init__(self, reading_ns: int = 0) -> None:
        self.monotonic, self.offset = VirtualClock(5 * MS), WALL_NS
        self.reading_ns = reading_ns
        self.readings = 0
        self.waiting: list[Row] = []

    def now_ns(self) -> int:
        self.readings += 1
        self.pass_ns(self.reading_ns)
        return self.monotonic.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        self.monotonic.sleep_until_ns(t_ns)

    def wall_ns(self) -> int:
        return self.now_ns() + self.offset

    def pass_ns(self, ns: int) -> None:
        self.monotonic.move_ns(self.monotonic.now_ns() + ns)

    def set_wall(self, ms: float) -> None:
        self.offset += round(ms * MS)

    def go_on_to(self, t_ns: int) -> None:
        self.pass_ns(max(0, t_ns - self.monotonic.now_ns()))

    def arrive(self, can_id: int = 0x181, data: bytes = b"") -> int:
        """A frame; when it came, on the monotonic clock."""
        t_ns = self.monotonic.now_ns()
        self.waiting.append((can_id, data, t_ns + self.offset, 0))
        return t_ns

    def send(self, frames: Sequence[Frame]) -> int:
        return len(frames)

    def receive(self, wait: bool = False) -> list[Row]:
        rows, self.waiting = self.waiting, []
        return rows


Open = Callable[..., tuple[SocketCanPort, list[str]]]


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[Open]:
    """Opens a port on a machine's socket; with the port comes the list of what it says."""
    with ExitStack() as stack:

        def open_port(machine: Machine, channel: str = "can7") -> tuple[SocketCanPort, list[str]]:
            said: list[str] = []
            for name, stand_in in {
                "check_interface": lambda *_: None,
                "_open": lambda *_, **__: stack.enter_context(socket.socket()),
                "FrameSocket": lambda *_: machine,
                "StampClock": lambda monotonic_ns: StampClock(machine.wall_ns, monotonic_ns),
            }.items():
                monkeypatch.setattr(f"canprobe.fieldbus.bus.real.socketcan.{name}", stand_in)
            return SocketCanPort(channel, machine, reports=Reports(say=said.append)), said

        yield open_port


@pytest.mark.parametrize("ms", STEPS_MS)
@pytest.mark.parametrize("reading_ns", [60, 35_000], ids=["native", "guest"])
def test_a_wall_clock_that_is_set_misplaces_no_frame_by_a_cycle(ms: float, reading_ns: int, opened: Open) -> None:
    """Frames every half a millisecond: none is read as of before the drain in front of it, none as of the future."""
    machine = Machine(reading_ns)
    port, said = opened(machine)
    before_ns = machine.monotonic.now_ns()
    for number in range(60):
        if number == 30:
            machine.set_wall(ms)
        machine.pass_ns(500_000)
        came_ns = machine.arrive()
        machine.pass_ns(20_000)
        ((_, _, read_ns),) = port.drain()
        assert before_ns - reading_ns <= read_ns
        if abs(ms) >= 1 or number not in (30, 31):  # of a smaller step two may be read before it is looked for
            assert read_ns <= machine.monotonic.now_ns() + reading_ns
            assert abs(read_ns - came_ns) < 500_000
        before_ns = machine.monotonic.now_ns()
    way = "back" if ms < 0 else "forward"
    assert port.counters.clock_steps == 1
    assert len(said) == 1 and said[0].startswith(f"can7: the wall clock was set {way} by {abs(ms):.1f} ms;")
    machine.set_wall(1.0)
    machine.pass_ns(MS)
    machine.arrive()
    port.drain()
    assert (port.counters.clock_steps, len(said)) == (2, 1), "a clock that is set again and again does not fill a log"


@pytest.mark.parametrize("ms", STEPS_MS)
def test_frames_from_before_and_after_the_step_keep_their_times(ms: float, opened: Open) -> None:
    machine = Machine()
    port, _ = opened(machine)
    came = []
    for can_id in (0x181, 0x182, 0x183, 0x184):
        machine.pass_ns(100_000)
        came.append((can_id, b"", machine.arrive(can_id)))
        if can_id == 0x182:
            machine.set_wall(ms)
    machine.pass_ns(100_000)
    read = port.drain()
    if abs(ms) >= 1:
        assert read == came
    for (can_id, _, read_ns), (expected, _, came_ns) in zip(read, came, strict=True):  # never as older than it is
        assert can_id == expected and came_ns <= read_ns <= machine.monotonic.now_ns()


@pytest.mark.parametrize("ms", [-300, -0.9, -0.1, 0.3])
def test_no_step_makes_an_answer_older_than_its_sync(ms: float, opened: Open) -> None:
    """The clock is set at each moment of a cycle; answers come one by one, other frames come before the SYNC."""
    steps = {100: "send", 110: "drain", 200: "arrive", 230: "look", 330: "arrive", 350: "look"}
    steps |= {2440: "arrive", 2499: "drain"}
    for moment_us in range(0, 2500, 50):
        machine, sync_ns = Machine(60), 0
        port, _ = opened(machine)
        for cycle in range(6):
            start_ns = 5 * MS + 2_500_000 * cycle
            at_us = steps if cycle != 3 else {**steps, moment_us + 5: "set"}
            for us in sorted(at_us):
                machine.go_on_to(start_ns + 1000 * us)
                match at_us[us]:
                    case "set":
                        machine.set_wall(ms)
                    case "arrive":
                        machine.arrive()
                    case "send":
                        sync_ns = machine.now_ns()
                        port.send_batch([pack_sync(None)])
                    case "drain":
                        port.drain()
                    case "look":
                        assert [read_ns >= sync_ns for _, _, read_ns in port.drain()] == [True], moment_us
        assert port.counters.clock_steps == 1


@pytest.mark.parametrize("ms", [-3_600_000, -300, 300, 3_600_000])
def test_a_clock_that_is_set_to_and_fro_between_two_looks_misplaces_no_frame(ms: float, opened: Open) -> None:
    """Nothing of the two steps is left but the stamps of the frames between them; the frames keep their order."""
    machine = Machine()
    port, said = opened(machine)
    before_ns = 0
    for number in range(40):
        came = []
        for can_id in (0x181, 0x182, 0x183, 0x184):
            machine.pass_ns(500_000)
            if number == 20 and can_id in (0x182, 0x184):
                machine.set_wall(ms if can_id == 0x182 else -ms)
            came.append((can_id, machine.arrive(can_id)))
        machine.pass_ns(500_000)
        read = port.drain()
        assert [can_id for can_id, _, _ in read] == [can_id for can_id, _ in came]
        assert all(before_ns <= read_ns <= machine.monotonic.now_ns() for _, _, read_ns in read)
        if number != 20:
            assert [read_ns for _, _, read_ns in read] == [came_ns for _, came_ns in came]
        before_ns = machine.monotonic.now_ns()
    assert port.counters.clock_steps == 1
    assert said == ["can7: the wall clock was set to and fro; frames keep their time, further times are only counted"]


def test_a_wait_of_python_can_goes_by_the_monotonic_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """The wall clock is set back by an hour at each look at it: no wait on a silent bus becomes longer."""
    clock, waits, wall = VirtualClock(), [], itertools.count(0.0, -3600.0)
    port = PythonCanPort("virtual", "set back", 1_000_000, clock)

    def silent(timeout: float | None) -> tuple[None, bool]:
        waits.append(timeout)
        clock.move_ns(clock.now_ns() + round(1e9 * (timeout or 0.0)))
        return None, False

    monkeypatch.setattr(port._bus, "_recv_internal", silent)
    monkeypatch.setattr("can.bus.time", lambda: next(wall))
    assert port.drain() == []
    port.wait(20 * MS)
    assert waits == [0.0, 0.02]
    port.close()


def test_a_clock_that_nobody_sets_costs_two_readings_a_millisecond_and_no_step(opened: Open) -> None:
    machine = Machine(35_000)
    port, said = opened(machine)
    machine.readings = 0
    start_ns, came = machine.monotonic.now_ns(), 0
    while machine.monotonic.now_ns() < start_ns + 200 * MS:
        machine.pass_ns(100_000)
        machine.arrive()
        came += len(port.drain())
    assert came > 1000 and machine.readings <= 2 * 200 + 2
    assert (port.counters.clock_steps, said) == (0, [])


def test_a_process_that_waits_between_two_readings_takes_that_for_no_step(opened: Open) -> None:
    machine = Machine()
    port, _ = opened(machine)
    for number in range(40):
        machine.pass_ns(2 * MS)
        came_ns = machine.arrive()
        machine.reading_ns = 7 * MS if number % 10 == 9 else 0
        assert port.drain() == [(0x181, b"", came_ns)]
    assert port.counters.clock_steps == 0


def test_two_buses_see_one_step_of_the_one_wall_clock(opened: Open) -> None:
    machine = Machine()
    ports = {name: opened(machine, name)[0] for name in ("can0", "can1")}
    both = JoinedPort(ports, {})
    machine.set_wall(-100)
    for port in ports.values():
        machine.pass_ns(2 * MS)
        machine.arrive()
        port.drain()
    assert both.counters.clock_steps == 1
