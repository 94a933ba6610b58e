"""Forces of one and of several touches: slopes of their energy, and their push on the arm by finite differences."""

import math
from functools import partial

import numpy as np
import pytest
from puma_arm import ELBOW_FORM, POINT, TOOL, UPENN, pressing

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.elastic_contact import elastic_contact, force_laws, total_force
from canprobe.cell.plant.equations import ArmEquations
from canprobe.cell.plant.plant import Plant
from canprobe.cell.plant.taxels import IDEAL_TAXELS
from canprobe.cell.scene.setup import Dynamics
from canprobe.fieldbus.protocol.tactile import MAX_SIDE
from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.model import joints_per_motor, joints_to_units
from canprobe.mechanics.robot.probe_poses import start_posture
from canprobe.mechanics.touch.objects import make_object
from canprobe.mechanics.touch.shapes import LIP_M

K, R = 1.27e8, 0.040
POSE = np.eye(4)
POSE[:3, 3] = POINT
OBJECTS = {"cylinder": {"radius": 0.036}, "saddle": {"radius_x": 0.06, "radius_y": -0.08}}


def ring_energy(shape, p):
    found = shape.touches(p, R)
    coefficient, exponent = force_laws(found, R, K)
    return float(np.sum(coefficient * (R - found.distances) ** (exponent + 1) / (exponent + 1)))


TIGHT_BOWL = make_object("bowl", T_base_object=POSE, radius=0.03)
RESTS_AT = 0.03 + math.sqrt((R + LIP_M) ** 2 - (0.03 + LIP_M) ** 2)


@pytest.mark.parametrize("aside", [(0.0, 0.0), (4e-4, 2e-4)])
def test_the_lips_force_is_the_slope_of_its_energy(aside):
    centre = POINT + np.array((*aside, RESTS_AT - 3e-4))
    found = TIGHT_BOWL.touches(centre, R)
    force = total_force(found, R, K, np.zeros(len(found.points)), 0.0)
    h = 1e-8
    slope = [
        (ring_energy(TIGHT_BOWL, centre + d) - ring_energy(TIGHT_BOWL, centre - d)) / (2 * h) for d in h * np.eye(3)
    ]
    assert force == pytest.approx(-np.array(slope), abs=1e-4 * np.linalg.norm(force))
    if aside == (0.0, 0.0):
        assert force[:2] == pytest.approx((0.0, 0.0), abs=1e-9)
        assert force[2] > 1.0
    else:
        assert force[:2] @ aside < 0.0  # it centres the ball


def test_pieces_of_a_lip_add_up_to_the_law_of_a_point():
    """A small ball on the lip of a wide bowl touches it over a short stretch: one elliptic patch."""
    wide, ball, depth = make_object("bowl", T_base_object=np.eye(4), radius=0.06), 0.03, 2e-4
    ring, lean = 0.06 + LIP_M, math.radians(70.0)
    reach = ball + LIP_M - depth
    centre = np.array((ring - reach * math.cos(lean), 0.0, 0.06 + reach * math.sin(lean)))
    found, one = wide.touches(centre, ball), wide.closest(centre)
    assert one.distance == pytest.approx(ball - depth, abs=1e-12)
    total = total_force(found, ball, K, np.zeros(len(found.points)), 0.0)
    expected = elastic_contact(depth, (float(one.kappa[0]), float(one.kappa[1])), ball, K).force
    assert np.linalg.norm(total) == pytest.approx(expected, rel=0.04)
    assert total / np.linalg.norm(total) == pytest.approx(one.normal, abs=0.02)


def arm_over(shape, depth=2e-4, *, friction=0.0, point=POINT, **config):
    return pressing(shape, depth, point, fidelity="dynamic", dynamics=Dynamics(friction=friction), **config)


def places(shape, centre):
    """Normals, and elastic forces of all touches of the probe."""
    found = shape.touches(centre, R)
    if found is None:
        foot = shape.closest(centre)
        kappa = float(foot.kappa[0]), float(foot.kappa[1])
        return [(foot.normal, elastic_contact(R - foot.distance, kappa, R, K).force, R - foot.distance)]
    coefficient, exponent = force_laws(found, R, K)
    depth = np.maximum(R - found.distances, 0.0)
    return list(zip(found.normals, coefficient * depth**exponent, depth, strict=True))


@pytest.mark.parametrize(("kind", "height"), [("cylinder", 0.0), ("saddle", 0.0), ("tight bowl", RESTS_AT - R)])
def test_push_is_that_of_points_of_the_probe_moved_by_finite_differences(kind, height):
    """Each touch: elastic force, its damping against the speed there, friction against the slip there."""
    shape = TIGHT_BOWL if kind == "tight bowl" else make_object(kind, T_base_object=POSE, **OBJECTS[kind])
    config = arm_over(shape, 3e-4, friction=0.3, point=POINT + np.array((2e-4, 1e-4, height)), damping_s_m=5.0)
    e, back = ArmEquations(config), joints_per_motor(UPENN)
    theta = np.linalg.solve(back, config.q0)
    rate = np.array((0.05, -0.04, 0.06, 0.2, -0.3, 0.1))
    e.hold(e.resting(theta))
    centre = (forward(UPENN.chain, config.q0) @ TOOL)[:3, 3]
    expected = np.zeros(6)
    for normal, elastic, depth in places(shape, centre):
        on_flange = np.linalg.solve(forward(UPENN.chain, config.q0), (*(centre - (R - depth) * normal), 1.0))
        step, flange = 1e-6 * np.eye(6), partial(forward, UPENN.chain)
        J = np.array([
            (flange(back @ (theta + d)) @ on_flange - flange(back @ (theta - d)) @ on_flange)[:3] / 2e-6
            for d in step
        ]).T  # fmt: skip
        v = J @ rate
        force = elastic * max(0.0, 1.0 - 1.5 * 5.0 * (normal @ v))
        slip = v - (normal @ v) * normal
        expected += J.T @ (force * normal - 0.3 * force * slip / math.sqrt(slip @ slip + 1e-6))
    push = e.contact.push(theta, rate)
    assert push == pytest.approx(expected, rel=2e-5, abs=2e-5 * np.abs(expected).max())
    assert np.abs(expected).max() > 0.1


@pytest.mark.parametrize(("kind", "height"), [("cylinder", 0.0), ("tight bowl", RESTS_AT - R)])
def test_a_touch_that_is_left_quickly_does_not_pull(kind, height):
    shape = TIGHT_BOWL if kind == "tight bowl" else make_object(kind, T_base_object=POSE, **OBJECTS[kind])
    config = arm_over(shape, 3e-4, friction=0.3, point=POINT + np.array((0.0, 0.0, height)), damping_s_m=5.0)
    e, back = ArmEquations(config), joints_per_motor(UPENN)
    theta = np.linalg.solve(back, config.q0)
    e.hold(e.resting(theta))
    up = np.linalg.solve(forward_jacobian(UPENN.chain, config.q0, TOOL)[1] @ back, (0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
    assert not e.contact.push(theta, up).any()
    assert np.abs(e.contact.push(theta, 0.01 * up)).max() > 0.1


def test_slopes_of_several_touches_are_those_of_their_push():
    top = POINT + np.array((2e-4, 1e-4, RESTS_AT - R))
    e = ArmEquations(arm_over(TIGHT_BOWL, 3e-4, point=top, damping_s_m=5.0))
    theta = joints_to_units(UPENN, arm_over(TIGHT_BOWL, 3e-4, point=top).q0) / np.diag(UPENN.units_per_q)
    rate = np.array((0.05, -0.04, 0.06, 0.2, -0.3, 0.1))
    e.hold(e.resting(theta))

    push, (pushed, by_theta, by_rate) = e.contact.push, e.contact.linearised(theta, rate)
    assert pushed == pytest.approx(push(theta, rate))
    for given, at in ((by_theta, lambda d: push(theta + d, rate)), (by_rate, lambda d: push(theta, rate + d))):
        slope = np.array([(at(d) - at(-d)) / 2e-6 for d in 1e-6 * np.eye(6)]).T
        assert -given == pytest.approx(slope, abs=1e-4 * np.abs(slope).max())


@pytest.mark.parametrize("speed", [-0.05, 0.05])
def test_a_plant_on_a_lip_presses_harder_while_it_sinks(speed):
    config = arm_over(TIGHT_BOWL, 3e-4, point=POINT + np.array((0.0, 0.0, RESTS_AT - R)), damping_s_m=2.0)
    plant = Plant(config)
    still = plant.state()
    J = forward_jacobian(UPENN.chain, config.q0, TOOL)[1]
    rates = joints_to_units(UPENN, np.linalg.solve(J, (0.0, 0.0, speed, 0.0, 0.0, 0.0)))
    force = plant.truth(still._replace(rates=tuple(rates.tolist())))["force"]
    upward = TIGHT_BOWL.touches(plant.truth(still)["probe_centre"], R).normals[0, 2]
    assert force == pytest.approx(plant.truth(still)["force"] * (1.0 - 1.5 * 2.0 * upward * speed), rel=1e-9)


def test_an_image_of_two_walls_shows_two_patches():
    trough = make_object("wave", T_base_object=POSE, amplitude=0.0045, wavelength=0.07)
    bottom = POINT + np.array((0.0, 0.035, -0.009))
    ball = 0.045
    for lift in np.arange(0.0, 3e-3, 2e-5):
        centre = bottom + np.array((0.0, 0.0, ball + lift))
        if trough.closest(centre).distance > ball - 4e-4:
            break
    q0 = start_posture(
        UPENN, bottom, (0, 0, 1), ELBOW_FORM, radius_m=ball, T_flange_probe=TOOL, clearance_m=float(lift)
    )
    plant = Plant(PlantConfig(UPENN, q0, object=trough, radius_m=ball, taxels=IDEAL_TAXELS))
    assert len(trough.touches(plant.truth()["probe_centre"], ball).points) == 2
    image = plant.sample_image(5_000_000).astype(float)
    profiles = [image.sum(axis=0), image.sum(axis=1)]
    across = max(profiles, key=lambda p: p.std())
    assert image.any()
    middle = across[MAX_SIDE // 2 - 2 : MAX_SIDE // 2 + 2].max()
    assert across[: MAX_SIDE // 2 - 2].max() > 1.5 * middle
    assert across[MAX_SIDE // 2 + 2 :].max() > 1.5 * middle
