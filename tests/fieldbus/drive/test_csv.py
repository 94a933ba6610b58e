"""Cyclic synchronous velocity, CiA 402-2: 60FFh + 60B1h, limits, loss of the master."""

from __future__ import annotations

import pytest


@pytest.fixture
def csv(rig):
    """Operational, RPDO1 = controlword + target velocity."""
    return rig.at_work(9, 0x60FF0020)


def order(velocity, word=0x0F):
    return (word.to_bytes(2, "little") + velocity.to_bytes(4, "little", signed=True)).hex()


@pytest.mark.parametrize("velocity", [10_000, -10_000, 1])
def test_cia402_csv_position_is_the_integral_of_the_velocity(csv, velocity):
    csv.cycles(1, rpdo=order(velocity))
    csv.cycles(41, rpdo=order(velocity))
    assert csv.counts == pytest.approx(velocity * 40 * 2.5e-3)  # latched at the second SYNC
    assert (csv.bits(12), csv.signed(0x606C)) == ((1,), velocity)


def test_cia402_csv_speed_changes_at_the_sync(csv):
    for velocity in (4000, 4000, -8000, -8000, 0, 0, 0):
        csv.cycles(1, rpdo=order(velocity))
    # the target of cycle k acts from SYNC k+1 to k+2
    assert csv.counts == pytest.approx((4000 + 4000 - 8000 - 8000 + 0) * 2.5e-3)


def test_cia402_csv_velocity_offset_is_added(csv):
    csv.put(_60B1=-1500).cycles(11, rpdo=order(4000))
    assert csv.counts == pytest.approx(2500 * 9 * 2.5e-3)
    assert csv.signed(0x606C) == 2500


def test_cia402_csv_nothing_moves_before_the_first_target(csv):
    csv.put(_60B1=5000).cycles(4)
    assert csv.counts == 0.0


def test_cia402_csv_moves_on_between_late_syncs(csv):
    csv.cycles(3, rpdo=order(10_000))
    start = csv.counts
    csv.run(6)
    assert csv.counts - start == pytest.approx(10_000 * 6.3e-3)  # from the SYNC, 0.3 ms before the RPDO


@pytest.mark.parametrize("sign", [1, -1])
def test_cia402_csv_607f_limits_the_velocity_and_bit_11_says_so(csv, sign):
    csv.put(_607F=6000).cycles(2, rpdo=order(sign * 7000))
    csv.cycles(8, rpdo=order(sign * 7000))
    assert (csv.signed(0x606C), csv.bits(11)) == (sign * 6000, (1,))
    csv.cycles(3, rpdo=order(sign * 6000))
    assert csv.bits(11) == (0,)


@pytest.mark.parametrize("sign", [1, -1])
def test_cia402_57_the_motor_waits_at_a_software_limit(csv, sign):
    csv.put(_607D_1=-100, _607D_2=100).cycles(30, rpdo=order(sign * 10_000))
    assert (csv.counts, csv.bits(11)) == (sign * 100, (1,))
    csv.cycles(6, rpdo=order(sign * -10_000))
    assert csv.bits(11) == (0,)
    assert abs(csv.counts) < 50


@pytest.mark.parametrize(("option", "goal"), [(0, 0x27), (1, 0x08), (2, 0x40), (3, 0x07)])
def test_cia402_59_missing_syncs_act_by_6007h(csv, option, goal):
    csv.put(_6007=option, _605A=6).cycles(10, rpdo=order(1000))
    csv.run(13)
    assert csv.bits(0, 1, 2) == (1, 1, 1)
    csv.run(100)
    assert csv.drive.read(0x6041) & 0x6F & ~0x20 == goal & ~0x20
