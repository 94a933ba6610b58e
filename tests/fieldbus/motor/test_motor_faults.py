"""Motors on the bus of a test, beside nodes, with the faults that `canprobe inject` throws."""

from __future__ import annotations

import math
import struct

import pytest

from canprobe.errors import UsageError
from canprobe.fieldbus.motor.protocol import (
    REGISTER_ID,
    SPECIAL,
    TYPES,
    Feedback,
    MitCommand,
    MotorStatus,
    RegisterOp,
    Rid,
    Special,
    pack_register,
)
from canprobe.fieldbus.tools.faults.motor_faults import MOTOR_FAULTS

MS = 1_000_000
DM4310 = TYPES["dm4310"]


class Line:
    """Motors 1 and 3 on a bus, and a port that commands them."""

    def __init__(self, bus, emulated_motors):
        self.bus, self.port = bus, bus.port()
        self.motors = [*emulated_motors("damiao:dm4310"), *emulated_motors("damiao:dm4310", first_id=3)]

    def feedback(self, motor_id, data=SPECIAL + b"\xfc", ms=1.0):
        """The only answer to a frame; None where there is none."""
        self.port.drain()
        self.port.send_batch([(motor_id, data)])
        self.bus.clock.sleep_until_ns(self.bus.clock.now_ns() + round(ms * MS))
        frames = self.port.drain()
        assert {can_id for can_id, _, _ in frames} <= {0x10 + motor_id}
        return Feedback.unpack(frames[0][1], DM4310) if frames else None

    def pass_ms(self, ms):
        self.bus.clock.sleep_until_ns(self.bus.clock.now_ns() + ms * MS)


@pytest.fixture
def line(emulated_bus, emulated_motors):
    return Line(emulated_bus, emulated_motors)


def test_motors_hear_their_own_commands_alone(line):
    assert line.feedback(1).status == MotorStatus.ENABLED
    assert line.feedback(3, bytes(8)).status == MotorStatus.DISABLED
    assert line.feedback(1, MitCommand(p=0.2, kp=50, kd=1).pack(DM4310), ms=500).status == MotorStatus.ENABLED
    assert line.feedback(1).p == pytest.approx(0.2, abs=2e-3)
    assert line.feedback(3).p == pytest.approx(0.0, abs=1e-3)


def test_a_mute_motor_hears_and_says_nothing(line):
    line.feedback(1)
    fault = line.bus.inject("motor 1: mute")
    assert line.feedback(1, MitCommand(p=0.2, kp=50, kd=1).pack(DM4310), ms=500) is None
    assert line.feedback(3).status == MotorStatus.ENABLED
    line.bus.end(fault)
    assert line.feedback(1).p == pytest.approx(0.2, abs=2e-3)


def test_after_a_brown_out_the_motor_is_disabled_and_says_nothing_of_it(line):
    line.feedback(1)
    line.bus.inject("motor 1: brown-out at 10 ms")
    line.pass_ms(20)
    assert line.port.drain() == []
    assert line.feedback(1, bytes(8)).status == MotorStatus.DISABLED


@pytest.mark.parametrize(
    ("name", "delay_ms", "status", "rotor_deg_c"),
    [
        ("over-voltage", 1000, MotorStatus.OVERVOLTAGE, 30),
        ("under-voltage", 250, MotorStatus.UNDERVOLTAGE, 30),
        ("over-temperature deg_c=130", 400, MotorStatus.ROTOR_OVERTEMPERATURE, 130),
    ],
)
def test_what_is_outside_of_its_limits_trips_after_its_delay(line, name, delay_ms, status, rotor_deg_c):
    line.feedback(1)
    fault = line.bus.inject(f"motor 1: {name}")
    line.pass_ms(delay_ms - 10)
    assert line.feedback(1, bytes(8)).status == MotorStatus.ENABLED
    line.pass_ms(20)
    tripped = line.feedback(1, bytes(8))
    assert (tripped.status, tripped.t_rotor) == (status, rotor_deg_c)
    line.bus.end(fault)
    line.feedback(1, SPECIAL + bytes((Special.CLEAR,)))
    assert line.feedback(1).status == MotorStatus.ENABLED


def test_a_fault_that_a_test_plans_waits_for_its_motor(emulated_bus, faults, emulated_motors):
    faults.inject("motor 2: mute")
    emulated_motors("damiao:dm4310", first_id=2)
    port = emulated_bus.port()
    port.send_batch([(2, SPECIAL + b"\xfc")])
    emulated_bus.clock.sleep_until_ns(emulated_bus.clock.now_ns() + MS)
    assert port.drain() == []


def test_a_watchdog_trips_although_frames_come_and_the_fault_is_latched(line):
    line.feedback(1)
    line.bus.inject("motor 1: watchdog-trip at 10 ms")
    line.pass_ms(20)
    assert line.feedback(1).status == MotorStatus.COMMUNICATION_LOST
    line.feedback(1, SPECIAL + bytes((Special.CLEAR,)))
    assert line.feedback(1).status == MotorStatus.ENABLED


def test_a_motor_that_is_disabled_has_no_watchdog_to_trip(line):
    line.bus.inject("motor 1: watchdog-trip")
    assert line.feedback(1, bytes(8)).status == MotorStatus.DISABLED


def test_with_other_ranges_a_motor_is_elsewhere_and_its_feedback_does_not_show_it(line):
    line.feedback(1)
    fault = line.bus.inject("motor 1: wrong-range ratio=0.5")
    line.feedback(1, MitCommand(p=0.4, kp=50, kd=1).pack(DM4310), ms=500)
    assert line.feedback(1).p == pytest.approx(0.4, abs=5e-3)
    line.bus.end(fault)
    assert line.feedback(1).p == pytest.approx(0.2, abs=5e-3)


def test_ranges_that_a_master_wrote_meanwhile_stay(line):
    fault = line.bus.inject("motor 1: wrong-range")
    line.port.send_batch([(REGISTER_ID, pack_register(1, RegisterOp.WRITE, Rid.PMAX, struct.pack("<f", 6.0)))])
    line.bus.end(fault)
    line.pass_ms(1)
    assert line.motors[0].motor.registers[Rid.PMAX] == 6.0


def test_a_position_is_off_by_whole_turns(line):
    line.feedback(1)
    line.bus.inject("motor 1: encoder-wrap turns=-1")
    assert line.feedback(1, bytes(8)).p == pytest.approx(-math.tau, abs=2e-3)


def test_a_fault_waits_for_a_motor_to_be_enabled(line):
    line.bus.inject("motor 1: mute on enabled for 100 ms")
    assert line.feedback(1, bytes(8)) is not None
    line.feedback(1)
    assert line.feedback(1) is None
    line.pass_ms(100)
    assert line.feedback(1) is not None


@pytest.mark.parametrize("text", ["motor 1: heartbeat-off", "motor 1: drive-fault", "motor 1: sdo-silent"])
def test_a_fault_of_a_service_that_a_motor_does_not_have_is_refused(line, text):
    with pytest.raises(UsageError, match=r"cannot happen to motor 1; .*brown-out"):
        line.bus.inject(text)


def test_a_fault_of_a_motor_cannot_happen_to_a_node(line, emulated_nodes):
    emulated_nodes("puma260_joint", first_id=5)
    with pytest.raises(UsageError, match="cannot happen to node 5"):
        line.bus.inject("node 5: brown-out")


@pytest.mark.parametrize("name", MOTOR_FAULTS)
@pytest.mark.parametrize("bound", ["low", "high"])
def test_every_kind_begins_and_ends_on_a_motor_at_both_ends_of_its_numbers(line, name, bound):
    values = "".join(f" {key}={getattr(one, bound)}" for key, one in MOTOR_FAULTS[name].parameters.items())
    line.bus.inject(f"motor 1: {name}{values} for 20 ms")
    for _ in range(4):
        line.port.send_batch([(1, SPECIAL + b"\xfc"), (1, bytes(8))])
        line.pass_ms(10)
    assert line.motors[0].spans
    assert line.feedback(3).status == MotorStatus.ENABLED
