"""What the plan says of the witnesses of the force, by what the cell has."""

import canprobe
from canprobe.cell.planning.contact import reports_torque, witness_rows
from canprobe.cell.planning.report import plan_dict, plan_text


def test_the_margin_and_the_error_of_the_depth_are_stated():
    rows = dict(witness_rows(canprobe.plan("cylinder")))
    assert "2 to 5 N are 0.21 mm" in rows["depth"] and "at 25 mm/s" in rows["depth"]
    assert "silent" in dict(witness_rows(canprobe.plan("cylinder", {"task.speed_mm_s": 60.0})))["depth"]
    assert "new ground" not in dict(witness_rows(canprobe.plan("press")))["depth"]


def test_without_torques_the_force_is_stated_that_a_blind_array_would_let_the_search_press_with():
    plan = canprobe.plan("press", {"arm.torque": False})
    assert not reports_torque(plan) and reports_torque(canprobe.plan("press"))
    torques = dict(witness_rows(plan))["torques"]
    assert "none" in torques and "996 N" in torques and "5 N as long as no image has changed" in torques


def test_a_short_approach_leaves_no_time_to_know_the_torques():
    torques = dict(witness_rows(canprobe.plan("press", {"task.clearance_mm": 0.5})))["torques"]
    assert torques.startswith("silent at the first contact") and "task.clearance_mm to 1" in torques
    assert "silent" not in dict(witness_rows(canprobe.plan("press", {"task.clearance_mm": 1.0})))["torques"]


def test_a_slow_approach_shows_a_push_less_surely_and_says_how_much():
    push = {
        speed: dict(witness_rows(canprobe.plan("press", {"task.approach_mm_s": speed})))["torques"] for speed in (4, 1)
    }
    assert push[4].startswith("a push of 2.5 N") and "approach_mm_s" not in push[4]
    assert push[1].startswith("a push of 13.0 N") and push[1].endswith(
        "at task.approach_mm_s = 1; until an image has changed the search ends after 0.57 mm"
    )


def test_a_scene_without_a_touch_has_none_and_the_others_show_them():
    assert witness_rows(canprobe.plan("free")) == []
    plan = canprobe.plan("calibrate")
    assert "witnesses of the force beside the array:" in plan_text(plan)
    assert set(plan_dict(plan)["witnesses"]) == {"images", "depth", "torques"}
