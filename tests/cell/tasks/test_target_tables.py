"""Force and speed that vary over the path or the time of a touch."""

import math

import numpy as np
import pytest

import canprobe
from canprobe.cell.scene.load import dump_scene, load_scene, parse_scene
from canprobe.cell.tasks.task import Phase
from canprobe.errors import PlanError, UsageError
from canprobe.mechanics.touch.servo import TARGET_RATES

PATH, TIME = "path_mm", "time_s"
CYCLE_S = 2.5e-3


@pytest.mark.parametrize(
    ("scene", "key", "table", "told"),
    [
        (
            "cylinder",
            "force_n",
            {PATH: [[0, 1], [20, 3], [10, 2]]},
            r"force_n\.path_mm: .* from 20 on .* point 3, got \[10, 2\]",
        ),
        ("cylinder", "force_n", {PATH: [[-1, 1]]}, r"expected path_mm from 0 on .* point 1, got \[-1, 1\]"),
        ("cylinder", "speed_mm_s", {PATH: [[0, 201]]}, r"speed_mm_s\.path_mm: .* above 0 up to 200 in point 1"),
        ("cylinder", "force_n", {PATH: [[0, 1], [9, 5]]}, r"expected less than limits\.force_max_n = 5, got 5"),
        ("cylinder", "force_n", {PATH: [[0, 1, 2]]}, r"expected a number .* or a table of path_mm or time_s: "),
        ("cylinder", "force_n", {PATH: [[0, math.nan]]}, r"task\.force_n: expected a number above 0"),
        ("cylinder", "force_n", {"path": [[0, 1]]}, r"table of path_mm or time_s: .* got \{path = \[\[0, 1\]\]\}"),
        ("cylinder", "force_n", {PATH: []}, r'points over path_mm or over time_s .* "scan", got 0 points over path_mm'),
        (
            "cylinder",
            "speed_mm_s",
            {PATH: [[0, 1]], TIME: [[0, 1]]},
            r"got 1 points over path_mm, 1 points over time_s",
        ),
        ("press", "force_n", {PATH: [[0, 1]]}, r'over time_s, as there is no path with task\.kind = "press"'),
        ("calibrate", "force_n", {TIME: [[0, 1]]}, r'expected a number with task\.kind = "calibrate"'),
        ("cylinder", "force_n", abs, r"got <built-in function abs>; type: canprobe\.sample_target"),
    ],
)
def test_a_table_that_cannot_be(scene, key, table, told):
    with pytest.raises(UsageError, match=told):
        load_scene(scene, {f"task.{key}": table})


def test_a_function_is_sampled_within_its_range_and_the_saved_scene_has_the_table():
    table = canprobe.sample_target(lambda mm: 2 + math.sin(mm / 20), PATH, 400, lowest=1, highest=3)
    scene = load_scene("cylinder", {"task.force_n": table})
    assert parse_scene(dump_scene(scene)) == scene
    assert scene.task.force_n[PATH][-1] == pytest.approx((400.0, 2 + math.sin(20)))
    for function in (lambda mm: 0.1 * mm, lambda mm: math.nan):
        with pytest.raises(UsageError, match=r"expected 0 to 3 at path_mm = \d+, got (3\.2|nan)"):
            canprobe.sample_target(function, PATH, 400, lowest=0, highest=3)


def test_the_plan_goes_by_the_worst_of_a_table():
    def planned(**task):
        return canprobe.plan("cylinder", {f"task.{key}": value for key, value in task.items()})

    low, high, both = (planned(force_n=force) for force in (1, 3, {PATH: [[0, 3], [9, 1]]}))
    assert both.setup.array.window == high.setup.array.window
    assert low.setup.touch.least_force == both.setup.touch.least_force == 1.0
    slow, fast, varied = (planned(speed_mm_s=speed) for speed in (5, 25, {TIME: [[0, 5], [9, 25]]}))
    assert varied.joint_speeds == fast.joint_speeds != slow.joint_speeds
    with pytest.raises(PlanError, match=r"task\.force_n = 4\.9: the array measures it to"):
        planned(force_n={TIME: [[0, 1], [9, 4.9]]})


def test_the_force_follows_a_table_over_the_path_and_a_jump_is_a_ramp():
    """The jump comes after 20 mm; the speed falls over time."""
    result = canprobe.run(
        "cylinder",
        {
            "task.force_n": {PATH: [[0, 1], [20, 1], [20, 2], [40, 3]]},
            "task.speed_mm_s": {TIME: [[0, 25], [4, 15]]},
        },
        bus="direct", duration_s=3.0, files=False,
    )  # fmt: skip
    log, truth = result.log, result.truth
    scan = np.flatnonzero(log["phase"] == Phase.SCAN)
    force, speed = log["target_force_n"][scan], log["target_speed_m_s"][scan]
    assert force[0] == 1.0 and force[-1] == pytest.approx(3.0)
    assert np.diff(force).max() == pytest.approx(TARGET_RATES["target_force_n"] * CYCLE_S)
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth["contact_point_m"][scan], axis=0), axis=1))])
    assert gone[np.flatnonzero(force > 1.0)[0]] == pytest.approx(0.020, abs=1e-3)
    assert speed[[0, -1]] == pytest.approx([0.025, 0.025 - 0.0025 * 3.0], abs=1e-4)
    contact = result.summary["contact"]
    off = np.sqrt(np.mean((truth["force_n"][scan] - force) ** 2))
    assert contact["force_rms_error_n"] == pytest.approx(off)
    assert contact["force_rms_error_n"] < 0.05 * contact["force_target_n"]
    assert contact["force_target_n"] == pytest.approx(force.mean())


def test_rules_lower_speed_and_force_by_what_the_estimator_answers():
    rules = {"task.slow_at_changes": True, "task.light_below_per_m": 1.0}
    targets = []
    for name in ("fillet", "cylinder"):
        result = canprobe.run(name, rules, bus="direct", duration_s=4.0, files=False)
        assert result.summary["completed"]
        targets.append((result.log["target_speed_m_s"], result.log["target_force_n"]))
    (speed, force), (even_speed, even_force) = targets
    assert np.nanmin(speed) == pytest.approx(0.0125, rel=0.05)  # where the plane runs into the cylinder
    assert np.nanmean(speed) < 0.022
    assert np.nanmean(even_speed) > 0.024
    for each in (force, even_force):
        assert 1.0 <= np.nanmin(each) < np.nanmax(each) == 2.0
