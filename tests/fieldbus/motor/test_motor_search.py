"""Finding motors on a bus by reading, and what is sent for it."""

from __future__ import annotations

import pytest

from canprobe.errors import UsageError
from canprobe.fieldbus import LockstepBus, VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.protocol import REGISTER_ID, RegisterOp, Rid
from canprobe.fieldbus.motor.search import find_motors


class Sender(Participant):
    """Sends frames once, and keeps what it hears."""

    next_deadline_ns: int | None = 10_000_000

    def __init__(self, *frames):
        self.frames, self.heard = frames, []

    def advance(self, t_ns):
        if self.next_deadline_ns is None or t_ns < self.next_deadline_ns:
            return []
        self.next_deadline_ns = None
        return list(self.frames)

    def receive(self, can_id, data, t_ns):
        self.heard.append((can_id, data))
        return []


def bus_with(*participants):
    bus = LockstepBus(VirtualClock())
    for one in participants:
        bus.attach(one)
    return bus.port()


def test_motors_are_found_with_what_their_registers_say():
    large, other = DamiaoMotor("dm8009", 1, 0x11), DamiaoMotor("dm4310", 7)
    port = bus_with(other, large)
    large.registers[Rid.TIMEOUT] = 300
    other.registers[Rid.VMAX] = 8.5
    one, seven = find_motors(port)
    assert (one["motor_id"], one["mst_id"], one["types"]) == (1, 0x11, ["dm8009"])
    assert (one["ranges"], one["timeout_ms"], one["mode"], one["devices"]) == ([12.5, 45.0, 54.0], 15.0, "MIT", 1)
    assert (seven["motor_id"], seven["mst_id"], seven["types"], seven["timeout_ms"]) == (7, 0, [], 0.0)


def test_two_motors_of_one_id_are_counted():
    (found,) = find_motors(bus_with(DamiaoMotor("dm4310", 3), DamiaoMotor("dm4310", 3)))
    assert found["devices"] == 2


def test_nothing_is_sent_but_reading():
    """Frames on 7FFh set ids, write, store, and start the bootloader: none of those, on no other identifier."""
    ear, motor = Sender(), DamiaoMotor("dm4310", 1, 0x11)
    before = dict(motor.registers)
    find_motors(bus_with(ear, motor))
    sent = [frame for frame in ear.heard if frame[0] != 0x11]
    assert len(sent) == 127 + 5
    assert all(can_id == REGISTER_ID and len(data) == 8 and data[2] == RegisterOp.READ for can_id, data in sent)
    assert motor.registers == before


@pytest.mark.parametrize(
    ("frame", "refused"),
    [
        ((0x705, b"\x05"), True),
        ((0x080, b""), True),
        ((0x185, bytes(8)), True),
        ((0x000, b"\x01\x00"), True),
        ((0x000, bytes(8)), False),  # an answer of a motor at its factory setting
        ((0x011, bytes(8)), False),
        ((0x201, bytes(4)), False),  # a velocity from another master
    ],
)
def test_where_canopen_is_heard_nothing_is_sent(frame, refused):
    sender = Sender(frame)
    port = bus_with(sender)
    if refused:
        with pytest.raises(UsageError, match=f"{frame[0]:03X}h is heard on .*; give motors a bus of their own"):
            find_motors(port)
        assert sender.heard == []
    else:
        assert find_motors(port) == []


def test_any_answers_are_read_without_an_error():
    odd = [(0x11, b"\x01\x00\x33"), (0x11, b"\x01\x00\x33\xff" + bytes(4)), (0x11, b""), (0x12, b"\x02\x00\x33\x07")]
    assert find_motors(bus_with(Sender(*odd))) == []
