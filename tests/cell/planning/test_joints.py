"""What arms of few or many joints can be asked for, and what the plan says of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from makes import MAKES, Entry, write_eds
from scenes import with_eds, with_joints

import canprobe
from canprobe.cell.plant.ideal_arm import natural_frequency
from canprobe.cell.scene.load import load_scene, parse_scene
from canprobe.errors import PlanError

TWO_AXES = """
[scene]
name = "two"
[cell]
[arm]
[sensor]
[joints.a]
min_deg = -170
max_deg = 170
speed_deg_s = 90
counts_per_turn = 4096
a_mm = 300
[joints.b]
min_deg = -170
max_deg = 170
speed_deg_s = 90
start_deg = 45
counts_per_turn = 4096
a_mm = 300
[object]
kind = "plane"
[task]
kind = "press"
start_mm = [300.0, 100.0, 0.0]
"""


def refusal(scene):
    with pytest.raises(PlanError) as refused:
        canprobe.plan(scene)
    return str(refused.value)


def test_a_gantry_keeps_its_pole_and_the_plan_says_so():
    plan = canprobe.plan(load_scene("plane", {"cell": "gantry"}))
    assert plan.setup.task.scan.rolling_share == 1.0
    assert any("holds the place of the probe, not its tilt" in warning for warning in plan.warnings)


def test_a_contact_that_leaves_the_array_is_refused_with_the_angle():
    scene = load_scene("cylinder", {"cell": "gantry"})
    said = refusal(scene)
    assert "up to 30.0 deg from the probe's pole" in said
    assert "beside the middle of the array, which reaches 12.7 mm" in said and "use an arm that tilts" in said
    assert canprobe.plan(replace(scene, object=replace(scene.object, radius_mm=100.0)))


def test_a_calibration_without_tilt_is_refused():
    assert "a calibration tilts the probe" in refusal(load_scene("calibrate", {"cell": "gantry"}))


def test_counts_that_leave_32_bits_are_refused_with_joint_drive_and_range():
    scene = load_scene("free")
    first, *_ = scene.joints.values()
    far = with_joints(scene, zero_counts=[(1 << 31) - 1000, 0, 0, 0, 0, 0])
    said = refusal(far)
    assert "joints.joint_1: drive 1 would count from" in said
    assert f"{first.min_deg:.1f} deg to {first.max_deg:.1f} deg" in said and "hold -2147483648 to 2147483647" in said
    many_turns = with_joints(scene, gear=[1, 1, 1, 1, 1, 1e5], counts_per_turn=[1000, 1000, 1000, 800, 800, 1e6])
    assert "joints.joint_6: drive 6" in refusal(many_turns)
    counts = round(1000 * first.gear * max(abs(first.min_deg), abs(first.max_deg)) / 360) + 1
    fits = refusal(with_joints(scene, zero_counts=[(1 << 31) - 1 - counts, 0, 0, 0, 0, 0]))
    assert "would count from" not in fits and "607Dh" in fits, "the packaged drive's 607Dh holds 24 bits"


@pytest.mark.parametrize("access", ["rw", "ro"])
def test_a_joint_keeps_within_a_drive_that_guards_less_than_its_range(tmp_path, access):
    narrow = "[607Dsub{0}]\nAccessType={1}\nLowLimit=-20000\nHighLimit=20000\nDefaultValue={2}"
    edits = [(rf"\[607Dsub{sub}\]", narrow.format(sub, access, end)) for sub, end in ((1, -20000), (2, 20000))]
    scene = with_eds(load_scene("free"), tmp_path, *edits)
    plan = canprobe.plan(scene)
    model, before = plan.setup.arm.model, canprobe.plan("free").setup.arm.model
    assert plan.setup.task.arm.model is model and "fault before the ends of their joints" in plan.warnings[0]
    units = model.units_per_q[0, 0] * np.array((model.q_min[0], model.q_max[0]))
    assert np.abs(units).max() <= 20000 < np.abs(before.units_per_q[0, 0] * before.q_min[0])
    assert "joints.joint_1.start_deg" in refusal(with_joints(scene, start_deg=[-154, 0, 0, 0, 0, 0]))


def test_two_joints_cannot_press():
    assert "cannot move the probe's centre and pole in every direction" in refusal(parse_scene(TWO_AXES))


def with_following_window(tmp_path, window, access):
    """The free scene with drives whose 6065h is as given."""
    scene = load_scene("free", {"bus.interface": "direct", "task.duration_s": 1.2})
    return with_eds(scene, tmp_path, (r"\[6065\]", f"[6065]\nAccessType={access}\nDefaultValue={window}"))


def test_joints_keep_within_the_speed_at_which_their_drives_lag_by_a_fixed_window(tmp_path):
    lag_s = 2.0 / natural_frequency(30.0)
    plan = canprobe.plan(with_following_window(tmp_path, 200, "ro"))
    model = plan.setup.arm.model
    fastest = np.abs(model.units_per_q) @ model.qd_max
    assert fastest.max() * lag_s == pytest.approx(200 - 2), "two counts are rounding"
    assert "6065h: drives that fault below the speeds" in plan.warnings[0]
    assert "servo.drive_lag_ms" in plan.warnings[0]
    assert canprobe.plan(with_following_window(tmp_path, 200, "rw")).warnings == ()
    assert canprobe.plan(with_following_window(tmp_path, 0xFFFFFFFF, "ro")).warnings == ()


def test_a_swing_that_a_following_window_allows_is_done_and_a_faster_one_refused(tmp_path):
    free = canprobe.plan(with_following_window(tmp_path, 0xFFFFFFFF, "ro"))
    speeds = np.abs(free.setup.arm.model.units_per_q) @ np.radians(free.joint_speeds.needed)
    lag = max(speeds) * 2.0 / natural_frequency(30.0)
    narrow = with_following_window(tmp_path, math.ceil(1.5 * lag) + 2, "ro")
    assert "6065h" in canprobe.plan(narrow).warnings[0]
    assert canprobe.run(narrow, bus="direct", files=False).summary["completed"]
    said = refusal(with_following_window(tmp_path, math.floor(0.5 * lag), "ro"))
    assert "6065h" in said and "swing slower" in said


@pytest.mark.parametrize(
    ("index", "name", "access", "held", "warned"),
    [
        (0x200E, "SYNC time-out factor", "ro", 2, True),
        (0x200E, "SYNC time-out factor", "rw", 2, True),
        (0x200E, "SYNC time-out factor", "ro", 5, False),
        (0x200E, "SYNC time-out factor", "ro", 0, False),
        (0x2000, "Missed SYNCs tolerated", "ro", 2, True),
        (0x2000, "Missed SYNCs tolerated", "rw", 2, False),
        (0x200E, "Something else", "ro", 2, False),
    ],
)
def test_drives_that_stop_sooner_than_their_master_thinks_are_named(tmp_path, index, name, access, held, warned):  # noqa: PLR0917
    make = MAKES["bare"]()
    make.objects[index, 0] = Entry(name, "U16", access, held)
    scene = load_scene("free")
    plan = canprobe.plan(replace(scene, arm=replace(scene.arm, eds=str(write_eds(make, tmp_path)))))
    said = [warning for warning in plan.warnings if warning.startswith("arm.missed_syncs = 5: ")]
    assert len(said) == warned
    if warned:
        assert f"by {index:04X}h of" in said[0] and "nodes 1, 2, 3, 4, 5, 6 stop by themselves after 2" in said[0]
        quick = replace(scene.arm, eds=plan.nodes[0].eds, missed_syncs=held)
        assert not any("arm.missed_syncs" in one for one in canprobe.plan(replace(scene, arm=quick)).warnings)
