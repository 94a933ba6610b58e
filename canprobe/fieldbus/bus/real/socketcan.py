"""A `Port` on a SocketCAN interface with a raw socket: bursts of frames in one system call, kernel time stamps.

Time stamps are those of the kernel at reception (CLOCK_REALTIME), converted to CLOCK_MONOTONIC by the difference of the
two clocks. The difference is measured again after each sending (`StampClock`), so that a wall clock that is set is
noticed and counted. Whatever the wall clock says, a frame is never older than the look before the last one, nor of the
future: deadlines and ages are derived from times that the monotonic clock has confirmed.
29-bit identifiers and remote requests are passed with `EFF_FLAG` and `RTR_FLAG`. With a data bit rate frames of more
than 8 bytes are CAN FD frames with bit-rate switch; without it none are received.

What the controller cannot send waits in two places: the interface's transmit queue (`txqueuelen`; ENOBUFS when it is
full) and, counted in bytes, the socket's send buffer (about 277 frames; EAGAIN). Closing the socket empties neither.
"""

from __future__ import annotations

import errno
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Collection, Sequence
from itertools import accumulate
from operator import itemgetter

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.clock import Clock
from canprobe.fieldbus.bus.port import (
    ERR_FLAG,
    ControllerState,
    PlainPort,
    PortCounters,
    Reports,
    TimedFrame,
    state_after,
)
from canprobe.fieldbus.bus.real import link
from canprobe.fieldbus.bus.real.mmsg import SO_RXQ_OVFL, SO_TIMESTAMPNS, FrameSocket, Row
from canprobe.fieldbus.bus.system import system
from canprobe.fieldbus.protocol.frame_bits import FD_LENGTHS
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, EFF_FLAG, RTR_FLAG, Frame

_SOL_CAN_RAW = 101
_CAN_RAW_FILTER = 1
_CAN_RAW_ERR_FILTER = 2
_CAN_RAW_FD_FRAMES = 5
_CAN_RAW_JOIN_FILTERS = 6
_CAN_INV_FILTER = 0x20000000
_SINGLE_WAIT_US = 2000  # how late a deadline may be served on an idle bus
_CAN_ERR_MASK = 0x1FFFFFFF
_SO_RCVBUFFORCE = 33
_SO_MEMINFO, _MEMINFO, _WMEM_ALLOC = 55, struct.Struct("=9I"), 2
_SIOCGIFFLAGS = 0x8913
_SIOCGIFMTU = 0x8921
_SIOCGIFTXQLEN = 0x8942
_IFF_UP = 0x1
_RECEIVE_BUFFER_BYTES = 4 << 20
_RETRY_S, _LATER_RETRY_S = 200e-6, 2e-3
_MAX_QUEUE_WAIT_NS = 10_000_000
_REPORTED_WAIT_NS = 1_000_000_000
"""Time of a full queue after which a port that waits reports it."""
_MAX_STUCK_NS, _MAX_LINGER_NS = 100_000_000, 1_000_000_000
"""Longest time that a port which closes waits for the next queued frame to leave, and for all of them."""
_COMPARISON_PERIOD_NS = 1_000_000
"""Time of stamps after which the two clocks are compared again: less than a cycle."""
_CLOCK_READING_ERROR_NS = 50_000
"""Largest difference of the clocks that counts as none: in a virtual machine it takes so long to read both clocks. No
TPDO follows its SYNC sooner."""


class StampClock:
    """Brings stamps of CLOCK_REALTIME to CLOCK_MONOTONIC, and notices when the wall clock was set.

    NTP slows down and speeds up both clocks alike, so their difference stays the same until somebody sets the wall
    clock: chrony or ntpd after a long absence, `date`, a leap second. Two readings show whether it is the same.

    Args:
        realtime_ns, monotonic_ns: functions that read the clocks.

    Attributes:
        offset_ns: realtime clock minus monotonic clock.
        since_ns, now_ns: monotonic clock at the last comparison but two, and at the last one. Frames that were read for
            the last one came in between: the look before it took all that had come until the comparison before that.
    """

    def __init__(
        self, realtime_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._realtime_ns, self._monotonic_ns = realtime_ns, monotonic_ns
        self._compared_ns = 0
        self.since_ns = self._before_ns = self.now_ns = monotonic_ns()
        self.offset_ns, _ = self._measure()

    def doubt(self) -> None:
        """Compare the clocks for the next frames, however soon they come."""
        self._compared_ns = 0

    def follow(self, oldest_ns: int, newest_ns: int) -> int:
        """Compare the clocks, unless all of these stamps are of the millisecond after the last comparison.

        A stamp of a frame that came after it and is older shows by itself that the wall clock was set back.

        Returns:
            The step of the wall clock since the last comparison, ns, negative for back; 0 where it was not set.
        """
        if self._compared_ns <= oldest_ns and newest_ns < self._compared_ns + _COMPARISON_PERIOD_NS:
            return 0
        self._compared_ns = self._realtime_ns()
        self.since_ns, self._before_ns, self.now_ns = self._before_ns, self.now_ns, self._monotonic_ns()
        if abs(self._compared_ns - self.now_ns - self.offset_ns) <= _CLOCK_READING_ERROR_NS:
            return 0
        offset_ns, doubt_ns = self._measure()  # this process may only have waited between the two readings
        step_ns = offset_ns - self.offset_ns
        if abs(step_ns) <= _CLOCK_READING_ERROR_NS + doubt_ns:
            return 0
        self.offset_ns = offset_ns
        return step_ns

    def allows(self, stamp_ns: int) -> bool:
        """Whether a frame that was read now can have come at this stamp."""
        t_ns = stamp_ns - self.offset_ns
        return self.since_ns - _CLOCK_READING_ERROR_NS <= t_ns <= self.now_ns + _COMPARISON_PERIOD_NS

    def _measure(self) -> tuple[int, int]:
        """The difference of the clocks and its uncertainty, ns, from the quickest of three readings."""
        readings = []
        for _ in range(3):
            before = self._monotonic_ns()
            realtime = self._realtime_ns()
            after = self._monotonic_ns()
            readings.append((after - before, realtime - (before + after) // 2))
        doubt_ns, offset_ns = min(readings)
        return offset_ns, doubt_ns


class SocketCanPort(PlainPort):
    """One raw socket on one interface; it does not hear itself, but it hears every other socket of this machine.

    Args:
        channel: name of the interface, such as `can0`.
        clock: clock that shows CLOCK_MONOTONIC.
        bitrate: bit rate that the interface should have, bit/s, for the lines to type; it is not checked.
        data_bitrate: data bit rate of CAN FD, whose frames are then sent and received too; None: classical frames only.
        waits: whether to wait for a full queue without a limit, as a device does for its bus; else up to 10 ms.
        reports: receivers of error frames, and of messages on a full queue and on frames that are left in it.

    Attributes:
        counters: counters of the port.
        state: state of the controller by the last error frame; ACTIVE before the first.

    Raises:
        InterfaceError: the interface is missing, down, no CAN interface, or not set up for CAN FD; the message has the
            line to type.
    """

    def __init__(
        self,
        channel: str,
        clock: Clock,
        *,
        bitrate: int = 1_000_000,
        data_bitrate: int | None = None,
        waits: bool = False,
        reports: Reports | None = None,
    ) -> None:
        self._fd = fd = data_bitrate is not None
        self._setting = link.setting_line(channel, bitrate, data_bitrate)
        self._waits = waits
        self._reports = reports or Reports()
        check_interface(channel, self._setting, fd)
        self.clock = clock
        self.channel = channel
        self.counters = PortCounters()
        self.state = ControllerState.ACTIVE
        self._socket = _open(channel, fd=fd)
        self._frames = FrameSocket(self._socket, fd)
        self._patient: socket.socket | None = None
        self._patient_frames: FrameSocket | None = None
        self._dropped = [0, 0]
        self._blocks = False
        self._stamps = StampClock(monotonic_ns=clock.now_ns)
        self._told_ns = 0

    stamps_arrival = True

    @property
    def descriptor(self) -> int:
        """Descriptor of the socket; frames that wake nobody (`defer`) do not make it readable."""
        self._check_open()
        return self._socket.fileno()

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` in order; a full queue is waited for.

        Raises:
            InterfaceError: the queue stays full, the interface is down or gone, or a frame is impossible on it.
        """
        self._check_open()
        self._stamps.doubt()  # no answer may seem older than its question
        for can_id, data in frames:
            long = len(data) > CLASSIC_BYTES and not (self._fd and len(data) in FD_LENGTHS)
            if long or (can_id > 0x7FF and can_id < ERR_FLAG):
                kind = "CAN or CAN FD" if self._fd else "classic CAN"
                raise InterfaceError(f"{self.channel}: {can_id:X} with {len(data)} bytes is no {kind} frame")
        sent = 0
        full_ns: int | None = None
        while sent < len(frames):
            try:
                sent += self._frames.send(frames[sent:] if sent else frames)
            except OSError as error:
                full_ns = self.clock.now_ns() if full_ns is None else full_ns
                self._await_room(error, full_ns, len(frames) - sent)
        self.counters.sent += sent

    def drain(self) -> list[TimedFrame]:
        """Return every frame that has arrived, with the kernel's time of its arrival."""
        self._check_open()
        return self._take(wait=False)

    def _take(self, wait: bool) -> list[TimedFrame]:
        try:
            rows = self._frames.receive(wait)
            patient = self._patient_frames.receive() if self._patient_frames is not None else None
        except OSError as error:
            raise self._failed(error) from error
        if rows:
            self._count_drops(0, rows)
        if patient:
            self._count_drops(1, patient)
        if not rows and not patient:
            return []
        stamps = [row[2] for row in (patient + rows if patient else rows)]
        oldest_ns, newest_ns = min(stamps), max(stamps)
        step_ns = self._stamps.follow(oldest_ns, newest_ns)
        if step_ns or not (self._stamps.allows(oldest_ns) and self._stamps.allows(newest_ns)):
            self._note_step(step_ns)
            rows, patient = self._stamped_anew(rows, step_ns), self._stamped_anew(patient or [], step_ns)
        if patient:
            rows = patient + rows
        if self._patient_frames is not None:
            rows = sorted(rows, key=itemgetter(2))  # by stamp
        offset_ns = self._stamps.offset_ns
        frames = [(can_id, data, t_ns - offset_ns) for can_id, data, t_ns, _ in rows if not can_id & ERR_FLAG]
        if len(frames) < len(rows):
            self._note_errors(rows, offset_ns)
        self.counters.received += len(frames)
        return frames

    def wait(self, until_ns: int) -> None:
        """Sleep until a frame is there, at `until_ns` at the latest."""
        self._check_open()
        if (left_ns := until_ns - self.clock.now_ns()) > 0:
            select.select([self._socket], (), (), left_ns * 1e-9)

    def wait_and_drain(self, until_ns: int) -> list[TimedFrame]:
        """Do `wait` and `drain` with one system call instead of three. It waits 2 ms, whatever `until_ns` is."""
        self._check_open()
        if not self._blocks:
            self._socket.setblocking(True)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("@ll", 0, _SINGLE_WAIT_US))
            self._blocks = True
        return self._take(wait=True)

    def defer(self, can_ids: Collection[int]) -> None:
        """Let frames with these 11-bit identifiers wake nobody: `drain` and `wait_and_drain` return them with the next
        other, `wait_and_drain` also at its time-out.

        Whoever has to do nothing about them before that frame (synchronous PDOs: before the SYNC) is spared a wake-up
        for each. They keep their place by their time of arrival. At a change of the identifiers a frame may come twice.

        Raises:
            InterfaceError: the interface is lost.
        """
        self._check_open()
        mask = 0x7FF | EFF_FLAG | RTR_FLAG
        if self._patient is not None:
            self._patient.close()
            self._patient = self._patient_frames = None
        if can_ids:
            self._patient = _open(self.channel, [(can_id, mask) for can_id in can_ids], fd=self._fd)
            self._patient_frames = FrameSocket(self._patient, self._fd)
        try:
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_JOIN_FILTERS, struct.pack("=I", 1))
            others = [(can_id | _CAN_INV_FILTER, mask) for can_id in can_ids] or [(0, 0)]
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, _packed(others))
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        """Close the socket once its frames have left; where none leaves any more, they are dropped.

        Sent minutes later they would be old news to nodes that come back. Without the right to drop them, the user
        hears what to type.
        """
        if self._socket.fileno() < 0:
            return
        try:
            if self._await_empty():
                return
            if link.drop_queued(self.channel):
                self._reports.say(
                    f"{self.channel}: frames that nobody acknowledged were dropped from its transmit queue"
                )
            else:
                self._reports.say(
                    f"{self.channel}: frames wait in its transmit queue that nobody acknowledges, and are sent when"
                    f" somebody does; to drop them type: {link.emptying_line(self.channel)}"
                )
        finally:
            self._socket.close()
            if self._patient is not None:
                self._patient.close()

    def _await_empty(self) -> bool:
        """Wait while the queue empties; return whether it is empty."""
        now_ns = self.clock.now_ns()
        end_ns, moved_ns, left = now_ns + _MAX_LINGER_NS, now_ns, self._queued_bytes()
        while left and self.clock.now_ns() < min(end_ns, moved_ns + _MAX_STUCK_NS):
            time.sleep(_LATER_RETRY_S)
            if (still := self._queued_bytes()) != left:
                left, moved_ns = still, self.clock.now_ns()
        return not left

    def _queued_bytes(self) -> int:
        """Number of bytes of this socket's frames that the driver has not taken yet."""
        numbers = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
        return int(_MEMINFO.unpack(numbers)[_WMEM_ALLOC])

    def _check_open(self) -> None:
        if self._socket.fileno() < 0:
            raise InterfaceError(f"{self.channel}: this port is closed")

    def _await_room(self, error: OSError, full_ns: int, left: int) -> None:
        """Sleep a little where the queue is full, since `full_ns`; raise anything else."""
        if error.errno not in (errno.ENOBUFS, errno.EAGAIN):
            raise self._failed(error) from error
        self.counters.transmit_full += 1
        full_for_ns = self.clock.now_ns() - full_ns
        if full_for_ns >= _MAX_QUEUE_WAIT_NS and not self._waits:
            why = f"{self._full_queue(error)}, {left} frames not sent{self._longer_queue(error)}"
            raise InterfaceError(why) from error
        if full_for_ns >= _REPORTED_WAIT_NS and full_ns != self._told_ns:
            self._told_ns = full_ns
            self._reports.say(f"{self._full_queue(error)}: waiting for the bus{self._longer_queue(error)}")
        time.sleep(_RETRY_S if full_for_ns < _MAX_QUEUE_WAIT_NS else _LATER_RETRY_S)

    def _full_queue(self, error: OSError) -> str:
        what = "the transmit queue" if error.errno == errno.ENOBUFS else "the socket's send buffer"
        return f"{self.channel}: {what} stays full, as nobody acknowledges or the bus is overloaded"

    def _longer_queue(self, error: OSError) -> str:
        """What to type where the queue of the interface is full and short; else empty."""
        if error.errno != errno.ENOBUFS:
            return ""
        try:
            length = struct.unpack("=16si12x", system.ioctl(self._socket, _SIOCGIFTXQLEN, _ifreq(self.channel)))[1]
        except OSError:  # the interface has gone meanwhile
            return ""
        if length >= link.TX_QUEUE_FRAMES:
            return ""
        return f"; it holds {length} frames; type: {link.ip_line(f'{self.channel} txqueuelen {link.TX_QUEUE_FRAMES}')}"

    def _failed(self, error: OSError) -> InterfaceError:
        if error.errno == errno.ENETDOWN:
            return _down(self.channel, self._setting)
        return InterfaceError(f"{self.channel}: interface lost: {error.strerror}")

    def _count_drops(self, which: int, rows: Sequence[Row]) -> None:
        dropped = max(0, rows[-1][3] - self._dropped[which])
        self._dropped[which] += dropped
        self.counters.overruns += dropped

    def _note_step(self, step_ns: int) -> None:
        self.counters.clock_steps += 1
        if self.counters.clock_steps == 1:
            way = f"{'back' if step_ns < 0 else 'forward'} by {abs(step_ns) * 1e-6:.1f} ms" if step_ns else "to and fro"
            what = f"the wall clock was set {way}"
            self._reports.say(f"{self.channel}: {what}; frames keep their time, further times are only counted")

    def _stamped_anew(self, rows: Sequence[Row], step_ns: int) -> list[Row]:
        """Stamp the frames of a socket anew after the wall clock was set; some came before that, some after it.

        A stamp may mean two times. The later one that is possible is taken: it is right, or late by less than the step.
        Where none is possible, as after two steps, the frame came now. No frame gets older than it is, and their order
        stays.
        """
        stamps = self._stamps
        now_ns = self.clock.now_ns() + stamps.offset_ns
        since_ns = stamps.since_ns - _CLOCK_READING_ERROR_NS + stamps.offset_ns
        times = (
            max((t for t in (row[2], row[2] + step_ns) if since_ns <= t <= now_ns), default=now_ns) for row in rows
        )
        return [(row[0], row[1], t_ns, row[3]) for row, t_ns in zip(rows, accumulate(times, max), strict=True)]

    def _note_errors(self, rows: Sequence[Row], offset_ns: int) -> None:
        for can_id, data, t_ns, _ in rows:
            if can_id & ERR_FLAG:
                self.counters.note_error(can_id, data)
                self.state = state_after(self.state, can_id, data)
                self._reports.error_frame(can_id, data, t_ns - offset_ns)


NO_SOCKETCAN = "this kernel has no SocketCAN" + (
    "; a virtual machine with a real vcan0 runs any COMMAND: canprobe vcan -- COMMAND"
    if sys.platform == "linux"
    else ", which is Linux's"
)


def has_socketcan() -> bool:
    """Return whether this kernel and this Python have SocketCAN; load the module if that is allowed."""
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
    except (AttributeError, OSError):
        return False
    return True


def check_interface(channel: str, setting: str | None = None, fd: bool = False) -> None:
    """Return if `channel` is a CAN interface that is up.

    Args:
        channel: name of the interface.
        setting: line to type that sets it up; None where it needs no setting.
        fd: whether it has to carry CAN FD frames.

    Raises:
        InterfaceError: the interface is missing, down, no CAN interface or not set up for CAN FD; the message has the
            line to type.
    """
    if not has_socketcan():
        raise InterfaceError(
            f"{channel}: {NO_SOCKETCAN}; without one `canprobe run` takes --bus lockstep (virtual time), and `canprobe"
            " adapters` shows what else works here"
        )
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as probe:
        try:
            flags = struct.unpack("=16sH14x", system.ioctl(probe, _SIOCGIFFLAGS, _ifreq(channel)))[1]
            mtu = struct.unpack("=16si12x", system.ioctl(probe, _SIOCGIFMTU, _ifreq(channel)))[1]
        except OSError as error:
            raise InterfaceError(f"{channel}: no such interface; {how_to_make(channel)}") from error
        try:
            probe.bind((channel,))
        except OSError as error:
            raise InterfaceError(f"{channel}: not a CAN interface: {error.strerror}") from error
        if not flags & _IFF_UP:
            raise _down(channel, setting or link.ip_line(f"{channel} up"))
    if fd and mtu < link.FD_MTU_BYTES:
        raise InterfaceError(f"{channel}: not set up for CAN FD; type: {setting}")


def _ifreq(channel: str) -> bytes:
    name = os.fsencode(channel)
    if not 0 < len(name) < 16:
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))
    return struct.pack("=16sH14x", name, 0)


def _down(channel: str, setting: str) -> InterfaceError:
    return InterfaceError(f"{channel}: interface is down; type: {setting}")


def how_to_make(channel: str) -> str:
    """What to type where an interface is missing."""
    if channel.startswith("vcan"):
        return f"type: {link.sudo()}ip link add dev {channel} type vcan && {link.setting_line(channel, 1_000_000)}"
    return "is the adapter plugged in? `canprobe adapters` lists the interfaces that there are"


def _open(channel: str, only: Sequence[tuple[int, int]] | None = None, *, fd: bool) -> socket.socket:
    """A raw socket for all frames and error frames, or only for those with `can_id & mask == id & mask`: (id, mask)."""
    sock = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    try:
        sock.setblocking(False)
        if fd:
            sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, struct.pack("=i", 1))
        if only is not None:
            sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, _packed(only))
        sock.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, struct.pack("=I", _CAN_ERR_MASK if only is None else 0))
        sock.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        sock.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)
        _enlarge_buffer(sock)
        sock.bind((channel,))
    except OSError as error:
        sock.close()
        raise InterfaceError(f"{channel}: cannot be opened: {error.strerror}") from error
    return sock


def _packed(filters: Sequence[tuple[int, int]]) -> bytes:
    return b"".join(struct.pack("=II", can_id, mask) for can_id, mask in filters)


def _enlarge_buffer(sock: socket.socket) -> None:
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BUFFER_BYTES)
    except PermissionError:  # needs CAP_NET_ADMIN; without it the kernel caps the size at net.core.rmem_max
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
