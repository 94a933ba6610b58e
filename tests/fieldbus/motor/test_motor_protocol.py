"""Frames of Damiao motors: values ↔ bytes, by the arithmetic of the protocol and by what is published of it."""

from __future__ import annotations

import random
import struct

import pytest

from canprobe.errors import ProtocolError
from canprobe.fieldbus.motor import protocol
from canprobe.fieldbus.motor.protocol import TYPES, Feedback, MitCommand, Mode, MotorStatus, RegisterOp, Special

DM4310 = TYPES["dm4310"]
COMMANDS = [
    # openarm_can, dm_motor_control.cpp: five numbers, high bits first; 0 lies half a step below the middle
    ("7fff7ff0000007ff", MitCommand()),
    ("0000000000000000", MitCommand(-12.5, -30, 0, 0, -10)),
    ("ffffffffffffffff", MitCommand(12.5, 30, 500, 5, 10)),
    ("7fff7ff0510007ff", MitCommand(kp=10.0)),  # 10/500 · 4095 = 81.9
    ("7fff7ff0003337ff", MitCommand(kd=1.0)),  # 1/5 · 4095 = 819
]


def steps(ranges):
    """Steps of position, velocity, stiffness, damping and torque."""
    return [(high - low) / ((1 << bits) - 1) for low, high, bits in ranges.fields]


@pytest.mark.parametrize(("frame", "command"), COMMANDS)
def test_a_command_is_packed_as_published_and_comes_back_within_a_step(frame, command):
    assert command.pack(DM4310).hex() == frame
    back = MitCommand.unpack(bytes.fromhex(frame), DM4310)
    assert all(0 <= a - b <= step * (1 + 1e-9) for a, b, step in zip(command, back, steps(DM4310), strict=True))


def test_published_steps_and_the_zero_that_is_none():
    """MIT.md: the step of a position is 0.381 mrad, and a command of 0 commands half of it less."""
    assert steps(DM4310) == pytest.approx([0.381e-3, 14.7e-3, 0.122, 0.00122, 4.9e-3], rel=5e-3)
    assert steps(TYPES["dm4340"])[1] == pytest.approx(4.9e-3, rel=5e-3)
    assert steps(TYPES["dm8009"])[4] == pytest.approx(26.4e-3, rel=5e-3)
    p, v, _, _, t = MitCommand.unpack(MitCommand().pack(DM4310), DM4310)
    assert (p, v, t) == pytest.approx((-0.19e-3, -7.3e-3, -2.4e-3), rel=0.02)


def test_a_host_clamps_and_a_motor_does_not():
    assert MitCommand(p=99, kp=-1, t=-99).pack(DM4310) == MitCommand(p=12.5, kp=0, t=-10).pack(DM4310)
    beyond = Feedback(1, 1, 12.6, 0, 0, 30, 30).pack(DM4310)
    assert Feedback.unpack(beyond, DM4310).p == pytest.approx(12.6 - 25, abs=1e-3)


def test_the_layout_of_feedback():
    status, motor_id, p, v, t, t_mos, t_rotor = Feedback.unpack(bytes.fromhex("d1ffff8007ff2a63"), DM4310)
    assert (status, motor_id, p, t_mos, t_rotor) == (MotorStatus.COMMUNICATION_LOST, 1, 12.5, 42, 99)
    assert (v, t) == pytest.approx((30 / 4095, -10 / 4095))


@pytest.mark.parametrize(
    ("motor_id", "status", "first"), [(1, 0, 0x01), (1, 0xD, 0xD1), (0x12, 1, 0x12), (0x22, 9, 0xB2)]
)
def test_an_id_from_16_on_runs_into_the_status(motor_id, status, first):
    assert Feedback(status, motor_id, 0, 0, 0, 0, 0).pack(DM4310)[0] == first


def test_names_of_statuses():
    assert protocol.status_name(0xD) == "communication lost"
    assert protocol.status_name(7) == "unknown status 7"


@pytest.mark.parametrize(
    ("mode", "values", "frame"),
    [
        (Mode.POS_VEL, (1.0, 2.0), struct.pack("<ff", 1.0, 2.0)),
        (Mode.VEL, (-2.5,), struct.pack("<f", -2.5)),
        (Mode.POS_FORCE, (1.0, 5.0, 0.25), struct.pack("<fHH", 1.0, 500, 2500)),
    ],
)
def test_targets_of_the_other_modes_both_ways_and_cut_short(mode, values, frame):
    assert protocol.pack_target(mode, *values) == frame
    assert protocol.unpack_target(mode, frame, DM4310) == values
    assert protocol.unpack_target(mode, frame + b"junk", DM4310) == values  # damiao-motor sends VEL with four zeros
    for length in range(len(frame)):
        with pytest.raises(ProtocolError, match=mode.name):
            protocol.unpack_target(mode, frame[:length], DM4310)


def test_pos_force_is_clamped_as_hosts_do():
    assert protocol.pack_target(Mode.POS_FORCE, 0.0, 1e6, 7.0)[4:] == struct.pack("<HH", 10_000, 10_000)


@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_a_target_that_is_no_number_is_refused(number):
    with pytest.raises(ProtocolError, match="VEL"):
        protocol.unpack_target(Mode.VEL, struct.pack("<f", number), DM4310)


def test_special_frames():
    found = [protocol.special_of(b"\xff" * 7 + bytes((last,))) for last in range(256)]
    assert {one: last for last, one in enumerate(found) if one} == {one: one.value for one in Special}
    assert protocol.special_of(b"\xff" * 6 + b"\xfc") is None


def test_a_request_for_a_register():
    assert protocol.pack_register(0x101, RegisterOp.READ, 21).hex() == "0101331500000000"
    assert protocol.pack_register(1, RegisterOp.WRITE, 9, struct.pack("<I", 20_000)).hex() == "01005509204e0000"


def test_ranges_have_their_disagreements_beside_them():
    assert TYPES["dm4340"] == (12.5, 10, 28)  # openarm_can PR #146; lerobot has 8
    assert TYPES["dm3507"] == (12.5, 50, 5)  # lerobot has 30 and 10


@pytest.mark.parametrize("seed", range(20))
def test_random_bytes_raise_the_error_of_a_decoder_alone(seed):
    rng = random.Random(seed)
    for _ in range(100):
        data = rng.randbytes(rng.randrange(12))
        protocol.special_of(data)
        for decode in (MitCommand.unpack, Feedback.unpack):
            if len(data) == 8:
                decode(data, DM4310)
            else:
                with pytest.raises(ProtocolError, match="8 bytes"):
                    decode(data, DM4310)
        for mode in Mode:
            try:
                protocol.unpack_target(mode, data, DM4310)
            except ProtocolError as error:
                assert str(error)
