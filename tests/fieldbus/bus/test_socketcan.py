"""What only a real SocketCAN interface shows: overruns, error frames, a full queue, a link that goes down."""

from __future__ import annotations

import errno
import os
import socket
import struct
import subprocess
import time
from collections.abc import Iterator, Sequence

import pytest

from canprobe.errors import InterfaceError
from canprobe.fieldbus import MonotonicClock, SocketCanPort, VirtualClock
from canprobe.fieldbus.bus.port import ERR_FLAG, ControllerState, Reports, TimedFrame
from canprobe.fieldbus.bus.real.mmsg import Row
from canprobe.fieldbus.bus.real.python_can import PythonCanPort
from canprobe.fieldbus.protocol.frames import EFF_FLAG, Frame
from canprobe.fieldbus.vcan.guest_setup import make_link, set_link

pytestmark = pytest.mark.vcan

HOUR_NS = 3600 * 10**9


@pytest.fixture
def link() -> Iterator[str]:
    """A second interface that a test may break; needs the rights of root, which a guest always has."""
    try:
        make_link("vcan7", "vcan")
    except PermissionError:
        pytest.skip("making a link needs CAP_NET_ADMIN")
    set_link("vcan7", up=True)
    yield "vcan7"
    subprocess.run(["ip", "link", "delete", "vcan7"], check=True)


def receive(port: SocketCanPort | PythonCanPort, count: int) -> list[TimedFrame]:
    frames: list[TimedFrame] = []
    while len(frames) < count:
        port.wait(port.clock.now_ns() + HOUR_NS)
        frames += port.drain()
    return frames


def test_deferred_frames_wake_nobody_and_come_in_their_place(vcan0: str) -> None:
    clock = MonotonicClock()
    sender, ours = SocketCanPort(vcan0, clock), SocketCanPort(vcan0, clock)
    ours.defer({0x201, 0x202})
    sender.send_batch([(0x201, b"a"), (0x202, b"b")])
    assert [(i, d) for i, d, _ in ours.wait_and_drain(0)] == [(0x201, b"a"), (0x202, b"b")]  # at its time-out
    sender.send_batch([(0x201, b"c"), (0x080, b""), (0x202, b"d"), (0x201 | EFF_FLAG, b"e")])
    frames: list[TimedFrame] = []
    while len(frames) < 4:
        frames += ours.wait_and_drain(0)
    assert [(i, d) for i, d, _ in frames][-4:] == [(0x201, b"c"), (0x080, b""), (0x202, b"d"), (0x201 | EFF_FLAG, b"e")]
    ours.defer(())
    sender.send_batch([(0x201, b"f")])
    assert [(i, d) for i, d, _ in receive(ours, 1)] == [(0x201, b"f")]
    ours.close()
    sender.close()
    with pytest.raises(InterfaceError, match="closed"):
        ours.defer({0x201})


def test_dropped_frames_are_counted(vcan0: str) -> None:
    clock = MonotonicClock()
    sender, late = SocketCanPort(vcan0, clock), SocketCanPort(vcan0, clock)
    late._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 20_000)
    batch = [(0x100 + k, b"") for k in range(200)]
    sender.send_batch(batch)
    late.wait(clock.now_ns() + 5_000_000_000)  # a busy kernel hands frames over later,
    time.sleep(0.05)  # and in several portions
    first = late.drain()
    assert 0 < len(first) < 200, "the buffer is smaller than the batch"
    sender.send_batch([(0x7FF, b"")])  # the count travels with the next frame
    assert [i for i, _, _ in receive(late, 1)] == [0x7FF]
    assert late.counters.overruns == 200 - len(first)
    sender.close()
    late.close()


ACTIVE, WARNING, PASSIVE, OFF = ControllerState


@pytest.mark.parametrize(
    ("can_id", "data", "expected"),
    [  # linux/can/error.h: class bits, the second byte of CAN_ERR_CRTL → bus errors, lost frames, state
        pytest.param(0x008, b"", (1, 0, ACTIVE), id="PROT"),
        pytest.param(0x020, b"", (1, 0, ACTIVE), id="ACK"),
        pytest.param(0x080, b"", (1, 0, ACTIVE), id="BUSERROR"),
        pytest.param(0x0A8, b"", (1, 0, ACTIVE), id="PROT+ACK+BUSERROR"),
        pytest.param(0x08C, b"\0\x20", (1, 0, PASSIVE), id="BUSERROR+TX_PASSIVE"),
        pytest.param(0x001, b"", (0, 0, ACTIVE), id="TX_TIMEOUT"),
        pytest.param(0x002, b"", (0, 0, ACTIVE), id="LOSTARB"),
        pytest.param(0x010, b"", (0, 0, ACTIVE), id="TRX"),
        pytest.param(0x004, b"\0\x01", (0, 1, ACTIVE), id="RX_OVERFLOW"),
        pytest.param(0x004, b"\0\x02", (0, 1, ACTIVE), id="TX_OVERFLOW"),
        pytest.param(0x004, b"\0\x04", (0, 0, WARNING), id="RX_WARNING"),
        pytest.param(0x004, b"\0\x08", (0, 0, WARNING), id="TX_WARNING"),
        pytest.param(0x204, b"\0\x10\0\0\0\0\0\x80", (0, 0, PASSIVE), id="RX_PASSIVE+CNT"),
        pytest.param(0x004, b"\0\x20", (0, 0, PASSIVE), id="TX_PASSIVE"),
        pytest.param(0x040, b"", (0, 0, OFF), id="BUSOFF"),
    ],
)
def test_error_frames_are_read_by_their_classes(
    vcan0: str, can_id: int, data: bytes, expected: tuple[int, int, ControllerState]
) -> None:
    told: list[tuple[int, bytes]] = []
    clock, reports = MonotonicClock(), Reports(error_frame=lambda i, d, _: told.append((i, d)))
    theirs = PythonCanPort("socketcan", vcan0, 1_000_000, clock, reports=reports)
    ports = [SocketCanPort(vcan0, clock, reports=reports), theirs]
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as raw:
        raw.bind((vcan0,))

        def send(*frames: Frame) -> None:
            for i, d in (*frames, (0x123, b"")):
                raw.send(struct.pack("=IB3x8s", i, 8, d))
            for port in ports:
                assert [i for i, _, _ in receive(port, 1)] == [0x123], "error frames are no frames"

        send((can_id | ERR_FLAG, data))
        assert told == [(can_id | ERR_FLAG, data.ljust(8, b"\0"))] * 2
        assert [(p.counters.error_frames, p.counters.overruns, p.state) for p in ports] == [expected] * 2
        send((0x004 | ERR_FLAG, b"\0\x40"))
        assert [p.state for p in ports] == [ACTIVE] * 2
        send((0x040 | ERR_FLAG, b""), (0x100 | ERR_FLAG, b""))
        assert [p.state for p in ports] == [ACTIVE] * 2, "bus-off, then restarted"
    for port in ports:
        port.close()


class FullQueue:
    """Refuses frames a number of times, then takes two frames a call."""

    def __init__(self, full: int, number: int = errno.ENOBUFS) -> None:
        self.full, self.taken, self.number = full, list[Frame](), number

    def receive(self) -> list[Row]:
        return []

    def send(self, frames: Sequence[Frame]) -> int:
        if self.full:
            self.full -= 1
            raise OSError(self.number, os.strerror(self.number))
        self.taken += frames[:2]
        return len(frames[:2])


def test_a_full_queue_is_waited_for_then_an_error(vcan0: str, monkeypatch: pytest.MonkeyPatch) -> None:
    queue = FullQueue(3)
    monkeypatch.setattr("canprobe.fieldbus.bus.real.socketcan.FrameSocket", lambda *_: queue)
    port = SocketCanPort(vcan0, VirtualClock())  # a machine that stands still is no full queue
    batch = [(0x100 + k, b"") for k in range(5)]
    port.send_batch(batch)
    assert (queue.taken, port.counters.transmit_full, port.counters.sent) == (batch, 3, 5)
    port.close()


def test_what_stays_full_is_named_and_a_longer_queue_advised_where_it_is_short(
    link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = FullQueue(10**6)
    monkeypatch.setattr("canprobe.fieldbus.bus.real.socketcan.FrameSocket", lambda *_: full)
    port = SocketCanPort(link, MonotonicClock())
    why = "stays full, as nobody acknowledges or the bus is overloaded, 5 frames not sent"
    queue, buffer = f"vcan7: the transmit queue {why}", f"vcan7: the socket's send buffer {why}"
    short = f"{queue}; it holds 10 frames; type: ip link set vcan7 txqueuelen 1000"
    for length, number, told in (
        (10, errno.ENOBUFS, short),
        (1000, errno.ENOBUFS, queue),
        (10, errno.EAGAIN, buffer),
        (1000, errno.EAGAIN, buffer),
    ):
        subprocess.run(["ip", "link", "set", link, "txqueuelen", str(length)], check=True)
        full.number = number
        with pytest.raises(InterfaceError) as caught:
            port.send_batch([(0x100 + k, b"") for k in range(5)])
        assert str(caught.value) == told
    port.close()


def test_a_link_that_goes_down_is_named(link: str) -> None:
    clock = MonotonicClock()
    port = SocketCanPort(link, clock)
    set_link(link, up=False)
    port.wait(clock.now_ns() + HOUR_NS)  # ends at once: there is something to be told
    with pytest.raises(InterfaceError, match=r"vcan7: interface is down; type: .*ip link set vcan7 up"):
        port.drain()
    with pytest.raises(InterfaceError, match="vcan7: interface is down"):
        port.send_batch([(0x123, b"")])
    port.close()
    with pytest.raises(InterfaceError, match="vcan7: interface is down"):
        SocketCanPort(link, clock)
