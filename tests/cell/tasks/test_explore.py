"""Exploration in a whole cell: it ends with its target, at edges it turns back, and the plan checks all of it."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import canprobe
from canprobe.cell.planning.make import make_plan
from canprobe.cell.results.text import summary_text
from canprobe.cell.scene.model import ObjectSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.explore import LIFT_M, Return, end_of
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import PlanError
from canprobe.mechanics.touch.probe_motion import RETREAT_SPEED_M_S
from canprobe.mechanics.touch.servo import ProbePose

SMALL = {"task.length_mm": 16.0, "task.width_mm": 12.0, "task.target_sigma_um": 15.0, "task.clearance_mm": 0.3}


def scene_with(keys, **changes):
    quick = {"bus.interface": "direct", "outputs.figures": False, "shape.also": ()}
    return replace(canprobe.load_scene("explore", quick | keys), **changes)


def run(keys, seconds=12.0, **changes):
    return canprobe.run(scene_with(keys, **changes), duration_s=seconds)


def explored_by(plan):
    """The end of an exploration by a plan, however the cell that it meets differs from the one that was planned."""
    task = make_task(plan)
    with Session(plan) as session:
        session.run(task)
    return task.record().explored


def ball(radius_mm):
    return ObjectSettings(kind="sphere", radius_mm=radius_mm, position_mm=(-170.0, -175.0, 300.0))


@pytest.fixture(scope="module")
def reached():
    return run(SMALL)


def test_it_ends_when_the_map_is_as_sure_as_was_asked(reached):
    summary, explored = reached.summary, reached.summary["explore"]
    assert summary["completed"]
    assert explored["reached"]
    assert explored["sigma_max_um"] <= 15.0
    assert explored["time_s"] < 12.0
    assert explored["why_not"] is None
    assert "reached after" in summary_text(summary, None)
    contact = summary["contact"]
    assert contact["contact_fraction"] == 1.0
    assert contact["force_rms_error_n"] < 0.1 * contact["force_target_n"]


def test_the_map_says_the_same_and_the_truth_is_as_near(reached):
    """Heights over the rectangle against the true surface: no path of the study and no cell of the explorer is used."""
    shape, task = reached.plan.setup.truth.object, reached.plan.setup.task
    x, y = np.meshgrid(np.linspace(-7e-3, 7e-3, 7), np.linspace(-5e-3, 5e-3, 5))
    start, axes = task.approach.start, task.approach.axes
    points = start + np.column_stack([x.ravel(), y.ravel()]) @ axes[:2]
    feet = np.array([shape.nearest(tuple(point)).point for point in points.tolist()])
    found = reached.surface_map.closest(feet)
    height = found.height
    assert np.isfinite(height).all()
    assert found.sigma_relative.max() < 1.3 * 15e-6
    assert np.sqrt(np.mean(height**2)) < 2.0 * 15e-6


def test_the_log_shows_the_deviation_over_the_path(reached):
    path, sigma = reached.log["explored_mm"], reached.log["explored_sigma_um"]
    known = np.isfinite(path)
    assert (np.diff(path[known]) >= 0.0).all()
    assert sigma[known][0] == 1000.0
    assert sigma[known][-1] <= 15.0


ALL, NONE = np.ones(6, dtype=bool), np.zeros(6, dtype=bool)


@pytest.mark.parametrize(
    ("common_um", "scatter_um", "closed", "wanting", "why"),
    [
        (8.0, 0.0, NONE, NONE, "8 µm of the deviation, from the stiffness of the layer, are common to the scan"),
        (8.0, 2.0, NONE, NONE, "8 µm of the deviation, from the stiffness of the layer, are common to the scan"),
        (6.0, 20.0, NONE, NONE, "on 100 % the contacts contradict a smooth surface"),
        (6.0, 1.0, np.arange(6) < 3, NONE, "50 % of the rectangle lie beyond an edge, in a hollow"),
        (6.0, 1.0, NONE, ALL, "the time was over with 100 % still above"),
        (6.0, 1.0, NONE, NONE, "the last cells are within a tenth of what can be reached"),
    ],
)
def test_what_is_not_reached_has_its_reason(common_um, scatter_um, closed, wanting, why):
    """Contacts contradict a smooth surface only where they scatter more than the scan has in common."""
    floor = np.full(6, 1e-6 * np.hypot(common_um, scatter_um))
    ground = SimpleNamespace(
        target=6e-6, sigma=floor, floor=floor, common=1e-6 * common_um, closed=closed, wanting=wanting,
        largest=floor[0],
    )  # fmt: skip
    explored = end_of(SimpleNamespace(ground=ground, path=0.1), 4.0, over=True)
    assert explored["why_not"].startswith(why) and ";" not in explored["why_not"]
    assert (explored["rough_fraction"], explored["closed_fraction"]) == (float(scatter_um > 8.0), closed.mean())
    assert not explored["reached"] and explored["common_sigma_um"] == pytest.approx(common_um)


def test_it_turns_back_from_a_hollow_as_tight_as_the_probe(tmp_path):
    """Beyond 14 mm the hollow has a radius of 31 mm: the probe of 40 mm would touch both of its walls."""
    x = np.arange(-25, 25.1, 0.5)
    bend = np.clip((x - 2.0) / 12.0, 0.0, 1.0) / 28.0 - 1.0 / 250.0
    slope = 0.5 * (np.cumsum(bend) - np.cumsum(bend)[50])
    trough = 0.5 * (np.cumsum(slope) - np.cumsum(slope)[50])
    file = tmp_path / "heights.npz"
    np.savez(file, heights=trough[:, None] - x[None] ** 2 / 300.0, spacing=0.5)
    hollow = ObjectSettings(
        kind="heights", file=str(file), position_mm=(-170.0, -175.0, 300.0), rotation_deg=(0.0, 0.0, 30.0)
    )
    result = run({"task.length_mm": 30.0, "task.width_mm": 20.0, "task.target_sigma_um": 20.0}, 3.0, object=hollow)
    assert result.summary["completed"], result.summary["stop_reason"]
    assert result.summary["explore"]["closed_fraction"] > 0.0
    assert "edge" in result.summary["explore"]["why_not"]
    assert result.summary["contact"]["force_max_n"] < 5.0


@pytest.mark.slow(reason="a whole exploration; the default has one that ends and one that turns back from a hollow")
def test_it_turns_back_before_the_contact_runs_off_the_array():
    """The pad does not follow the surface, and the object is rounder than the scene says."""
    keys = {"task.length_mm": 30.0, "task.width_mm": 20.0, "task.rolling_share": 1.0, "task.duration_s": 2.5}
    planned, met = (resolve(scene_with(keys, object=ball(radius))) for radius in (400.0, 45.0))
    plan = make_plan(planned)
    explored = explored_by(replace(plan, setup=replace(planned, truth=met.truth)))
    assert 0.0 < explored["closed_fraction"] < 0.6


@pytest.mark.slow(reason="a whole exploration; the default has one that ends and one that turns back from a hollow")
def test_it_turns_back_before_a_joint_comes_to_its_limit():
    """The margin of joint 1 is set so that a part of the rectangle lies beyond it, which the plan did not see."""
    plan = make_plan(resolve(scene_with(SMALL | {"task.duration_s": 3.0}, object=ball(60.0))))
    margin = plan.setup.limits.joint_margin.copy()
    margin[0] = plan.setup.arm.model.q_max[0] - np.radians(84.0)
    limited = replace(plan, setup=replace(plan.setup, limits=replace(plan.setup.limits, joint_margin=margin)))
    assert 0.0 < explored_by(limited)["closed_fraction"] < 0.6


def test_the_probe_returns_in_the_air_and_searches_from_the_known_surface_on():
    poses = [ProbePose(np.array([x, 0.0, 0.04]), np.array([0.0, 0.0, -1.0])) for x in (0.0, -2e-3, -5e-3)]
    way = Return(poses)
    times = np.linspace(0.0, 2.0, 401)
    x, _, z = np.array([way.pose(t).centre for t in times]).T
    assert z[0] == 0.04
    assert z.max() == pytest.approx(0.04 + LIFT_M)
    assert x.min() == x[-1] == pytest.approx(-5e-3)
    assert (np.hypot(np.diff(x), np.diff(z)) <= 1.01 * RETREAT_SPEED_M_S * 5e-3).all()
    assert all(
        way.searched(t) == pytest.approx(max(0.0, 0.04 - h), abs=1e-9) for t, h in zip(times[60:], z[60:], strict=True)
    )


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        (
            {"task.start_mm": (-120.0, -122.5, 374.0)},
            r"% of the rectangle cannot be reached, within 10 to 18 mm along the heading",
        ),
        ({"task.width_mm": 5.0}, r"an exploration at 25 mm/s needs 7.96 mm to turn round.* task.speed_mm_s to 15.7"),
        ({"limits.joint_speed_share": 0.05}, r"joint \d would need .* lower task.speed_mm_s"),
    ],
)
def test_the_plan_checks_the_whole_rectangle(keys, message):
    scene = canprobe.load_scene("explore", keys)
    scene = replace(scene, object=replace(scene.object, position_mm=scene.task.start_mm, rotation_deg=(0.0, 0.0, 0.0)))
    with pytest.raises(PlanError, match=message):
        canprobe.plan(scene)
