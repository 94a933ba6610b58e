"""The whole plant: truth agrees with the bodies, with its own derivatives and with the image."""

import math

import numpy as np
import pytest
from puma_arm import BODIES, ELBOW_FORM, POINT, TOOL, UPENN, pressing
from scipy.spatial.transform import Rotation

from canprobe.cell.plant.config import PlantConfig, PressMotion
from canprobe.cell.plant.elastic_contact import depth_for_force, total_force
from canprobe.cell.plant.plant import Plant
from canprobe.cell.plant.pressure import pad_direction
from canprobe.cell.plant.taxels import IDEAL_TAXELS
from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.inverse import inverse_near
from canprobe.mechanics.robot.model import joints_per_motor, joints_to_units, units_per_motor, units_to_joints
from canprobe.mechanics.touch.objects import make_object
from canprobe.mechanics.touch.shapes import LIP_M

PITCH_M = 1.5875e-3
MS = 1_000_000
CYCLE = 2_500_000
SHAPES = {
    "plane": {},
    "cylinder": {"radius": 0.036},
    "saddle": {"radius_x": 0.06, "radius_y": -0.08},
}
BENT = pytest.mark.parametrize("kind", ["cylinder", "saddle"])


def placed(kind, yaw_deg=-48.81, tilt_deg=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zx", (yaw_deg, tilt_deg), degrees=True).as_matrix()
    T[:3, 3] = POINT
    return make_object(kind, T_base_object=T, **SHAPES[kind])


def plant(kind="cylinder", *, depth=0.4e-3, tilt_deg=0.0, **settings):
    shape = placed(kind, tilt_deg=tilt_deg)
    return Plant(pressing(shape, depth, **settings))


def posture_of(T_base_probe):
    return inverse_near(UPENN, T_base_probe, TOOL, ELBOW_FORM)


def push(p, q_to, t0, t1):
    """Ramp every motor from where it is to the counts of q_to."""
    goal = joints_to_units(UPENN, q_to)
    for axis in range(6):
        p.set_ramp(axis, p.motor_counts(axis), float(goal[axis]), t0, t1)


@pytest.mark.parametrize("kind", SHAPES)
def test_start_depth_and_force_are_as_asked(kind):
    kappa = placed(kind).closest(POINT).kappa
    depth = depth_for_force(2.0, tuple(kappa), 0.04, 1.27e8)
    truth = plant(kind, depth=depth).truth()
    assert truth["depth"] == pytest.approx(depth, abs=1e-12)
    assert truth["force"] == pytest.approx(2.0, rel=1e-6)
    assert truth["contact_point"] == pytest.approx(POINT, abs=1e-12)
    assert truth["contact_normal"] == pytest.approx((0, 0, 1), abs=1e-12)
    assert truth["pole"] == pytest.approx((0, 0, -1), abs=1e-12)
    assert truth["pad_uv"] == pytest.approx((0, 0), abs=1e-12)


@BENT
def test_contact_geometry_closes_while_the_arm_moves(kind):
    p = plant(kind)
    push(p, p.truth()["q"] + np.array((0.02, 0.004, -0.006, 0.03, -0.05, 0.1)), 0, 40 * MS)
    for k in range(30):
        p.advance(k * CYCLE)
        t = p.truth()
        T = forward(UPENN.chain, t["q"]) @ TOOL
        assert t["probe_centre"] == pytest.approx(T[:3, 3], abs=1e-14)
        assert t["pole"] == pytest.approx(T[:3, 2], abs=1e-14)
        towards = T[:3, :3] @ pad_direction(*t["pad_uv"], 0.04)
        assert towards == pytest.approx(-t["contact_normal"], abs=1e-12)
        assert t["contact_point"] == pytest.approx(t["probe_centre"] + (0.04 - t["depth"]) * towards, abs=1e-12)
        assert np.cross(t["direction1"], t["direction2"]) == pytest.approx(t["contact_normal"], abs=1e-12)
    assert np.linalg.norm(t["pad_uv"]) > 1e-4


@BENT
def test_depth_rate_is_the_derivative_of_depth(kind):
    p = plant(kind)
    push(p, p.truth()["q"] + np.array((0.02, 0.004, -0.006, 0.03, -0.05, 0.1)), 0, 30 * MS)
    for start in (5, 12, 20):
        depths = []
        for t in (start * MS - 10_000, start * MS, start * MS + 10_000):
            p.advance(t)
            depths.append(p.truth()["depth"])
            if t == start * MS:
                rate = p.truth()["depth_rate"]
        assert rate == pytest.approx((depths[2] - depths[0]) / 20e-6, rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("sign", [1, -1])
def test_damping_raises_force_while_loading_and_lowers_it_while_leaving(sign):
    forces = {}
    for damping in (0.0, 2.0):
        p = plant("plane", damping_s_m=damping)
        q = p.truth()["q"]
        J = forward_jacobian(UPENN.chain, q, TOOL)[1]
        push(p, q + np.linalg.solve(J, (0, 0, -sign * 1e-4, 0, 0, 0)), 0, 10 * MS)
        p.advance(8 * MS)
        truth = p.truth()
        forces[damping] = truth["force"]
    assert math.copysign(1, truth["depth_rate"]) == sign
    assert forces[2.0] / forces[0.0] == pytest.approx(1 + 3.0 * truth["depth_rate"])


def test_repeated_calls_at_one_instant_change_nothing():
    p, twin = plant(), plant()
    push(p, ELBOW_FORM, 0, 500 * MS)
    push(twin, ELBOW_FORM, 0, 500 * MS)
    for k in range(1, 9):
        t = k * CYCLE
        for _ in range(6):
            p.advance(t)
            p.motor_counts(k % 6)
            p.torque_permille(k % 6)
            p.truth()
        images = [p.sample_image(t) for _ in range(3)]
        assert all(np.array_equal(images[0], i) for i in images)
        assert np.array_equal(images[0], twin.sample_image(t))
        p.advance(t - 1000)
    assert all(np.array_equal(a, b) for a, b in zip(p.truth().values(), twin.truth().values(), strict=True))


def test_truth_of_a_state_taken_earlier_is_the_truth_of_then():
    p = plant()
    push(p, p.truth()["q"] + np.array((0.02, 0.004, -0.006, 0.03, -0.05, 0.1)), 0, 40 * MS)
    p.advance(20 * MS)
    state, then = p.state(), p.truth()
    p.advance(60 * MS)
    assert not np.array_equal(p.truth()["q"], then["q"])
    assert all(np.array_equal(a, b) for a, b in zip(p.truth(state).values(), then.values(), strict=True))


def test_the_caller_may_keep_and_change_an_image():
    p = plant()
    p.sample_image(MS)[:] = 7
    assert not np.all(p.sample_image(MS) == 7)


@BENT
def test_image_is_the_overlap_of_probe_and_object_in_base(kind):
    """Every taxel against the signed distance of its own point: no shared formula, any flipped axis shows."""
    shape = placed(kind, tilt_deg=3.0)
    q = ELBOW_FORM + np.array((0, 0, 0, 0.05, 0.04, 0.7))
    z = forward(UPENN.chain, q) @ TOOL
    gap = shape.closest(z[:3, 3]).distance
    T = z.copy()
    T[:3, 3] += (0.0396 - gap) * shape.closest(z[:3, 3]).normal
    q = posture_of(T)
    config = IDEAL_TAXELS.without("threshold")
    p = Plant(PlantConfig(UPENN, q, object=shape, taxels=config, damping_s_m=0.0))
    image = p.sample_image(0) / 255.0 * config.full_scale_pa
    T = forward(UPENN.chain, q) @ TOOL
    expected = np.zeros((16, 16))
    for i in range(16):
        for j in range(16):
            for dv in (-1 / 3, 0, 1 / 3):
                for du in (-1 / 3, 0, 1 / 3):
                    direction = pad_direction((j - 7.5 + du) * PITCH_M, (i - 7.5 + dv) * PITCH_M, 0.04)
                    skin = T[:3, 3] + 0.04 * (T[:3, :3] @ direction)
                    expected[i, j] += 1.27e8 * max(0.0, -shape.closest(skin).distance) / 9
    assert expected.max() > 30e3
    assert np.abs(image - expected).max() < 0.04 * expected.max()
    assert np.linalg.norm(p.truth()["pad_uv"]) > 1e-3


def test_in_the_air_the_closest_point_is_still_reported():
    truth = plant(depth=-5e-3).truth()
    assert (truth["force"], truth["in_contact"]) == (0.0, False)
    assert truth["depth"] == pytest.approx(-5e-3)
    assert truth["contact_point"] == pytest.approx(POINT)
    assert not plant(depth=-5e-3).sample_image(MS).any()


def test_arm_without_an_object():
    p = Plant(PlantConfig(UPENN, ELBOW_FORM))
    truth = p.truth()
    assert truth["in_contact"] is False
    assert all(np.all(np.isfinite(v)) for v in truth.values())
    assert truth["probe_centre"] == pytest.approx((forward(UPENN.chain, ELBOW_FORM) @ TOOL)[:3, 3])
    assert not p.sample_image(MS).any()


def test_arm_without_an_array_gives_dark_images():
    assert not plant(taxels=None).sample_image(0).any()


def test_sensor_alone_is_pressed_slowly_around_the_force():
    p = Plant(PlantConfig(None, object=placed("cylinder", tilt_deg=20.0)))
    mean = depth_for_force(2.0, (1 / 0.036, 0.0), 0.04, 1.27e8)
    depths = []
    for k in range(401):
        p.advance(k * 5 * MS)
        truth = p.truth()
        depths.append(truth["depth"])
        assert truth["in_contact"]
        assert truth["pad_uv"] == pytest.approx((0, 0), abs=1e-12)
    assert (min(depths), max(depths)) == pytest.approx((0.6 * mean, 1.4 * mean), rel=1e-4)
    assert depths[0] == pytest.approx(mean)
    assert depths[400] == pytest.approx(mean)  # 2 s: one period of 0.5 Hz
    assert depths[100] == pytest.approx(1.4 * mean)  # pressing in first
    assert p.sample_image(2001 * MS).any()
    assert p.motor_counts(0) == 0.0
    assert p.torque_permille(0) == 0
    with pytest.raises(RuntimeError, match="no arm"):
        p.set_ramp(0, 0.0, 1.0, 0, 1)


def test_sensor_alone_faces_the_object_with_right_handed_axes():
    """Curvature is low along object (1, -1); pad x is object x and pad y is -object y: long along pad (1, 1)."""
    matrix = np.zeros((4, 4))
    matrix[:2, :2] = ((5.0, 4.0), (4.0, 5.0))
    matrix[2, 3] = matrix[3, 2] = 0.5
    twisted = make_object("quadric", T_base_object=placed("plane").T_base_object, matrix=matrix)
    image = Plant(PlantConfig(None, object=twisted, taxels=IDEAL_TAXELS)).sample_image(0).astype(float)
    k = np.arange(16) - 7.5
    assert k @ image @ k > 0.1 * image.sum()


def test_sensor_alone_rates_are_the_derivative():
    p = Plant(PlantConfig(None, object=placed("cylinder"), press=PressMotion(1.0, 0.3, 2.0)))
    depths = []
    for t in (100 * MS - 10_000, 100 * MS, 100 * MS + 10_000):
        p.advance(t)
        depths.append(p.truth()["depth"])
        if t == 100 * MS:
            rate = p.truth()["depth_rate"]
    assert rate == pytest.approx((depths[2] - depths[0]) / 20e-6, rel=1e-4)


def test_sensor_alone_without_an_object_is_idle():
    p = Plant(PlantConfig(None))
    assert not p.sample_image(5 * MS).any()
    assert all(np.all(np.isfinite(v)) for v in p.truth().values())


def test_a_hollow_as_tight_as_the_probe_is_refused():
    bowl = make_object("bowl", T_base_object=np.eye(4), radius=0.04)
    with pytest.raises(PlanError, match=r"hollow of radius 40\.0 mm"):
        Plant(PlantConfig(None, object=bowl))
    Plant(PlantConfig(None, object=make_object("bowl", T_base_object=np.eye(4), radius=0.06)))


@pytest.mark.parametrize("fidelity", ["ideal", "dynamic"])
def test_limit_switches_stand_just_outside_of_the_joints_range_where_the_other_motors_are(fidelity):
    p = Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None, fidelity=fidelity, bodies=BODIES["puma260"]))
    push(p, ELBOW_FORM + 0.05, 0, 100 * MS)
    p.advance(300 * MS)
    for axis in range(6):
        ends = []
        for counts in p.limit_switches(axis):
            motors = np.array([p.motor_counts(other) for other in range(6)])
            motors[axis] = counts
            ends.append(units_to_joints(UPENN, motors)[axis])
        margin = 0.01 * (UPENN.q_max[axis] - UPENN.q_min[axis])
        assert sorted(ends) == pytest.approx([UPENN.q_min[axis] - margin, UPENN.q_max[axis] + margin])


def test_without_an_arm_there_are_no_limit_switches():
    assert Plant(PlantConfig(None, taxels=None)).limit_switches(0) == (-math.inf, math.inf)


def test_a_compliant_joint_gives_way_by_torque_over_stiffness_and_the_encoders_do_not_see_it():
    """The depth that is left carries the force that pushes the joints back; the motors stay where they are."""
    compliance = np.array([0.0, 1 / 4000.0, 1 / 2500.0, 0.0, 1 / 500.0, 0.0])
    rigid, soft = plant(depth=0.5e-3, tilt_deg=8.0), plant(depth=0.5e-3, tilt_deg=8.0, compliance=compliance)
    stiff_truth, truth = rigid.truth(), soft.truth()
    assert soft.motor_counts(1) == rigid.motor_counts(1)
    _, J = forward_jacobian(UPENN.chain, np.array(truth["q"]), TOOL)
    torque = J[:3].T @ (truth["force"] * truth["contact_normal"])
    np.testing.assert_allclose(
        truth["q"] - stiff_truth["q"], compliance * torque, atol=1e-2 * abs(compliance * torque).max()
    )
    way = float(truth["contact_normal"] @ (truth["probe_centre"] - stiff_truth["probe_centre"]))
    assert 20e-6 < way < 0.3e-3
    assert truth["depth"] == pytest.approx(stiff_truth["depth"] - way, rel=5e-3)
    assert truth["force"] < 0.95 * stiff_truth["force"]
    assert plant(depth=-1e-3, compliance=compliance).truth()["q"] == pytest.approx(plant(depth=-1e-3).truth()["q"])


@pytest.mark.parametrize("fidelity", ["ideal", "dynamic"])
def test_a_plant_that_waits_does_to_the_last_bit_the_same_whenever_its_time_begins(fidelity):
    config = PlantConfig(UPENN, ELBOW_FORM, object=placed("cylinder"), fidelity=fidelity, bodies=BODIES["puma260"])

    def course(begin_ns):
        p = Plant(config, waits=True)
        here = p.motor_counts(1)
        p.set_ramp(1, here, here, 2 * MS, 3 * MS)  # the drive holds at power on
        p.advance(begin_ns - 1)
        p.sample_image(begin_ns - 1)
        assert p.motor_counts(1) == here
        p.begin(begin_ns)
        p.begin(begin_ns + MS)
        p.set_ramp(1, here, here + 500.0, begin_ns, begin_ns + 5 * MS)
        states, images = [], []
        for k in range(4):
            images.append(p.sample_image(begin_ns + k * 3 * MS + 1).tobytes())
            states.append(p.state())
        return states, images

    assert course(5 * MS) == course(314_159_265)


def test_the_drives_report_the_torque_against_the_resultant_of_several_places():
    """A probe beside the middle of a hollow tighter than itself rests on its lip: the push leans to the middle."""
    pose = np.eye(4)
    pose[:3, 3] = POINT
    bowl = make_object("bowl", T_base_object=pose, radius=0.03)
    T = forward(UPENN.chain, plant("plane").truth()["q"]) @ TOOL
    T[:3, 3] = POINT + np.array((4e-4, 2e-4, 0.03 + math.sqrt((0.04 + LIP_M) ** 2 - (0.03 + LIP_M) ** 2) - 3e-4))
    p = Plant(PlantConfig(UPENN, posture_of(T), object=bowl))
    truth, J = p.truth(), forward_jacobian(UPENN.chain, p.truth()["q"], TOOL)[1][:3]
    touches = bowl.touches(T[:3, 3], 0.04)
    force = total_force(touches, 0.04, p.config.stiffness_n_m3, np.zeros(len(touches.points)), 0.0)
    assert truth["force"] == pytest.approx(np.linalg.norm(force), rel=1e-6)
    assert np.linalg.norm(np.cross(force, truth["contact_normal"])) > 0.5
    rated = np.sign(units_per_motor(UPENN)) * [joint.rated_torque for joint in UPENN.joints]
    expected = -1e3 * (joints_per_motor(UPENN).T @ J.T @ force) / rated
    assert [p.torque_permille(i) for i in range(6)] == pytest.approx(expected, abs=0.51)
    assert np.abs(expected).max() > 50
