"""Reach, joint speeds and geometry of a plan."""

import dataclasses
import math
import re

import numpy as np
import pytest
from scenes import change, reasons, with_joints

import canprobe
from canprobe.cell.planning.surface_path import over_path, surface_path
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ObjectSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.touch.objects import make_object
from canprobe.mechanics.touch.probe_motion import MOVE_SPEED_M_S, LineMotion, ProbePose


@pytest.fixture(scope="module")
def cylinder():
    return load_scene("cylinder")


FAR, SMALL = (-400.0, -400.0, 374.0), {"length_mm": 10.0, "width_mm": 4.0}


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        (
            {"object": {"position_mm": FAR}, "task": {"start_mm": FAR}},
            "contact at .-4.* out of reach of the puma260 arm",
        ),
        ({"object": {"rotation_deg": (0, 0, -48.81)}, "task": {"heading_deg": 41.19}}, "joint 1 .*its stop, 110"),
        ({"object": {"position_mm": (-120.0, -122.5, 384.0)}}, "10.0 mm above"),
        ({"object": {"position_mm": (-120.0, -122.5, 362.0)}}, "12.0 mm below"),
        ({"task": {"start_mm": (-120.0, -222.5, 374.0)}}, "does not meet the object"),
        ({"task": {"length_mm": 80.0}}, "leaves the object"),
    ],
)
def test_a_path_that_the_arm_or_the_object_does_not_have_is_refused(cylinder, sections, said):
    (problem,) = reasons(change(cylinder, **sections))
    assert re.search(said, problem)


@pytest.mark.parametrize(
    ("kind", "keys", "tighter"),
    [
        ("bowl", {"radius_mm": 40}, True),
        ("bowl", {"radius_mm": 60}, False),
        ("saddle", {"radius_x_mm": 60, "radius_y_mm": -35}, True),
        ("cylinder", {"radius_mm": 12, "rotation_deg": (0, 0, 20)}, False),
    ],
)
def test_a_hollow_tighter_than_the_probe_is_refused(cylinder, kind, keys, tighter):
    scene = dataclasses.replace(change(cylinder, task=SMALL), object=ObjectSettings(kind, **keys))
    if tighter:
        assert any("tighter than the probe of radius 40 mm" in problem for problem in reasons(scene))
    else:
        assert canprobe.plan(scene)


def test_start_posture_outside_the_range(cylinder):
    problems = reasons(with_joints(cylinder, start_deg=(109.5, 65.0, 15.0, 0.0, 100.0, 300.0)))
    assert any("joints.joint_1.start_deg: at 109.5 deg, allowed -179 to 109" in problem for problem in problems)
    assert any("joints.joint_6.start_deg: at 300" in problem for problem in problems)


def test_speed_beyond_the_joints_is_refused_with_a_speed_that_fits(cylinder):
    fast = change(cylinder, task={"speed_mm_s": 200.0})
    problems = reasons(fast)
    assert any("joint 1 would need" in problem for problem in problems)
    fitting = float(problems[0].split("task.speed_mm_s to ")[1].split(",")[0])
    assert canprobe.plan(change(cylinder, task={"speed_mm_s": fitting}))


def test_joint_speeds_scale_with_the_contact_speed(cylinder):
    slow, fast = (canprobe.plan(change(cylinder, task={"speed_mm_s": v})).joint_speeds for v in (10.0, 30.0))
    np.testing.assert_allclose(np.array(fast.needed), 3 * np.array(slow.needed), atol=0.01)


def test_swing_of_a_free_scene():
    scene = load_scene("free")
    speeds = canprobe.plan(scene).joint_speeds
    assert speeds.needed[0] == pytest.approx(5 * 2 * math.pi / 4, abs=1e-3)
    assert any("joint 1 would move" in p for p in reasons(with_joints(scene, swing_deg=(25.0, 5, 5, 5, 5, 5))))
    assert any("swing slower" in p for p in reasons(change(scene, task={"swing_period_s": 0.1})))


@pytest.mark.parametrize("name", ["cylinder", "saddle"])
def test_path_lies_on_the_object_and_spans_the_region(name):
    scene = load_scene(name)
    setup = resolve(scene)
    path = surface_path(setup.task, setup.truth.object)
    shape = true_object(scene.object)
    assert max(abs(shape.closest(point).distance) for point in path.points) < 1e-9
    heading = np.radians(scene.task.heading_deg)
    along = (path.points[:, :2] - np.array(scene.task.start_mm[:2]) * 1e-3) @ [np.cos(heading), np.sin(heading)]
    assert 1e3 * np.ptp(along) == pytest.approx(scene.task.length_mm, abs=0.1)
    assert np.all(path.normals[:, 2] > 0.5), "outward normals look at the approaching probe"


def test_without_an_object_the_expected_plane_is_checked(cylinder):
    real = dataclasses.replace(
        change(cylinder, arm={"emulated": False}, sensor={"emulated": False}), object=None, plant=None
    )
    plan = canprobe.plan(real)
    assert not plan.setup.emulates and plan.scene.emulated_node_ids == ()
    assert plan.joint_speeds.needed[0] > 0
    path = surface_path(resolve(real).task, None)
    np.testing.assert_allclose(path.normals, np.tile([0, 0, 1], (len(path.normals), 1)))


def test_all_reasons_come_at_once(cylinder):
    scene = change(cylinder, sensor={"mode": "image"}, cycle={"rate_hz": 400.0}, task={"length_mm": 80.0})
    problems = reasons(with_joints(scene, start_deg=(200.0, 65.0, 15.0, 0.0, 100.0, 0.0)))
    for word in ("worst-case load", "leaves the object", "joints.joint_1.start_deg"):
        assert any(word in problem for problem in problems)


def tilted(scene, degrees, clearance_mm=3.0):
    plane = ObjectSettings("plane", rotation_deg=(degrees, 0.0, 0.0))
    small = change(scene, task={"length_mm": 6.0, "width_mm": 3.0, "clearance_mm": clearance_mm})
    return dataclasses.replace(small, object=plane)


def test_a_first_touch_beside_the_array_is_refused(cylinder):
    """A probe of 40 mm meets a tilted plane 40 mm · tilt beside its pole; the array ends at 12.7 mm, 18.2 degrees.

    At 14.3 degrees the touch stays on the array, from 16 degrees on a run stops it.
    """
    assert canprobe.plan(tilted(cylinder, 14.3))
    assert "would be 11.2 mm beside the middle" in reasons(tilted(cylinder, 16.0))[0]
    (problem,) = reasons(tilted(cylinder, 18.5))
    assert "would be 12.9 mm beside the middle of the array, which reaches 12.7 mm" in problem
    assert "turn task.approach_normal by 18 deg" in problem or "turn task.approach_normal by 19 deg" in problem


def test_a_contact_that_runs_off_an_array_that_does_not_turn_is_refused(cylinder):
    """Along 36 mm of a cylinder of 36 mm the normal turns by 30 degrees to each side."""
    for share, stays in ((0.05, True), (0.4, True), (0.6, False), (1.0, False)):
        scene = change(cylinder, task={"rolling_share": share, "speed_mm_s": 5.0})
        if stays:
            canprobe.plan(scene)
        else:
            (problem,) = reasons(scene)
            assert "the contact would run off the array" in problem and "lower task.rolling_share" in problem


def test_an_array_that_is_smaller_than_the_patch_is_refused(cylinder):
    press = change(load_scene("press"), sensor={"mode": "image", "rows": 16, "columns": 2})
    (problem,) = [problem for problem in reasons(press) if "sensor.columns" in problem]
    assert "sensor.columns = 2: the array is 3.175 mm wide" in problem


def rounded_spread(scene, coarser):
    """Spread of the force over itself, as the joints' counts round at the first contact; by drawing."""
    setup = resolve(scene)
    model, T_flange_probe = setup.arm.model, setup.probe.T_flange_probe
    rng = np.random.default_rng(5)
    rounding = coarser * rng.uniform(-0.5, 0.5, (400, model.n)) @ model.q_per_unit.T
    path = surface_path(setup.task, setup.truth.object)
    places = np.array([(forward(model.chain, setup.arm.q_start + dq) @ T_flange_probe)[:3, 3] for dq in rounding])
    depth = math.sqrt(setup.touch.force / (math.pi * setup.probe.stiffness * setup.probe.radius))
    forces = (1.0 + (places - places.mean(axis=0)) @ path.normals[0] / depth) ** 2
    return float(np.std(forces))


def test_counts_too_coarse_to_hold_the_force_are_refused():
    """A press at the start posture: by drawn roundings, the force may swing by 20 % and no more."""
    press = load_scene("press")
    counts = np.array([joint.counts_per_turn for joint in press.joints.values()])
    limit = 0.2 / rounded_spread(press, 1.0)
    assert rounded_spread(press, limit) == pytest.approx(0.2, rel=0.05)
    canprobe.plan(with_joints(press, counts_per_turn=counts / (0.85 * limit)))
    (problem,) = reasons(with_joints(press, counts_per_turn=counts / (1.2 * limit)))
    assert problem.startswith("joints.joint_") and "the force would swing by 2" in problem
    assert "does not settle" in problem and "task.force_n" in problem
    softer = float(re.search(r"probe.stiffness_n_m3 = ([\d.e+]+)", problem)[1])
    canprobe.plan(change(with_joints(press, counts_per_turn=counts / (1.2 * limit)), probe={"stiffness_n_m3": softer}))


def test_a_force_that_saturates_the_array_is_refused():
    """The peak of the layer's pressure on a plane, blurred by the Gaussian of the array, against its full scale."""
    plane = change(load_scene("press"), task={"force_n": 3.0}, sensor={"window": 10})
    plane = dataclasses.replace(plane, object=dataclasses.replace(plane.object, kind="plane", radius_mm=None))
    setup = resolve(plane)
    k, radius, blur = setup.probe.stiffness, setup.probe.radius, setup.array.calibration.image.blur
    depth = math.sqrt(3.0 / (math.pi * k * radius))
    x, y = np.meshgrid(*2 * [np.linspace(-0.01, 0.01, 801)])
    weights = np.exp(-0.5 * (x * x + y * y) / blur**2)
    pressure = k * np.maximum(depth - (x * x + y * y) / (2.0 * radius), 0.0)
    peak_kpa = 1e-3 * float(np.sum(weights * pressure) / np.sum(weights))
    canprobe.plan(change(plane, sensor={"full_scale_kpa": 1.02 * peak_kpa}))
    (problem,) = reasons(change(plane, sensor={"full_scale_kpa": 0.9 * peak_kpa}))
    assert f"up to {peak_kpa:.1f} kPa" in problem and problem.startswith("sensor.full_scale_kpa")
    lower = float(re.search(r"lower task.force_n to ([\d.]+)", problem)[1])
    assert 2.0 < lower < 3.0
    canprobe.plan(change(plane, sensor={"full_scale_kpa": 0.9 * peak_kpa}, task={"force_n": lower}))


def test_a_probe_that_would_be_in_the_object_before_its_approach_is_refused(cylinder):
    (problem,) = reasons(tilted(cylinder, 25.0))
    deep = 40.0 - 43.0 * math.cos(math.radians(25.0))
    assert f"the probe would be {deep:.1f} mm in the object before its approach, 25 deg beside it" in problem
    assert "first touch would be" in reasons(tilted(cylinder, 25.0, clearance_mm=6.0))[0]


def test_the_path_over_heights_of_a_cylinder_is_that_over_the_cylinder():
    """A ball rolls over heights, and its contacts lie where a path over the formula has them."""
    setup = resolve(load_scene("cylinder"))
    y = np.arange(-0.025, 0.0251, 5e-4)
    z = np.tile(np.sqrt(0.036**2 - y**2) - 0.036, (161, 1))
    shape = setup.truth.object
    heights = make_object("heights", T_base_object=shape.T_base_object, heights=z, spacing=5e-4, origin=(0, 0))
    exact, rolled = surface_path(setup.task, shape), surface_path(setup.task, heights)
    assert np.linalg.norm(exact.points - rolled.points, axis=1).max() < 5e-4
    assert np.sum(exact.normals * rolled.normals, axis=1).min() > math.cos(math.radians(1.0))


def test_a_posture_in_which_an_emulated_arm_is_parked_must_be_in_reach(cylinder):
    """The arm reaches the contact, and not the place 5 mm above the clearance, where it stands at power on."""
    place = (-120.0, -122.5, 490.0)
    high = change(load_scene("press"), object={"position_mm": place}, task={"start_mm": place, "clearance_mm": 3.0})
    assert canprobe.plan(high)
    (problem,) = reasons(change(high, task={"clearance_mm": 50.0}))
    assert problem.startswith("task.clearance_mm = 50: an emulated arm begins 5 mm above it, and cannot: ")


def test_an_approach_beyond_the_joints_is_refused_with_a_speed_that_fits():
    """The arm would lag behind the approach, which then finds no object."""
    slow = change(load_scene("press"), limits={"joint_speed_share": 0.002})
    (problem, *_) = reasons(slow)
    fitting = float(problem.split("task.approach_mm_s to ")[1])
    assert canprobe.plan(change(slow, task={"approach_mm_s": fitting}))


def test_the_way_of_a_touch_goes_over_the_approach_to_the_first_contact():
    """In steps of which none is faster than a move of minimum jerk at its fastest."""
    setup = resolve(load_scene("press"))
    task = setup.task
    above = task.approach.start + (task.approach.clearance + task.probe.radius) * task.approach.normal
    start = ProbePose(above + np.array([0.1, 0.0, 0.05]), -task.approach.normal)
    way = [(start, 0.0), *over_path(task, surface_path(task, setup.truth.object), start)]
    away = [float(np.linalg.norm(pose.centre - above)) for pose, _ in way]
    last = int(np.argmin(away))
    assert away[last] == pytest.approx(0.0, abs=1e-9) and away[: last + 1] == sorted(away[: last + 1], reverse=True)
    seconds = [seconds for _, seconds in way[1 : last + 1]]
    assert sum(seconds) == pytest.approx(LineMotion(start, ProbePose(above, start.pole), MOVE_SPEED_M_S).duration)
    speeds = -np.diff(away[: last + 1]) / seconds
    assert last > 3 and speeds.max() <= 15 / 8 * MOVE_SPEED_M_S
