"""What the cycle sees of the world: clocks, and CAN ports with frames out in batches, frames in with their time, and
a wait.

A frame is `(can_id, data)`. Identifiers above 11 bits and remote requests carry the flags of Linux's `struct
can_frame`: `EFF_FLAG` for a 29-bit identifier, `RTR_FLAG` for a remote request; plain data frames are the bare
identifier. Error frames are never passed on as frames: a hardware port reads their class bits, counts bus errors and
lost frames, shows its controller's state, and hands each of them to whoever writes a log.

Source: Linux include/uapi/linux/can/error.h (error classes).
"""

from __future__ import annotations

import ctypes
import errno
import os
import select
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields
from enum import IntEnum
from typing import Protocol

from canprobe.errors import InterfaceError
from canprobe.fieldbus.protocol.frames import Frame

# Two kinds of time behind one interface: virtual time that jumps, and the monotonic clock of the machine.
#
# All times are integer nanoseconds. The cycle asks only for `now_ns` and `sleep_until_ns`; with a `VirtualClock` a
# sleep is a jump that runs everything due on the way, so a simulated second lasts as long as its computation.

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1


class Clock(Protocol):
    """A source of time and the only way to wait for it."""

    def now_ns(self) -> int:
        """Return the present time in ns; it never decreases."""
        ...

    def sleep_until_ns(self, t_ns: int) -> None:
        """Return when the clock shows `t_ns` or later; at once if it does already."""
        ...


class Driver(Protocol):
    """Something that lives in virtual time, such as a `LockstepBus`."""

    def next_deadline_ns(self) -> int | None:
        """Return when it next has something to do, `None` if it only waits for others."""
        ...

    def settle(self) -> None:
        """Do everything due at the present instant; afterwards its next deadline lies in the future."""
        ...

    def run_until_ns(self, until_ns: int) -> None:
        """Do everything due up to and including `until_ns`, and move the clock to each instant on the way."""
        ...


class VirtualClock:
    """A clock that stands still until somebody waits, then jumps from one thing that is due to the next.

    Several drivers (buses) may share one clock: they are settled at each instant in the order of their attachment.

    Args:
        start_ns: the time at which the clock starts.
    """

    __slots__ = ("_drivers", "_now_ns")

    def __init__(self, start_ns: int = 0) -> None:
        self._now_ns = start_ns
        self._drivers: list[Driver] = []

    def now_ns(self) -> int:
        """Return the present virtual time in ns."""
        return self._now_ns

    def attach(self, driver: Driver) -> None:
        """Let `driver` be run whenever time passes one of its deadlines."""
        self._drivers.append(driver)

    def detach(self, driver: Driver) -> None:
        """Stop running `driver`."""
        self._drivers.remove(driver)

    def step(self, until_ns: int) -> bool:
        """Go to the next instant at which something is due and do it, or to `until_ns` if nothing is due by then.

        Returns:
            True if something was done (call again), False if `until_ns` is reached and nothing is due any more.
        """
        target = until_ns + 1
        for driver in self._drivers:
            due = driver.next_deadline_ns()
            if due is not None and due < target:
                target = due
        if target > until_ns:
            self._now_ns = max(self._now_ns, until_ns)
            return False
        self._now_ns = max(self._now_ns, target)
        for driver in self._drivers:
            driver.settle()
        return True

    def move_ns(self, t_ns: int) -> None:
        """Show `t_ns`, unless it is past; for a driver that runs."""
        self._now_ns = t_ns if t_ns > self._now_ns else self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Run every driver up to and including `t_ns`; whoever is first runs alone until the next one is due."""
        if len(self._drivers) == 1:
            self._drivers[0].run_until_ns(t_ns)
            self.move_ns(t_ns)
            return
        while True:
            first, alone_ns, earliest = None, t_ns + 1, t_ns + 1
            for driver in self._drivers:
                due = driver.next_deadline_ns()
                if due is None or due >= alone_ns:
                    continue
                if due < earliest:
                    first, alone_ns, earliest = driver, earliest, due
                else:
                    alone_ns = due
            if first is None:
                self.move_ns(t_ns)
                return
            if alone_ns > earliest:
                first.run_until_ns(alone_ns - 1)
            else:
                self.step(t_ns)


class Timespec(ctypes.Structure):
    """struct timespec of the C library."""

    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class MonotonicClock:
    """CLOCK_MONOTONIC, with sleeps on absolute deadlines so that periods do not drift."""

    __slots__ = ("_clock_nanosleep", "_request")

    def __init__(self) -> None:
        self._request = Timespec()
        self._clock_nanosleep = getattr(ctypes.CDLL(None), "clock_nanosleep", None)

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in ns."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until CLOCK_MONOTONIC shows `t_ns`; a signal handler that raises ends the sleep.

        A time that is past costs a reading of the clock: the system call alone costs five in a virtual machine.
        """
        now_ns = time.monotonic_ns()
        if now_ns >= t_ns:
            return
        clock_nanosleep = self._clock_nanosleep
        if clock_nanosleep is None:
            time.sleep((t_ns - now_ns) * 1e-9)
            return
        request = self._request
        request.tv_sec, request.tv_nsec = divmod(t_ns, 1_000_000_000)
        while status := clock_nanosleep(_CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(request), None):
            if status != errno.EINTR:
                raise OSError(status, os.strerror(status))


def epoch_now_ns() -> int:
    """The time of day in ns since the Unix epoch, for what leaves this machine; nothing is decided by it."""
    return time.time_ns()


def elapsed_ns() -> int:
    """A running count of real nanoseconds, to measure what something costs; never to decide anything.

    On a virtual clock too this is real time: the cost of a cycle is the same question in lockstep.
    """
    return time.perf_counter_ns()


# What the cycle sees of a CAN bus: frames out in batches, frames in with their time, and a wait.

ERR_FLAG = 0x20000000
ERR_CONTROLLER, ERR_PROTOCOL, ERR_ACK, ERR_BUS_OFF, ERR_BUS, ERR_RESTARTED = 0x004, 0x008, 0x020, 0x040, 0x080, 0x100
_BUS_ERRORS = ERR_PROTOCOL | ERR_ACK | ERR_BUS
_OVERFLOWS, _WARNINGS, _PASSIVES, _ACTIVE = 0x03, 0x0C, 0x30, 0x40
"""Bits of the second byte of an ERR_CONTROLLER frame, each for reception and transmission."""

TimedFrame = tuple[int, bytes, int]
"""A received frame: can_id, data, time of reception in ns on the port's clock."""


class ControllerState(IntEnum):
    """Error state of the CAN controller, as far as error frames show it (ISO 11898-1 fault confinement)."""

    ACTIVE = 0
    WARNING = 1
    PASSIVE = 2
    BUS_OFF = 3


def is_bus_error(can_id: int) -> bool:
    """Whether this is an error frame of a frame that went wrong: protocol, acknowledgement or bit error.

    A lost arbitration, which some drivers report every time, and a change of the controller's state do not count.
    """
    return bool(can_id & ERR_FLAG and can_id & _BUS_ERRORS)


def state_after(state: ControllerState, can_id: int, data: bytes) -> ControllerState:
    """The controller's state after an error frame."""
    if can_id & ERR_BUS_OFF:
        return ControllerState.BUS_OFF
    if can_id & ERR_RESTARTED:
        return ControllerState.ACTIVE
    for bits, reported in (
        (_PASSIVES, ControllerState.PASSIVE),
        (_WARNINGS, ControllerState.WARNING),
        (_ACTIVE, ControllerState.ACTIVE),
    ):
        if _of_controller(can_id, data) & bits:
            return reported
    return state


def _of_controller(can_id: int, data: bytes) -> int:
    return data[1] if can_id & ERR_CONTROLLER and len(data) > 1 else 0


@dataclass(slots=True)
class PortCounters:
    """What a port has counted since it was opened.

    Attributes:
        sent: frames handed to the bus.
        received: data and remote frames given to the reader.
        error_frames: bus errors, as error frames report them.
        overruns: frames that were lost on this machine: dropped by the kernel because the reader was late, and
            overflows of the controller's buffers.
        transmit_full: times that the transmit queue was full, retries included.
        ignored: frames that classic CAN cannot carry (CAN FD) and that were dropped.
        clock_steps: times that the wall clock, by which the kernel stamps frames, was set.
    """

    sent: int = 0
    received: int = 0
    error_frames: int = 0
    overruns: int = 0
    transmit_full: int = 0
    ignored: int = 0
    clock_steps: int = 0

    def note_error(self, can_id: int, data: bytes) -> None:
        """Count an error frame for what it is; an overflow is one lost frame, whichever way it was to go."""
        self.error_frames += is_bus_error(can_id)
        self.overruns += bool(_of_controller(can_id, data) & _OVERFLOWS)


def _nobody(*_: object) -> None:
    """Hears nothing."""


@dataclass(frozen=True, slots=True)
class Reports:
    """Who hears what a port does not hand to its reader.

    Attributes:
        error_frame: called with (can_id, data, t_ns) of every error frame.
        say: called with each message for the user.
    """

    error_frame: Callable[[int, bytes, int], None] = _nobody
    say: Callable[[str], None] = _nobody


class Port(Protocol):
    """One participant's connection to one bus. A port never receives what it sent itself."""

    @property
    def clock(self) -> Clock:
        """The clock on which this port waits and stamps."""
        ...

    @property
    def channel(self) -> str:
        """The bus's name, as in messages and logs."""
        ...

    @property
    def counters(self) -> PortCounters:
        """What has passed since the port was opened."""
        ...

    @property
    def state(self) -> ControllerState:
        """The CAN controller's error state, as far as the port knows it."""
        ...

    @property
    def stamps_arrival(self) -> bool:
        """Whether a received frame carries the time of its arrival; if not, that of the `drain` that returned it."""
        ...

    @property
    def descriptor(self) -> int | None:
        """A file descriptor that can be read once `drain` has something; None where the port has none.

        Raises:
            InterfaceError: the port is closed.
        """
        ...

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` in this order.

        Args:
            frames: the frames.
            t_ns: the present time, where the caller has just read it; only a port that writes down uses it.

        Raises:
            InterfaceError: the interface is down, closed, lost or stays full.
        """
        ...

    def drain(self) -> list[TimedFrame]:
        """Return every frame that has arrived, in order, without waiting; the next call starts empty.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """
        ...

    def wait(self, until_ns: int) -> None:
        """Return as soon as `drain` may have something, at `until_ns` at the latest.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """
        ...

    def wait_and_drain(self, until_ns: int) -> list[TimedFrame]:
        """Wait for frames, until `until_ns` at the latest, and return them.

        Raises:
            InterfaceError: the interface is down, closed or lost.
        """
        ...

    def defer(self, can_ids: Collection[int]) -> None:
        """Let frames with these 11-bit identifiers wake nobody, where the interface can: they come with the next other.

        Raises:
            InterfaceError: the port has filters, or the interface is lost.
        """
        ...

    def close(self) -> None:
        """Give the interface back; closing twice is allowed, everything else afterwards raises InterfaceError."""
        ...


class PlainPort:
    """Base class of ports that wait and drain in two calls, and are woken by every frame."""

    @property
    def descriptor(self) -> int | None:
        """None: nothing but the port itself can wait for its frames."""
        return None

    def wait_and_drain(self: Port, until_ns: int) -> list[TimedFrame]:
        """Wait for frames, until `until_ns` at the latest, and return them."""
        self.wait(until_ns)
        return self.drain()

    def defer(self, can_ids: Collection[int]) -> None:
        """Nothing: these frames wake the port too."""


# Several buses as one `Port`: what is sent goes to the bus of its receiver, what arrives comes in the order of time.
#
# SYNC, NMT, TIME and the master's heartbeat go to all of them, so that one SYNC counts on every bus. A bus that is lost
# is reported once; then the others go on without it, so that their nodes can be stopped in an orderly way.

_SLICE_NS = 200_000
"""How long one bus without a descriptor is waited for before the others are looked at again."""


def wait_for_any(ports: Sequence[Port], until_ns: int) -> None:
    """Return as soon as `drain` of one of the ports may have something, at `until_ns` at the latest, or earlier.

    Args:
        ports: at least one, all on one clock.
        until_ns: on that clock.

    Raises:
        InterfaceError: one is closed or lost.
    """
    clock = ports[0].clock
    descriptors = [one for port in ports if (one := port.descriptor) is not None]
    if len(descriptors) == len(ports):
        select.select(descriptors, (), (), max(0, until_ns - clock.now_ns()) * 1e-9)
        return
    for port in ports:
        end_ns = min(until_ns, clock.now_ns() + _SLICE_NS)
        port.wait(end_ns)
        if clock.now_ns() < end_ns:  # something is there
            return


class JoinedPort(PlainPort):
    """A port on several buses.

    Args:
        ports: by channel; all on one clock.
        routes: channel of each identifier that belongs to one bus alone.
    """

    def __init__(self, ports: Mapping[str, Port], routes: Mapping[int, str]) -> None:
        self._ports = dict(ports)
        self._routes = {can_id: self._ports[channel] for can_id, channel in routes.items()}
        self._arrived: list[TimedFrame] = []
        self._lost: set[str] = set()
        self.clock = next(iter(ports.values())).clock
        self.channel = "+".join(ports)
        self.stamps_arrival = all(port.stamps_arrival for port in ports.values())

    @property
    def counters(self) -> PortCounters:
        """What has passed through all of them; each of them notices a step of the one wall clock."""
        every = [port.counters for port in self._ports.values()]
        total = PortCounters(*(sum(getattr(one, field.name) for one in every) for field in fields(PortCounters)))
        total.clock_steps = max(one.clock_steps for one in every)
        return total

    @property
    def state(self) -> ControllerState:
        """The worst of their controllers' states."""
        return max(port.state for port in self._ports.values())

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send each frame on the bus of its identifier, or on all.

        Raises:
            InterfaceError: a bus is down, closed, lost or stays full; the others have their frames. Each is reported
                once, as long as there is another.
        """

        def send(port: Port) -> None:
            mine = [frame for frame in frames if self._routes.get(frame[0], port) is port]
            if mine:
                port.send_batch(mine, t_ns)

        self._on_each(send)

    def send_on(self, channel: str, frames: Sequence[Frame]) -> None:
        """Send frames on one bus, whoever else has their identifiers."""
        self._on_each(lambda port: port.send_batch(frames) if port is self._ports[channel] else None)

    def drain(self) -> list[TimedFrame]:
        """Return every frame that has arrived on any bus, by time.

        Raises:
            InterfaceError: as `send_batch`; what came on the others is kept for the next call.
        """
        self._take()
        frames, self._arrived = self._arrived, []
        return frames

    def wait(self, until_ns: int) -> None:
        """Return as soon as a frame is there on any bus, at `until_ns` at the latest."""
        clock = self.clock
        self._take()
        while not self._arrived and clock.now_ns() < until_ns:
            wait_for_any([port for name, port in self._ports.items() if name not in self._lost], until_ns)
            self._take()

    def close(self) -> None:
        """Close all of them."""
        for port in self._ports.values():
            port.close()

    def _take(self) -> None:
        new: list[TimedFrame] = []
        try:
            self._on_each(lambda port: new.extend(port.drain()))
        finally:
            if new:
                self._arrived = sorted([*self._arrived, *new], key=_time)

    def _on_each(self, act: Callable[[Port], None]) -> None:
        """Do it on every bus, then raise the first failure that is news; on lost ones too, as they may come back."""
        news: InterfaceError | None = None
        failed: set[str] = set()
        for name, port in self._ports.items():
            try:
                act(port)
            except InterfaceError as error:
                failed.add(name)
                if name not in self._lost:
                    news = news or error
                last = error
        self._lost |= failed
        if news is not None:
            raise news
        if failed and len(self._lost) == len(self._ports):
            raise last


def _time(frame: TimedFrame) -> int:
    return frame[2]


def send_on(port: Port, channel: str, frames: Sequence[Frame]) -> None:
    """Send frames on the bus of a channel, whether the port is on that one alone or on several."""
    if isinstance(port, JoinedPort):
        port.send_on(channel, frames)
    else:
        port.send_batch(frames)
