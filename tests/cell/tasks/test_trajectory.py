"""A trajectory from Python: its shape against scipy's, its limits, and a cell that follows it."""

from collections import deque

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

import canprobe
from canprobe.cell.master.controller import Measurement
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.cell.tasks import Trajectory
from canprobe.cell.tasks.requested import Request, RequestedTask
from canprobe.errors import SafetyStop, UsageError

PLAN = canprobe.plan(canprobe.load_scene("free"))
Q0 = PLAN.setup.arm.q_start
RNG = np.random.default_rng(5)
TIMES = np.cumsum(RNG.uniform(0.5, 2.0, 8))
POINTS = Q0 + RNG.uniform(-0.2, 0.2, (8, 6))


def led(points, velocities=None, **options):
    way = Trajectory(PLAN, points, velocities, **options)
    assert way.inspect(Q0) is None
    return way


def test_it_passes_the_points_as_scipys_monotone_cubic_and_starts_and_ends_at_rest():
    way = led(list(zip(TIMES, POINTS, strict=True)))
    times, q = np.array([0.0, *TIMES]), np.vstack([Q0, POINTS])
    slopes = PchipInterpolator(times, q).derivative()(times)
    slopes[[0, -1]] = 0.0
    expected = CubicHermiteSpline(times, q, slopes)
    for t in np.linspace(0.0, TIMES[-1], 301):
        np.testing.assert_allclose(way.at(t), expected(t), atol=1e-12)
    assert way.at(TIMES[-1] + 9.0) == pytest.approx(POINTS[-1])


def test_velocities_of_the_points_are_kept():
    speeds = RNG.uniform(-0.1, 0.1, (8, 6))
    way = led(list(zip(TIMES, POINTS, strict=True)), speeds)
    for t, qd in zip(TIMES[:-1], speeds, strict=False):
        np.testing.assert_allclose((way.at(t + 1e-6) - way.at(t - 1e-6)) / 2e-6, qd, atol=1e-5)


@pytest.mark.parametrize(
    ("points", "complaint"),
    [
        ([], "no point"),
        ([(1.0, Q0[:3])], r"positions of the points: expected shape \(1, 6\), got \(1, 3\)"),
        ([(1.0, "x")], "expected"),
        ([(-1.0, Q0)], "times from 0 on"),
        ([(1.0, Q0), (1.0, Q0)], "each later"),
        ([(1.0, Q0 * np.nan)], "finite"),
        ([(1.0, Q0), (2.0, Q0 + 9.0)], "point 2: joint 1 at"),
    ],
)
def test_points_that_are_none_are_refused_at_once(points, complaint):
    with pytest.raises(UsageError, match=complaint):
        Trajectory(PLAN, points)


@pytest.mark.parametrize(
    ("points", "velocities", "complaint"),
    [
        ([(0.05, Q0 + 0.3)], None, r"at 0 to 0.05 s: joint \d at .* deg/s, limit .* deg/s; give it .* times the time"),
        (
            [(0.0, Q0 + 0.1 * np.eye(6)[0])],
            None,
            "joint 1 stands at 90.00 deg; the first point, at time 0, is at 95.73 deg",
        ),
        ([(1.0, Q0), (9.0, Q0)], [np.full(6, 1.0), np.zeros(6)], "leaves its range between the points"),
    ],
)
def test_a_way_that_cannot_be_gone_is_refused_before_anything_moves(points, velocities, complaint):
    assert Trajectory(PLAN, points, velocities).inspect(Q0) is not None
    with (
        pytest.raises(SafetyStop, match=complaint),
        canprobe.open_cell(canprobe.load_scene("free"), bus="direct") as cell,
    ):
        cell.run(Trajectory(cell.plan, points, velocities))


def test_a_way_out_of_the_workspace_is_refused():
    box = "[limits]\nworkspace_min_mm = [-2000, -2000, 0]\nworkspace_max_mm = [2000, 2000, 2000]"
    plan = canprobe.plan(parse_scene(dump_scene(canprobe.load_scene("free")).replace("[limits]", box)))
    low = np.array([0.76, -1.2, -2.18, -0.3, 0.08, 0.2])  # 237 mm below the base
    reason = Trajectory(plan, [(9.0, Q0), (19.0, low)]).inspect(Q0)
    assert reason is not None
    assert "at 9 to 19 s: the probe's tip at z = " in reason and "workspace ends at 0.0 mm" in reason


def test_a_cell_follows_it_and_holds_the_end():
    with canprobe.open_cell(canprobe.load_scene("free"), bus="direct") as cell:
        result = cell.run(Trajectory(cell.plan, [(0.0, Q0 + 0.001), (1.0, Q0 + 0.1), (2.0, Q0)], hold_s=0.25))
    q, t = result.log["q_rad"], result.log["t_s"]
    assert np.abs(q - Q0).max(axis=0) == pytest.approx(np.full(6, 0.1), abs=1e-3)
    assert np.abs(q[-1] - Q0).max() < 1e-3
    assert t[-1] - t[0] > 2.25


@pytest.mark.parametrize("late", [1, 4, 34])
def test_the_first_target_after_a_late_cycle_does_not_jump(late):
    """The motion makes up for four periods, an eighth more in each cycle, and still ends in its last point."""
    way = led([(2.0, Q0 + 0.2)], hold_s=0.0)
    targets, done, k = [], False, 0
    while not done:
        passed = k if k < 400 else k + late - 1
        command = way.step(Measurement(k, passed * 2_500_000, Q0))
        targets, done, k = [*targets, command.q_target], command.done, k + 1
    steps = np.abs(np.diff(targets, axis=0)).max(axis=1)
    assert np.diff(steps).max() < 0.13 * steps[398]
    assert steps[398] == pytest.approx(steps[396], rel=0.01)
    assert steps[399] == pytest.approx((1.0 if late == 1 else 1.125) * steps[398], rel=0.01)
    assert len(steps) == 800 - min(late - 1, 4)
    assert targets[-1] == pytest.approx(Q0 + 0.2)


def requested(*requests, late=()):
    """Targets of an arm at rest that gets each request in its cycle: (cycle, kind, value).

    Cycles that are `late` come three periods after the one before.
    """
    queue, targets = deque(), []
    controller = RequestedTask(None, None, (queue,), 2.5e-3, PLAN)
    for k in range(1200):
        queue += [Request(kind, value) for at, kind, value in requests if at == k]
        passed = k + 2 * sum(at <= k for at in late)
        command = controller.step(Measurement(k, passed * 2_500_000, Q0))
        if command.q_target is not None:
            targets.append(command.q_target)
        if command.done:
            break
    return np.array(targets)


def test_a_new_trajectory_and_a_stop_take_over_the_speed_of_the_arm():
    first = {"points": [(2.0, Q0 + 0.2)], "velocities": None}
    second = {"points": [(1.0, Q0)], "velocities": None}
    for requests in ((500, "trajectory", second), (400, "stop", None)):
        targets = requested((0, "trajectory", first), requests)
        jump = np.abs(np.diff(targets, 2, axis=0)).max() / 2.5e-3  # of the speed, from cycle to cycle
        assert jump < 0.01
        assert np.abs(np.diff(targets[-3:], axis=0)).max() / 2.5e-3 < 0.01


def test_a_stop_behind_a_late_cycle_takes_over_the_speed_and_not_the_step():
    """The last step of the target was a longer one, and the arm is no faster for it."""
    first = {"points": [(2.0, Q0 + 0.2)], "velocities": None}
    targets = requested((0, "trajectory", first), (400, "stop", None), late=(399,))
    steps = np.abs(np.diff(targets, axis=0)).max(axis=1)
    assert steps[398] == pytest.approx(1.125 * steps[397], rel=0.01)
    assert steps[399:].max() < 1.01 * steps[397]
