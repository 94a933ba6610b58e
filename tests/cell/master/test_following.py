"""Whether a motor follows its targets: drives of any lag do, one that stands or goes at another speed does not."""

from __future__ import annotations

import math

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.following import MIN_MARGIN_COUNTS, Following

MODEL = canprobe.plan("press").setup.arm.model
PERIOD_NS, LAG_S = 2_500_000, 6.8e-3
COUNTS_PER_RAD = abs(float(MODEL.units_per_q[0, 0]))


class Motor:
    """Reaches each target two cycles later, behind the lag of a loop of second order."""

    def __init__(self, lag_s, period_s=PERIOD_NS * 1e-9, damping=1.0):
        self.x = self.v = 0.0
        self.damping = damping
        self.w = 2.0 * damping / lag_s if lag_s else math.inf
        self.period_s, self.stands = period_s, False
        self.reference = [0.0] * 3

    def step(self, target):
        self.reference = [*self.reference[1:], target]
        begin, end = self.reference[0], self.reference[1]
        if self.stands:
            return round(self.x)
        if math.isinf(self.w):
            self.x = end
            return round(self.x)
        n = 50
        for k in range(n):
            r = begin + (end - begin) * (k + 1) / n
            self.v += (self.w**2 * (r - self.x) - 2.0 * self.damping * self.w * self.v) * self.period_s / n
            self.x += self.v * self.period_s / n
        return round(self.x)


class TimedMotor:
    """Reaches each target a period after the SYNC that it saw, from where it was by then, behind a first-order lag."""

    def __init__(self, lag_s):
        self.x, self.lag_s, self.t = 0.0, lag_s, 0.0
        self.begin, self.end, self.latched = 0.0, 0.0, 0.0

    def reference(self, t):
        return self.begin + (self.end - self.begin) * min((t - self.latched) / (PERIOD_NS * 1e-9), 1.0)

    def sync(self, t, target):
        """Latch a target at a time; returns the position there."""
        for t_k in np.linspace(self.t, t, 50)[1:]:
            share = 1.0 - math.exp(-(t - self.t) / 49 / self.lag_s) if self.lag_s else 1.0
            self.x += share * (self.reference(t_k) - self.x)
        self.begin, self.end, self.latched, self.t = self.reference(t), target, t, t
        return round(self.x)


def found(motor, targets, *, stands_at=10**9, counts=0, period_ns=PERIOD_NS):
    """First cycle in which a motor does not follow, which may stand from one on; None where it always does."""
    following = Following(MODEL, LAG_S, period_ns)
    for k, target in enumerate(targets):
        t_ns = (k + 1) * period_ns
        motor.stands = motor.stands or k == stands_at
        if following.beyond(0, counts, t_ns) > 0.0:
            return k
        following.aim([round(target)] * 6, [counts] * 6, t_ns)
        counts = motor.step(round(target))
    return None


def motions(period_s=PERIOD_NS * 1e-9):
    t = np.arange(0.0, 1.5, period_s)
    ramp = np.clip(t - 0.2, 0.0, 1.0)
    return {
        "a ramp": 0.6 * COUNTS_PER_RAD * ramp,
        "to and fro": 0.05 * COUNTS_PER_RAD * (1.0 - np.cos(2.0 * math.pi * 3.0 * t)),
        "a slow ramp": 0.003 * COUNTS_PER_RAD * ramp,
        "at once to its speed and back": 0.2 * COUNTS_PER_RAD * (0.25 - np.abs(np.mod(t, 0.5) - 0.25)),
    }


@pytest.mark.parametrize("lag_s", [0.0, LAG_S, 2.0 * LAG_S])
@pytest.mark.parametrize("what", motions())
def test_a_drive_with_any_lag_up_to_twice_the_stated_one_follows(what, lag_s):
    assert found(Motor(lag_s), motions()[what]) is None


@pytest.mark.parametrize(("lag_s", "damping"), [(0.5 * LAG_S, 0.5), (0.5 * LAG_S, 0.7), (LAG_S, 0.7)])
def test_a_drive_that_overshoots_a_sharp_turn_follows(lag_s, damping):
    """Of the targets of a straight stroke over a cylinder, which goes back at once with 1 rad/s."""
    targets = COUNTS_PER_RAD * np.abs(np.mod(np.arange(0.0, 1.0, PERIOD_NS * 1e-9), 0.4) - 0.2)
    assert found(Motor(lag_s, damping=damping), targets - targets[0]) is None


@pytest.mark.parametrize("rate_hz", [200, 1000])
def test_the_while_is_a_time_at_every_rate(rate_hz):
    period_s = 1.0 / rate_hz
    for targets in motions(period_s).values():
        assert found(Motor(LAG_S, period_s), targets, period_ns=round(period_s * 1e9)) is None
    ramp, at = motions(period_s)["a ramp"], round(0.6 * rate_hz)
    assert found(Motor(LAG_S, period_s), ramp, stands_at=at, period_ns=round(period_s * 1e9)) <= at + 0.015 * rate_hz


@pytest.mark.parametrize(("speed", "within_s"), [(0.6, 0.01), (0.1, 0.02), (0.01, 0.09), (0.002, 0.33)])
@pytest.mark.parametrize("lag_s", [0.0, LAG_S])
def test_a_motor_that_stands_is_found_before_it_is_far_behind(speed, within_s, lag_s):
    t = np.arange(0.0, 1.5, PERIOD_NS * 1e-9)
    targets = speed * COUNTS_PER_RAD * np.clip(t - 0.2, 0.0, None)
    cycles = found(Motor(lag_s), targets, stands_at=300) - 300
    assert 0 <= cycles * PERIOD_NS * 1e-9 <= within_s


def test_a_drive_that_stands_beside_its_target_by_its_load_follows():
    class Loaded(Motor):
        def step(self, target):
            return super().step(target) - 40

    assert found(Loaded(LAG_S), motions()["a ramp"], counts=-40) is None


@pytest.mark.parametrize("stall_ns", [PERIOD_NS // 3, 2 * PERIOD_NS, 60_000_000])
def test_after_a_stall_of_the_master_the_drives_begin_from_rest(stall_ns):
    """Meanwhile they came to rest at their last targets."""
    following, t_ns, counts, motor = Following(MODEL, LAG_S, PERIOD_NS), 0, 0, Motor(LAG_S)
    for k, target in enumerate(motions()["a ramp"]):
        late = stall_ns if k == 300 else 0
        t_ns += PERIOD_NS + late
        for _ in range(round(late / PERIOD_NS)):
            counts = motor.step(motor.reference[-1])
        assert following.beyond(0, counts, t_ns) == 0.0, k
        # the targets go on by their step, from where they were
        following.aim([round(target)] * 6, [counts] * 6, t_ns)
        counts = motor.step(round(target))


@pytest.mark.parametrize("lag_s", [0.0, 1.5 * LAG_S])
@pytest.mark.parametrize("what", motions())
def test_drives_follow_a_master_whose_every_sync_is_up_to_nearly_half_a_period_late(what, lag_s):
    rng = np.random.default_rng(11)
    following, motor, sent = Following(MODEL, LAG_S, PERIOD_NS), TimedMotor(lag_s), 0
    for k, target in enumerate(motions()[what]):
        t_ns = (k + 1) * PERIOD_NS + round(rng.uniform(0.0, 0.45) * rng.integers(0, 2) * PERIOD_NS)
        counts = motor.sync(t_ns * 1e-9, sent)
        assert following.beyond(0, counts, t_ns) == 0.0, k
        sent = round(target)
        following.aim([sent] * 6, [counts] * 6, t_ns)


def test_what_is_not_known_is_not_compared():
    following = Following(MODEL, LAG_S, PERIOD_NS)
    assert following.beyond(0, 10**6, 0) == 0.0
    for k in range(400):
        following.aim([100 * k] * 6, [None] * 6, k * PERIOD_NS)
    assert following.beyond(0, 0, 400 * PERIOD_NS) == 0.0
    following.aim([40_000] * 6, [0] * 6, 400 * PERIOD_NS)
    following.forget()
    assert following.beyond(0, 0, 401 * PERIOD_NS) == 0.0


def test_rounding_and_noise_of_some_counts_are_no_motion():
    rng = np.random.default_rng(4)
    following = Following(MODEL, LAG_S, PERIOD_NS)
    for k in range(400):
        counts = int(rng.integers(-1, 2))
        assert following.beyond(0, counts, k * PERIOD_NS) == 0.0
        following.aim([0] * 6, [counts] * 6, k * PERIOD_NS)
    assert following.beyond(0, MIN_MARGIN_COUNTS + 3, 400 * PERIOD_NS) > 0.0
