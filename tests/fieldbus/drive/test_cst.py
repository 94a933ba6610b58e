"""Cyclic synchronous torque, CiA 402-2: torque against inertia and friction, limits, what the drive tells of it."""

from __future__ import annotations

import math

import pytest

GAIN, COULOMB, DAMPING = 100.0, 50.0, 4.0  # of the plant of numbers


def integrate(torques, step_s=2.5e-3, parts=100):
    """Positions at the end of every step, by small explicit steps that stop at a change of sign."""
    position = velocity = 0.0
    places = []
    for torque in torques:
        for _ in range(parts):
            dt = step_s / parts
            if velocity == 0.0:
                push = math.copysign(max(0.0, abs(torque) - COULOMB), torque)
            else:
                push = torque - math.copysign(COULOMB, velocity)
            middle = velocity + dt / 2 * (GAIN * push - DAMPING * velocity)
            after = velocity + dt * (GAIN * push - DAMPING * middle)
            if after * velocity < 0:
                after = 0.0
            position += dt * (velocity + after) / 2
            velocity = after
        places.append(position)
    return places


@pytest.fixture
def cst(rig):
    """Operational, RPDO1 = controlword + target torque."""
    return rig.at_work(10, 0x60710010)


def order(torque, word=0x0F):
    return (word.to_bytes(2, "little") + torque.to_bytes(2, "little", signed=True)).hex()


def push(cst, torques):
    """Positions at the SYNC that ends each torque's cycle."""
    cst.trace.clear()
    for torque in (*torques, torques[-1], torques[-1]):
        cst.cycles(1, rpdo=order(torque))
    return [counts for _, counts in cst.trace[2:]]


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(
    "torques",
    [[250] * 60, [49] * 10, [400] * 20 + [0] * 60, [400] * 20 + [-400] * 50, [300, -300, 200, -60, 60, 500, 20] * 6],
)
def test_cia402_cst_motion_under_torque(cst, torques, sign):
    torques = [sign * torque for torque in torques]
    assert push(cst, torques) == pytest.approx(integrate(torques), rel=1e-3, abs=0.01)


@pytest.mark.parametrize("sign", [1, -1])
def test_cia402_58_torque_limit(cst, sign):
    cst.put(_6072=200)
    assert push(cst, [sign * 500] * 30) == pytest.approx(integrate([sign * 200] * 30), rel=1e-3, abs=0.01)
    assert (cst.bits(11), cst.signed(0x6074), cst.signed(0x6077)) == ((1,), sign * 200, sign * 200)
    cst.cycles(2, rpdo=order(sign * 150))
    assert (cst.bits(11), cst.signed(0x6077)) == ((0,), sign * 150)


def test_cia402_58_the_limit_holds_for_target_and_offset_together(cst):
    cst.put(_6072=200, _60B2=-100).cycles(3, rpdo=order(250))
    assert (cst.bits(11), cst.signed(0x6077)) == ((0,), 150)
    cst.put(_60B2=100).cycles(3, rpdo=order(250))
    assert (cst.bits(11), cst.signed(0x6077)) == ((1,), 200)


def test_cia402_cst_6077_is_the_plants_again_afterwards(cst, plant):
    plant.torque = -77
    cst.cycles(5, rpdo=order(100))
    assert cst.signed(0x6077) == 100
    cst.put(_6060=8)
    assert cst.signed(0x6077) == -77


@pytest.mark.parametrize("sign", [1, -1])
def test_cia402_cst_607f_limits_the_speed_and_bit_11_says_so(cst, sign):
    cst.put(_607F=1000)
    push(cst, [sign * 250] * 40)
    assert (cst.signed(0x606C), cst.bits(11)) == (sign * 1000, (1,))
    cst.cycles(100, rpdo=order(sign * 60))
    assert cst.signed(0x606C) == pytest.approx(sign * GAIN * 10 / DAMPING + sign * 750 * math.exp(-1), abs=10)
    assert cst.bits(11) == (0,)


@pytest.mark.parametrize("sign", [1, -1])
def test_cia402_57_the_motor_waits_at_a_software_limit(cst, sign):
    cst.put(_607D_1=-20, _607D_2=20)
    places = push(cst, [sign * 300] * 60)
    assert (places[-1], max(map(abs, places)), cst.bits(11)) == (sign * 20, 20, (1,))
    cst.cycles(10, rpdo=order(sign * -300))
    assert cst.bits(11) == (0,)
    assert abs(cst.counts) < 20
