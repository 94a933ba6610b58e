"""A path that asks too much of a joint is turned, by no more than is needed, or refused with the possible speed."""

import re
from dataclasses import replace

import pytest

import canprobe
from canprobe.errors import PlanError
from canprobe.planning.reach import check_motion
from canprobe.planning.text import plan_text
from canprobe.scene_loader import load_scene


def scan(speed, **task):
    scene = load_scene("cylinder")
    return replace(scene, task=replace(scene.task, speed_mm_s=speed, **task))


def test_a_path_too_fast_for_a_joint_is_turned_no_further_than_needed():
    asked = scan(100.0)
    before, _ = check_motion(asked)
    slowest = max(range(6), key=lambda i: before.needed_deg_s[i] / before.limit_deg_s[i])
    plan = canprobe.plan(asked)
    turn = plan.scene.task.heading_deg - asked.task.heading_deg
    assert 0 < abs(turn) <= 90
    assert plan.joint_speeds.worst_share <= 1.0 < before.worst_share
    for smaller in (abs(turn) - 5.0, 5.0 - abs(turn)):
        nearer = replace(asked, task=replace(asked.task, heading_deg=asked.task.heading_deg + smaller))
        assert check_motion(nearer)[0].worst_share > 1.0
    (choice,) = plan.choices
    assert choice.key == "task.heading_deg"
    assert float(choice.value) == plan.scene.task.heading_deg
    assert choice.why.startswith(
        f"path turned by {turn:g} deg: at 100 mm/s along 110 deg joint {slowest + 1} would need"
    )
    assert choice.why in plan_text(plan)
    assert canprobe.plan(plan.scene).scene == plan.scene, "the child that serves the nodes plans the same"


def test_what_is_slow_enough_stays_as_it_was_asked():
    plan = canprobe.plan(scan(75.0))
    assert plan.scene.task.heading_deg == 110.0
    assert plan.choices == ()


def test_a_scene_may_forbid_it():
    with pytest.raises(PlanError, match="joint 1 would need"):
        canprobe.plan(scan(100.0, turn_max_deg=0.0))


def test_a_speed_that_no_direction_allows_is_refused_with_the_one_that_is_possible():
    with pytest.raises(PlanError) as caught:
        canprobe.plan(scan(180.0))
    last = caught.value.problems[-1]
    speed, heading = map(
        float, re.search(r"either: (\d+) mm/s are the most, at task.heading_deg = (\S+)", last).groups()
    )
    assert check_motion(scan(0.97 * speed, heading_deg=heading))[1] == []
    assert check_motion(scan(1.03 * speed, heading_deg=heading))[1] != []
    assert speed > 1.3 * scan(180.0).task.speed_mm_s / check_motion(scan(180.0))[0].worst_share
