"""Profile position, CiA 402-2: handshake, queue, trapezoid, window, halt; driven by SDO and RPDO."""

import math
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.fieldbus.drive.profile import Rates, trapezoid

CYCLE = 2_500_000
NEW, NEW_NOW, NEW_RELATIVE, NEW_NOW_RELATIVE, HALT = 0x1F, 0x3F, 0x5F, 0x7F, 0x10F


def trapezoidal_move(t, way, speed, up, down):
    """Textbook position after t s of a move from rest to rest, way > 0."""
    speed = min(speed, math.sqrt(2 * way * up * down / (up + down)))
    t_up, t_down = speed / up, speed / down
    t_flat = (way - speed * (t_up + t_down) / 2) / speed
    if t <= t_up:
        return up * t * t / 2
    if t <= t_up + t_flat:
        return speed * t_up / 2 + speed * (t - t_up)
    left = t_up + t_flat + t_down - t
    return way - down * left * left / 2 if left > 0 else way


def offer(rig, target, word=NEW):
    rig.put(_607A=target).word(word)
    return rig


def move(rig, target, word=NEW):
    return offer(rig, target, word).word(0x0F)


@pytest.mark.parametrize("target", [3000, -3000, 200, -37])
@pytest.mark.parametrize(("speed", "up", "down"), [(20_000, 100_000, 100_000), (30_000, 200_000, 50_000)])
def test_cia402_54_profile_is_the_trapezoid(rig, target, speed, up, down):
    rig.put(_6081=speed, _6083=up, _6084=down).enable(1)
    t0 = rig.drive.t_ns
    move(rig, target).run(800)
    sign = math.copysign(1, target)
    for t_ns, counts in rig.trace:
        if (t_ns - t0) % CYCLE == 0:
            expected = trapezoidal_move((t_ns - t0) * 1e-9, abs(target), speed, up, down)
            assert counts * sign == pytest.approx(expected, abs=1e-6)
    assert rig.counts == target


def test_cia402_607f_limits_the_profile_velocity(rig):
    rig.put(_6081=50_000, _607F=8_000, _6083=10**7, _6084=10**7).enable(1)
    move(rig, 1600).run(100)
    assert rig.counts == pytest.approx(8_000 * 0.1, abs=8_000 * 1e-3)


def test_cia402_54_handshake_of_one_set_point(rig):
    rig.enable(1)
    assert rig.bits(10, 12) == (0, 0)
    offer(rig, 1000)
    assert rig.bits(10, 12) == (0, 1)
    rig.run(20)
    assert rig.bits(10, 12) == (0, 1)  # as long as bit 4 is set
    rig.word(0x0F)
    assert rig.bits(10, 12) == (0, 0)
    rig.run(400)
    assert rig.bits(10, 12) == (1, 0)
    offer(rig, 900)
    assert rig.bits(10, 12) == (0, 1)


def test_cia402_54_bit_4_acts_on_its_edge_only_and_not_while_it_enables(rig):
    rig.put(_6060=1, _607A=500)
    for word in (0x06, 0x07, 0x1F):
        rig.word(word)
    rig.put(_607A=500).word(0x1F).run(100)
    assert (rig.counts, rig.bits(12)) == (0.0, (0,))
    rig.word(0x0F).word(0x1F).run(400)
    assert rig.counts == 500
    rig.put(_607A=700).word(0x1F).run(100)
    assert rig.counts == 500


def test_cia402_54_one_set_point_waits_a_third_is_ignored(rig):
    rig.put(_6081=10_000, _6083=10**6, _6084=10**6).enable(1)
    move(rig, 1000).run(10)
    move(rig, 300)
    assert rig.bits(10, 12) == (0, 1)  # no room for another one
    move(rig, 9999)
    assert rig.bits(10, 12) == (0, 1)
    rig.run(500)
    assert rig.bits(10, 12) == (1, 0)
    places = [counts for _, counts in rig.trace]
    assert max(places) == 1000
    # inside 6067h = 10 counts 4.5 ms before the end; 6068h = 10 ms from there, seen every 2.5 ms: in half-milliseconds
    assert 11 <= places.count(1000) <= 17
    assert rig.counts == 300


def test_cia402_54_acknowledge_falls_when_the_waiting_set_point_starts(rig):
    rig.put(_6081=10_000, _6083=10**6, _6084=10**6).enable(1)
    move(rig, 1000).run(10)
    move(rig, 2000)
    reached = rig.bits(10)
    while rig.bits(12) == (1,):
        assert rig.bits(10) == (0,)
        rig.run(1)
    assert reached == (0,)
    assert 1000 <= rig.counts < 1010
    move(rig, 2500).run(500)
    assert rig.counts == 2500


def test_cia402_54_change_immediately_replaces_all_without_a_jump(rig):
    rig.put(_6081=20_000, _6083=100_000, _6084=100_000).enable(1)
    move(rig, 8000).run(200)
    move(rig, 9000)
    before = rig.counts
    assert before == pytest.approx(2000)  # flat part: v (t - v/2a)
    move(rig, -500, NEW_NOW)
    assert rig.bits(12) == (0,)  # nothing waits any more
    rig.run(700)
    places = [counts for _, counts in rig.trace]
    assert max(places) == pytest.approx(before + 20_000**2 / 2e5)  # braked first
    steps = [b - a for a, b in pairwise(places)]
    assert max(map(abs, steps)) <= 20_000 * 0.5e-3 + 1e-6
    bends = [abs(b - a) for a, b in zip(steps[::5], steps[5::5], strict=False)]
    assert max(bends) <= 100_000 * 2.5e-3 * 0.5e-3 + 1e-6
    assert (rig.counts, rig.bits(10)) == (-500, (1,))


def test_cia402_54_change_immediately_to_a_slower_speed_brakes_to_it(rig):
    rig.put(_6081=20_000, _6083=100_000, _6084=50_000).enable(1)
    move(rig, 10_000).run(250)
    start = rig.counts
    rig.put(_6081=5_000)
    move(rig, 10_000, NEW_NOW).run(400)
    # 0.3 s from 20 000 to 5 000 counts/s, then 0.1 s
    assert rig.counts - start == pytest.approx((20_000 + 5_000) / 2 * 0.3 + 500)


def test_cia402_54_a_set_point_has_the_parameters_of_its_edge(rig):
    rig.put(_6081=10_000, _6083=10**7, _6084=10**7).enable(1)
    move(rig, 1000)
    rig.put(_6081=1)
    rig.run(50)
    assert rig.counts == pytest.approx(500, abs=10)


def test_cia402_54_relative_to_the_set_point_before_not_to_the_place(rig):
    rig.put(_6081=10_000, _6083=10**6, _6084=10**6).enable(1)
    move(rig, 1000).run(30)
    move(rig, -300, NEW_RELATIVE)
    move_places = rig.run(500).counts
    assert move_places == 700
    move(rig, 1000).run(10)
    move(rig, 50, NEW_NOW_RELATIVE).run(500)
    assert rig.counts == 1050


def test_cia402_54_first_relative_move_begins_where_the_drive_was_enabled(rig, plant):
    plant.ramps.clear()
    plant.counts[0] = 250.0
    rig.enable(1)
    move(rig, -100, NEW_RELATIVE).run(400)
    assert rig.counts == 150


@pytest.mark.parametrize(("word", "name"), [(0x07, "switched on"), (0x06, "ready")])
def test_cia402_54_set_points_are_forgotten_when_operation_ends(rig, word, name):
    rig.put(_6081=2_000).enable(1)
    move(rig, 1000).run(50)
    move(rig, 2000)
    rig.word(word).run(50)
    stopped = rig.counts
    rig.word(0x07).word(0x0F).run(400)
    assert (rig.counts, rig.bits(10, 12)) == (stopped, (0, 0)), name


def test_cia402_6067_6068_target_reached_is_the_motors_and_takes_its_time(rig, plant):
    rig.put(_6067=20, _6068=40, _6081=50_000, _6083=10**7, _6084=10**7).enable(1)
    move(rig, 500).run(20)
    assert rig.counts == 500
    plant.stuck = True
    plant.counts[0] = 479.0
    rig.run(100)
    assert rig.bits(10) == (0,)
    plant.counts[0] = 481.0
    rig.run(40)
    assert rig.bits(10) == (0,)
    rig.run(5)
    assert rig.bits(10) == (1,)


def test_cia402_6067_switched_off_a_set_point_is_reached_when_its_move_has_ended(rig):
    rig.put(_6067=0xFFFFFFFF, _6068=0, _6081=10_000, _6083=10**6, _6084=10**6).enable(1)
    move(rig, 1000).run(50)
    assert 400 < rig.counts < 600 and rig.bits(10) == (0,)
    rig.run(100)
    assert (rig.counts, rig.bits(10)) == (1000, (1,))


@pytest.mark.parametrize(("target", "place", "limited"), [(900, 900, 0), (1500, 1000, 1), (-1500, -200, 1)])
def test_cia402_57_software_limits_of_a_move(rig, target, place, limited):
    rig.put(_607D_1=-200, _607D_2=1000).enable(1)
    move(rig, target).run(600)
    assert (rig.counts, rig.bits(10, 11)) == (place, (1, limited))
    move(rig, 0).run(10)
    assert rig.bits(11) == (0,)


def test_cia402_60_a_move_goes_on_after_halt(rig):
    rig.put(_605D=1, _6081=20_000, _6083=200_000, _6084=100_000).enable(1)
    move(rig, -8000).run(200)
    rig.word(HALT)
    assert rig.bits(10) == (0,)
    rig.run(250)
    assert rig.bits(10) == (1,)  # standing still
    assert rig.drive.read(0x6041) & 0x6F == 0x27
    rig.word(0x0F)
    assert rig.bits(10) == (0,)
    rig.run(800)
    assert (rig.counts, rig.bits(10)) == (-8000, (1,))


def test_cia402_60_a_set_point_taken_in_halt_starts_after_it(rig):
    rig.enable(1).word(HALT).run(10)
    rig.put(_607A=300).word(0x11F).run(200)
    assert (rig.counts, rig.bits(10, 12)) == (0.0, (1, 1))
    rig.word(0x0F).run(400)
    assert (rig.counts, rig.bits(10, 12)) == (300, (1, 0))


def test_cia402_59_profile_position_does_not_live_by_sync(rig):
    rig.drive.nmt(0x01)
    rig.enable(1)
    move(rig, 1000).run(500)
    assert (rig.counts, rig.bits(10)) == (1000, (1,))


def test_cia402_59_profile_position_stops_when_the_heartbeat_is_lost(rig):
    rig.put(_1029_1=1, _1016_1=127 << 16 | 100, _6081=5000).enable(1)
    rig.drive.send(0x77F, "05")
    move(rig, 5000).run(90)
    assert rig.drive.read(0x6041) & 0x6F == 0x27
    rig.run(60)
    assert rig.drive.read(0x6041) & 0x4F == 0x40
    assert rig.counts < 500


def test_cia402_54_controlword_and_target_of_one_asynchronous_rpdo_belong_together(rig):
    rig.put(_1400_2=255).enable(1)
    rig.drive.nmt(0x01)
    rig.drive.send(0x201, "1f0090010000")
    rig.run(400)
    assert rig.counts == 400


def test_cia402_6081_zero_stands_still_and_is_not_reached(rig):
    rig.put(_6081=0).enable(1)
    move(rig, 400).run(100)
    assert (rig.counts, rig.bits(10)) == (0.0, (0,))


# Trapezoidal profiles from any motion: ends, limits, and slopes by finite differences.

PLACES = st.floats(-1e5, 1e5)
SPEEDS = st.floats(-5e4, 5e4)
RATES = st.floats(1e3, 1e7)


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.tuples(PLACES, SPEEDS, PLACES, st.floats(1.0, 5e4), RATES, RATES))
def test_a_profile_is_continuous_and_keeps_the_limits(numbers):
    position, velocity, target, speed, up, down = numbers
    profile = trapezoid(position, velocity, target, Rates(speed, up, down))
    assert profile.at(0.0) == pytest.approx((position, velocity), abs=1e-6)
    assert profile.at(profile.duration_s) == (target, 0.0)
    step = profile.duration_s / 500
    samples = [profile.at(k * step) for k in range(501)]
    for (p, v), (q, w) in pairwise(samples):
        assert abs(w - v) <= max(up, down) * step * (1 + 1e-6) + 1e-3
        assert abs(q - p - step * (v + w) / 2) <= max(up, down) * step**2 / 4 * (1 + 1e-6) + 1e-4
        assert abs(w) <= max(speed, abs(velocity)) * (1 + 1e-6) + 1e-3
    assert samples[-2][0] == pytest.approx(target, abs=down * step**2 / 2 + 1e-3)
