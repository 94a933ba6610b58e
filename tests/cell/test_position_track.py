"""Positions that a motor can and cannot have reached, and where it is when nobody says."""

from __future__ import annotations

import pytest

from canprobe.cell.position_track import BASE_COUNTS, CARRIED_CYCLES, STEADY, PositionTrack

PERIOD = 2_500_000


def moving(rate=10, cycles=20, track=None):
    track = track or PositionTrack()
    for k in range(cycles):
        track.aim(abs(rate))
        assert track.take(rate * k, k, k * PERIOD, guarded=True) or k == 0
    return track


@pytest.mark.parametrize("rate", [0, 10, -300])
def test_a_steady_motion_is_believed_and_carried_on(rate):
    track = moving(rate)
    for age in range(1, 8):
        assert track.position(19 + age, (19 + age) * PERIOD) == pytest.approx(rate * (19 + min(age, CARRIED_CYCLES)))
    assert track.position(19, 19 * PERIOD) == rate * 19


@pytest.mark.parametrize("sign", [1, -1])
def test_a_jump_is_not_believed_and_the_next_right_one_is(sign):
    track = moving(10)
    assert not track.take(200 + sign * 60, 20, 20 * PERIOD, guarded=True)
    assert (track.counts, track.cycle) == (190, 19)
    assert track.take(210, 21, 21 * PERIOD, guarded=True)
    assert track.position(22, 22 * PERIOD) == pytest.approx(220)


def test_before_the_drive_is_enabled_everything_is_believed_but_nothing_at_rest():
    track = PositionTrack()
    for k in range(STEADY + 1):
        track.take(1000, k, k * PERIOD, guarded=False)
    assert track.steady >= STEADY
    assert track.take(5000, 9, 9 * PERIOD, guarded=False)
    assert track.steady == 0
    track.take(1000, 10, 10 * PERIOD, guarded=False)
    assert track.steady == 0


def test_a_start_and_a_stop_are_believed():
    """A drive of 30 Hz behind a ramp that begins and ends at once: x'' = ω²(r − x) − 2 ζ ω x'."""
    omega, dt, x, v = 188.0, 2.5e-3, 0.0, 0.0
    track, reference = PositionTrack(), 0.0
    for k in range(200):
        step = 40.0 if 50 <= k < 120 else 0.0
        track.aim(step)
        for _ in range(50):
            reference += step / 50
            a = omega**2 * (reference - x) - 2 * 0.9 * omega * v
            v += a * dt / 50
            x += v * dt / 50
        assert track.take(round(x), k, k * PERIOD, guarded=True), k
    assert track.counts == pytest.approx(40 * 70, abs=1)


def test_noise_of_some_counts_is_believed():
    track = PositionTrack()
    for k in range(50):
        assert track.take((k % 2) * (BASE_COUNTS // 3), k, k * PERIOD, guarded=True)


@pytest.mark.parametrize("sign", [1, -1])
def test_wrong_reports_at_rest_do_not_grow_into_a_motion(sign):
    """Each of them is near to where the one before would lead, and the target asks for nothing of the kind."""
    track = moving(0)
    assert track.take(sign * BASE_COUNTS, 20, 20 * PERIOD, guarded=True)
    assert track.position(23, 23 * PERIOD) == sign * BASE_COUNTS
    assert not track.take(sign * 3 * BASE_COUNTS, 21, 21 * PERIOD, guarded=True)
    assert track.take(0, 22, 22 * PERIOD, guarded=True)
