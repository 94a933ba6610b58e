"""CAN FD frames through the ports: the kernel's structures byte by byte, and python-can's messages."""

from __future__ import annotations

import socket
import struct
import uuid

import can
import pytest

from canprobe.errors import InterfaceError
from canprobe.fieldbus import MonotonicClock, open_port
from canprobe.fieldbus.bus.real.mmsg import FrameSocket

LONG = bytes(range(64))
FRAMES = [(0x181, b"\x01\x02"), (0x512, LONG), (0x80, b""), (0x513, LONG[:12])]
# include/uapi/linux/can.h: canid_t, len, flags, __res0, __res1, data; a can_frame is 16 bytes, a canfd_frame 72
RAW = [
    struct.pack("=IBBBB8s", 0x181, 2, 0, 0, 0, b"\x01\x02"),
    struct.pack("=IBBBB64s", 0x512, 64, 0x01, 0, 0, LONG),
    struct.pack("=IBBBB8s", 0x80, 0, 0, 0, 0, b""),
    struct.pack("=IBBBB64s", 0x513, 12, 0x01, 0, 0, LONG[:12]),
]


@pytest.fixture
def pair():
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
    yield ends
    for end in ends:
        end.close()


def test_frames_are_the_kernels_structures(pair):
    one, two = pair
    frames = FrameSocket(one, fd=True)
    left = FRAMES
    while left:
        left = left[frames.send(left) :]
    assert [two.recv(100) for _ in FRAMES] == RAW
    for raw in RAW:
        two.send(raw)
    assert [row[:2] for row in frames.receive()] == FRAMES
    assert frames.receive() == []


def test_more_than_a_batch_keeps_each_length(pair):
    one, two = pair
    sender, receiver = FrameSocket(one, fd=True), FrameSocket(two, fd=True)
    wanted = [(0x181 + k, LONG if k % 3 == 0 else LONG[: k % 9]) for k in range(100)]
    sent = sender.send(wanted)
    sent += sender.send(wanted[sent:])
    assert sent == 100
    assert [row[:2] for row in receiver.receive()] == wanted


@pytest.fixture
def ports():
    channel = uuid.uuid4().hex
    clock = MonotonicClock()
    made = [
        open_port("virtual", channel, 1_000_000, clock, data_bitrate=5_000_000),
        open_port("virtual", channel, 1_000_000, clock, data_bitrate=5_000_000),
        open_port("virtual", channel, 1_000_000, clock),
    ]
    yield made
    for port in made:
        port.close()


def test_python_can_carries_long_frames_where_they_are_wanted(ports):
    one, two, classic = ports
    one.send_batch(FRAMES)
    assert [frame[:2] for frame in two.drain()] == FRAMES
    assert [frame[:2] for frame in classic.drain()] == [FRAMES[0], FRAMES[2]]
    assert classic.counters.ignored == 2
    with pytest.raises(InterfaceError, match="64 bytes is no classic CAN frame"):
        classic.send_batch([(0x512, LONG)])
    with pytest.raises(InterfaceError, match="13 bytes is no CAN or CAN FD frame"):
        one.send_batch([(0x512, LONG[:13])])


def test_only_long_frames_are_marked_as_fd(ports):
    one, *_ = ports
    with can.Bus(interface="virtual", channel=one.channel) as witness:
        one.send_batch(FRAMES)
        seen = [witness.recv(1.0) for _ in FRAMES]
    assert [(message.is_fd, message.bitrate_switch) for message in seen] == [
        (False, False), (True, True), (False, False), (True, True),
    ]  # fmt: skip
