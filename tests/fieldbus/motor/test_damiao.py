"""An emulated Damiao motor, as a master sees it: frames and times in, frames out."""

from __future__ import annotations

import random
import struct

import pytest

from canprobe.errors import UsageError
from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.on_bus import motors_on_bus
from canprobe.fieldbus.motor.protocol import (
    REGISTER_ID,
    REGISTERS,
    SPECIAL,
    TICK_NS,
    TYPES,
    Feedback,
    MitCommand,
    Mode,
    MotorStatus,
    RegisterOp,
    Rid,
    Special,
    pack_register,
    pack_target,
)

MS = 1_000_000
S = 1_000 * MS
DM4310 = TYPES["dm4310"]


class Master:
    """Talks to one motor, by its own clock."""

    def __init__(self, motor, esc_id=1):
        self.motor, self.esc_id, self.now_ns = motor, esc_id, 0

    def send(self, can_id, data):
        return self.motor.receive(can_id, data, self.now_ns)

    def special(self, special):
        return self.answer(self.esc_id, SPECIAL + bytes((special,)))

    def mit(self, *numbers, **named):
        return self.answer(self.esc_id, MitCommand(*numbers, **named).pack(DM4310))

    def answer(self, can_id, data):
        ((_, answered),) = self.send(can_id, data)
        return Feedback.unpack(answered, DM4310)

    def register(self, op, rid, raw=bytes(4)):
        return self.send(REGISTER_ID, pack_register(self.esc_id, op, rid, raw))

    def read(self, rid):
        ((_, answer),) = self.register(RegisterOp.READ, rid)
        return struct.unpack(REGISTERS[rid].form, answer[4:])[0]

    def write(self, rid, value):
        """Write, and return the value that is effective."""
        ((_, answer),) = self.register(RegisterOp.WRITE, rid, struct.pack(REGISTERS[rid].form, value))
        return struct.unpack(REGISTERS[rid].form, answer[4:])[0]

    def wait(self, ns):
        self.now_ns += ns
        return self.motor.advance(self.now_ns)


@pytest.fixture
def master():
    return Master(DamiaoMotor("dm4310", 1, q=0.5))


def test_it_says_nothing_by_itself_and_answers_every_frame_to_it_once_on_its_mst_id():
    master = Master(DamiaoMotor("dm4310", 1, 0x11))
    assert master.wait(10 * S) == []
    for can_id, data in ((0x001, SPECIAL + b"\xfc"), (0x001, bytes(8)), (0x101, bytes(8)), (0x501, b"\x01")):
        ((mst_id, answer),) = master.send(can_id, data)
        assert (mst_id, len(answer)) == (0x11, 8)
    assert master.send(0x002, bytes(8)) == master.send(0x80000001, bytes(8)) == master.send(0x40000001, b"") == []


def test_enabling_gives_no_torque_before_the_first_command_and_disabling_forgets_it(master):
    assert master.special(Special.ENABLE).status == MotorStatus.ENABLED
    master.wait(100 * MS)
    assert master.mit(p=0.5, kp=10).p == pytest.approx(0.5, abs=1e-3)
    master.mit(p=1.5, kp=50, kd=1)
    master.wait(S)
    held = master.mit(p=1.5, kp=50, kd=1)
    assert held.p == pytest.approx(1.5, abs=2e-3)
    assert master.special(Special.DISABLE).status == MotorStatus.DISABLED
    master.mit(p=-2.0, kp=50, kd=1)
    master.special(Special.ENABLE)
    master.wait(S)
    assert master.special(Special.ENABLE).p == pytest.approx(held.p, abs=1e-2)


def test_the_watchdog_trips_only_while_enabled_at_its_tick_and_is_left_by_fb_then_fc(master):
    assert master.write(Rid.TIMEOUT, 20_000) == 20_000  # 1 s in ticks of 50 µs, not 20 s in ms
    master.wait(5 * S)
    assert master.special(Special.ENABLE).status == MotorStatus.ENABLED
    master.wait(20_000 * TICK_NS)
    assert master.mit(p=0.5).status == MotorStatus.ENABLED
    master.wait(20_001 * TICK_NS)
    assert master.mit(p=0.5).status == MotorStatus.COMMUNICATION_LOST
    assert master.special(Special.ENABLE).status == MotorStatus.COMMUNICATION_LOST, "FC alone does not help"
    assert master.special(Special.DISABLE).status == MotorStatus.COMMUNICATION_LOST, "latched"
    assert master.special(Special.CLEAR).status == MotorStatus.DISABLED
    assert master.special(Special.ENABLE).status == MotorStatus.ENABLED


def test_the_joint_is_free_from_the_instant_of_the_trip(master):
    master.write(Rid.TIMEOUT, 20)  # 1 ms
    master.special(Special.ENABLE)
    master.mit(t=5.0)
    master.wait(2 * S)
    far = master.motor.joint.q
    other = Master(DamiaoMotor("dm4310", 1, q=0.5))
    other.special(Special.ENABLE)
    other.mit(t=5.0)
    other.wait(2 * S)
    assert 0.5 < far < 0.6 < other.motor.joint.q
    assert master.motor.joint.qd == 0.0


def test_a_frame_of_another_mode_is_answered_and_feeds_the_watchdog_but_is_not_executed(master):
    master.write(Rid.TIMEOUT, 2_000)
    master.special(Special.ENABLE)
    for _ in range(10):
        master.wait(90 * MS)
        feedback = master.answer(0x101, pack_target(Mode.POS_VEL, 9.0, 1.0))
    assert feedback.status == MotorStatus.ENABLED
    assert feedback.p == pytest.approx(0.5, abs=1e-3)


def test_without_a_timeout_the_last_command_goes_on_for_ever(master):
    assert master.read(Rid.TIMEOUT) == 0
    master.special(Special.ENABLE)
    master.mit(v=10.0, kd=5.0)
    master.wait(30 * S)
    assert master.special(Special.ENABLE).v == pytest.approx(10.0, rel=0.05)


@pytest.mark.parametrize(
    ("mode", "target", "q", "most"),
    [
        (Mode.POS_VEL, (1.5, 2.0), 1.5, 2.0),
        (Mode.POS_VEL, (-1.5, -2.0), -1.5, 2.0),  # the firmware takes the absolute value
        (Mode.POS_FORCE, (1.5, 2.0, 0.5), 1.5, 2.0),
    ],
)
def test_a_mode_of_position_goes_there_no_faster_than_its_limit(master, mode, target, q, most):
    assert master.write(Rid.CTRL_MODE, mode) == mode
    master.special(Special.ENABLE)
    master.answer(1 + 0x100 * (mode - 1), pack_target(mode, *target))
    fastest = 0.0
    for _ in range(300):
        master.wait(10 * MS)
        fastest = max(fastest, abs(master.motor.joint.qd))
    assert master.motor.joint.q == pytest.approx(q, abs=2e-3)
    assert 0.9 * most < fastest <= most * 1.02


def test_the_share_of_pos_force_limits_the_torque(master):
    master.write(Rid.CTRL_MODE, Mode.POS_FORCE)
    master.special(Special.ENABLE)
    master.answer(0x301, pack_target(Mode.POS_FORCE, 9.0, 100.0, 0.1))
    master.wait(50 * MS)
    assert master.motor.joint.tau == pytest.approx(1.0)


def test_vel_takes_four_bytes_and_eight(master):
    master.write(Rid.CTRL_MODE, Mode.VEL)
    master.special(Special.ENABLE)
    for behind in (b"", bytes(4)):
        master.answer(0x201, pack_target(Mode.VEL, 3.0) + behind)
        master.wait(S)
        assert master.motor.joint.qd == pytest.approx(3.0, rel=1e-3)


def test_registers_answer_with_what_is_effective(master):
    assert (master.read(Rid.PMAX), master.read(Rid.VMAX), master.read(Rid.TMAX)) == DM4310
    assert master.write(Rid.CTRL_MODE, 9) == Mode.MIT, "refused"
    assert master.write(16, 21) == master.read(16), "read only"
    assert master.write(2, float("nan")) == 100.0
    assert master.write(2, 90.0) == 90.0
    assert master.register(RegisterOp.READ, 200) == [], "nobody answers for an unknown register"
    assert master.read(Rid.XOUT) == pytest.approx(0.5)


def test_a_range_that_is_written_scales_commands_and_feedback(master):
    master.write(Rid.PMAX, 25.0)
    ((_, answer),) = master.send(1, SPECIAL + b"\xfd")
    assert Feedback.unpack(answer, DM4310).p == pytest.approx(0.25, abs=1e-3), "as the master of a wrong table sees it"


def test_a_register_is_lost_with_the_power_unless_it_is_stored_and_storing_takes_its_time(master):
    master.write(Rid.TIMEOUT, 600)
    master.motor.start(master.now_ns)
    assert master.read(Rid.TIMEOUT) == 0
    master.write(Rid.TIMEOUT, 600)
    assert master.register(RegisterOp.STORE, 1) == []
    assert master.send(1, SPECIAL + b"\xfd") == [], "the motor only writes"
    due = master.motor.next_deadline_ns
    assert due is not None and due > master.now_ns
    stored, waited = master.wait(due - master.now_ns)
    assert stored == (0, bytes((1, 0, 0xAA, 1)))
    assert len(waited[1]) == 8
    master.motor.start(master.now_ns)
    assert master.read(Rid.TIMEOUT) == 600


def test_nothing_is_stored_while_it_is_enabled(master):
    master.special(Special.ENABLE)
    master.write(Rid.TIMEOUT, 600)
    assert master.register(RegisterOp.STORE, 1) == []
    assert master.wait(S) == []
    master.motor.start(master.now_ns)
    assert master.read(Rid.TIMEOUT) == 0


def test_zero_is_set_without_a_jump_and_written_to_flash(master):
    master.special(Special.ENABLE)
    master.mit(p=0.5, kp=100, kd=2)
    master.wait(100 * MS)
    assert master.send(1, SPECIAL + b"\xfe") == []
    ((_, answer),) = master.wait(S)
    feedback = Feedback.unpack(answer, DM4310)
    assert feedback.p == pytest.approx(0.0, abs=1e-3)
    assert abs(master.motor.joint.tau) < 0.1


def test_feedback_can_be_asked_for_as_it_is_answered_and_without_steps(master):
    ((_, asked),) = master.register(RegisterOp.FEEDBACK, 0)
    assert Feedback.unpack(asked, DM4310).p == pytest.approx(0.5, abs=1e-3)
    master.special(Special.ENABLE)
    master.mit(t=0.5)
    master.wait(100 * MS)
    joint = master.motor.joint
    for rid, value in ((1, joint.q), (2, joint.qd), (3, joint.tau)):
        ((_, asked),) = master.register(RegisterOp.FEEDBACK, rid)
        assert asked[:4] == bytes((1, MotorStatus.ENABLED, 30, 30))
        assert struct.unpack("<f", asked[4:])[0] == pytest.approx(value, rel=1e-6)


def test_zero_leaves_a_velocity_as_it_is(master):
    master.write(Rid.CTRL_MODE, Mode.VEL)
    master.special(Special.ENABLE)
    master.answer(0x201, pack_target(Mode.VEL, -2.0))
    master.wait(500 * MS)
    master.send(1, SPECIAL + bytes((Special.ZERO,)))
    master.wait(500 * MS)
    assert master.motor.joint.qd == pytest.approx(-2.0, rel=1e-2)


def test_a_limit_that_is_exceeded_trips_after_its_delay_and_again_after_fb_while_it_lasts(master):
    master.special(Special.ENABLE)
    master.motor.exceeded_ns[MotorStatus.UNDERVOLTAGE] = master.now_ns
    master.wait(5_000 * TICK_NS)
    assert master.mit(p=0.5).status == MotorStatus.ENABLED
    master.wait(TICK_NS)
    assert master.mit(p=0.5).status == MotorStatus.UNDERVOLTAGE
    master.special(Special.CLEAR)
    assert master.mit(p=0.5).status == MotorStatus.UNDERVOLTAGE
    master.motor.exceeded_ns.clear()
    master.special(Special.CLEAR)
    assert master.special(Special.ENABLE).status == MotorStatus.ENABLED


def test_a_later_fault_takes_the_place_of_an_earlier_one(master):
    master.motor.exceeded_ns |= {MotorStatus.OVERVOLTAGE: 0, MotorStatus.ROTOR_OVERTEMPERATURE: 0}
    master.wait(500 * MS)
    assert master.special(Special.DISABLE).status == MotorStatus.ROTOR_OVERTEMPERATURE
    master.wait(S)
    assert master.special(Special.DISABLE).status == MotorStatus.OVERVOLTAGE


@pytest.mark.parametrize("seed", range(6))
def test_no_frame_makes_it_raise_and_its_state_stays_finite(seed):
    """Random frames, many of them nearly right, and the dangerous ones of 7FFh that set ids or start a bootloader."""
    rng = random.Random(seed)
    motor = DamiaoMotor(rng.choice(list(TYPES)), rng.choice((1, 0x12, 0x7F)))
    heads = [motor.node_id.to_bytes(2, "little") + bytes((op,)) for op in RegisterOp]
    legacy = [bytes.fromhex(one) for one in ("550000aa", "aa010255", "ee000011", "550102aa01")]
    t_ns = 0
    for _ in range(1000):
        t_ns += rng.choice((0, 1, 50_000, MS, 100 * MS))
        numbers = struct.pack("<f", rng.choice((0.0, 1.0, -3e38, 1e-40, float("inf"), rng.uniform(-20, 20))))
        special = SPECIAL + bytes((rng.randrange(250, 256),))
        head = rng.choice(heads) + bytes((rng.randrange(90),))
        data = rng.choice((special, head + numbers, head + rng.randbytes(4), numbers * 2, rng.randbytes(8), *legacy))
        can_id = rng.choice((motor.node_id + 0x100 * rng.randrange(4), REGISTER_ID, rng.randrange(0x800)))
        answers = motor.receive(can_id, data[: rng.choice((8, 8, 8, rng.randrange(9)))], t_ns)
        assert all(len(answer) in (4, 8) and 0 <= mst_id < 0x800 for mst_id, answer in answers)
    assert abs(motor.joint.q) < 1e6
    assert abs(motor.joint.qd) < 1e4


@pytest.mark.parametrize(
    ("ids", "mst_ids", "node_ids", "message"),
    [
        ((1, 2), (), (), ""),  # the factory's MST_ID, on a bus without nodes
        ((1, 2), (0x11, 0x12), (), ""),
        ((1, 2), (0x11, 0x13), (5, 16), ""),
        ((1,), (), (5,), "NMT; give --mst-id 0x11"),
        ((1,), (0x85,), (5,), "frame of node 5"),
        ((5,), (0x11,), (5,), "205h"),
        ((1, 1), (), (), "--id 1"),
        ((1, 2), (2, 0x12), (), "low byte"),
        ((1, 2), (0x102, 0x12), (), "low byte"),
        ((1, 2), (0x11,), (), "all of them an --mst-id or none"),
        ((1,), (0x7FF,), (), "registers"),
        ((), (), (), "--id"),
    ],
)
def test_identifiers_that_two_devices_would_share_are_refused(ids, mst_ids, node_ids, message):
    names = ["damiao:dm4310"] * max(len(ids), 1)
    if not message:
        assert [motor.node_id for motor in motors_on_bus(names, ids, mst_ids, node_ids)] == [*ids]
        return
    with pytest.raises(UsageError, match=message):
        motors_on_bus(names, ids, mst_ids, node_ids)


def test_an_unknown_type_is_refused_with_one_that_is_near():
    with pytest.raises(UsageError, match="did you mean damiao:dm4310"):
        motors_on_bus(["damiao:4310"], [1], [])
