"""Rigid-body dynamics against MuJoCo, a potential, and the published weight torques."""

import mujoco
import numpy as np
import pytest

from canprobe.robot.chain import forward_jacobian, tool_z_offset
from canprobe.robot.dynamics import LinkInertia, RigidBody, ball_inertia, puma260_inertia
from canprobe.robot.puma import MODELS, UPENN, dh_rows

TOOL = tool_z_offset(80.0)
BOTH = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
HORIZONTAL = np.radians((0.0, 0.0, -90.0, 0.0, 0.0, 0.0))


def random_links(seed):
    """Bodies that could exist: tensors of point clouds."""
    rng = np.random.default_rng(seed)
    clouds = rng.normal(0.0, 0.05, (6, 30, 3))
    tensors = [np.eye(3) * (c * c).sum() - c.T @ c for c in clouds]
    return LinkInertia(rng.uniform(0.1, 3.0, 6), rng.normal(0.0, 0.1, (6, 3)), 0.01 * np.array(tensors))


def denavit_hartenberg(q, a, alpha, d):
    c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
    return np.array(((c, -s * ca, s * sa, a * c), (s, c * ca, -c * sa, a * s), (0, sa, ca, d), (0, 0, 0, 1)))


def in_mujoco(model, links):
    """The same arm for MuJoCo: a body frame is the Denavit-Hartenberg frame before, turned by the joint."""
    words = lambda values: " ".join(repr(float(v)) for v in values)  # noqa: E731
    pose, bodies = "", ""
    for (a, alpha, d), mass, com, tensor in zip(
        dh_rows(model)[:, :3], links.mass, links.com, links.tensor, strict=True
    ):
        c, s = np.cos(alpha), np.sin(alpha)
        R = np.array(((1, 0, 0), (0, c, -s), (0, s, c)))
        T = R @ tensor @ R.T
        six = (T[0, 0], T[1, 1], T[2, 2], T[0, 1], T[0, 2], T[1, 2])
        at = words(np.array((a, 0, d)) + R @ com)
        bodies += f'<body {pose}><joint axis="0 0 1"/><inertial pos="{at}" mass="{mass}" fullinertia="{words(six)}"/>'
        pose = f'pos="{words((a, 0, d))}" quat="{words((np.cos(alpha / 2), np.sin(alpha / 2), 0, 0))}"'
    text = f'<mujoco><option gravity="0 0 -9.81"/><worldbody>{bodies}<site {pose}/>{"</body>" * 6}</worldbody></mujoco>'
    made = mujoco.MjModel.from_xml_string(text)
    return made, mujoco.MjData(made)


@BOTH
@pytest.mark.parametrize("seed", range(3))
def test_mass_matrix_and_bias_are_those_of_mujoco(model, seed):
    links = random_links(seed)
    made, data = in_mujoco(model, links)
    body, rng = RigidBody(model, links), np.random.default_rng(100 + seed)
    for q, qd in rng.uniform(-3.0, 3.0, (20, 2, 6)):
        data.qpos[:], data.qvel[:] = q, qd
        mujoco.mj_forward(made, data)
        columns = np.zeros((6, 6))
        for column, unit in zip(columns, np.eye(6), strict=True):
            mujoco.mj_mulM(made, data, column, unit)
        mass, bias = body.terms(q, qd)
        assert mass == pytest.approx(columns, abs=1e-10)
        assert bias == pytest.approx(data.qfrc_bias, abs=1e-10)


@BOTH
def test_pose_and_jacobian_are_those_of_mujoco(model):
    made, data = in_mujoco(model, random_links(0))
    rng = np.random.default_rng(1)
    for q in rng.uniform(-3.0, 3.0, (20, 6)):
        data.qpos[:] = q
        mujoco.mj_forward(made, data)
        T, J = forward_jacobian(model.chain, q, np.eye(4))
        linear, angular = np.zeros((3, 6)), np.zeros((3, 6))
        mujoco.mj_jacSite(made, data, linear, angular, 0)
        assert T[:3, 3] == pytest.approx(data.site_xpos[0], abs=1e-10)
        assert T[:3, :3] == pytest.approx(data.site_xmat[0].reshape(3, 3), abs=1e-10)
        assert pytest.approx(np.vstack((linear, angular)), abs=1e-10) == J


def test_weight_of_the_horizontal_arm_is_the_published_one():
    links = puma260_inertia(UPENN)
    loaded = links.with_payload(0.3, TOOL, ball_inertia(0.3, 0.04))
    bare = RigidBody(UPENN, links).gravity(HORIZONTAL)[1]
    assert bare == pytest.approx(3.7, abs=0.05)
    assert RigidBody(UPENN, loaded).gravity(HORIZONTAL)[1] - bare == pytest.approx(1.6, abs=0.05)


@BOTH
def test_gravity_is_the_slope_of_the_height(model):
    links = puma260_inertia(model)
    body, q = RigidBody(model, links), np.random.default_rng(3).uniform(-2.0, 2.0, 6)

    def potential(q):
        T, heights = np.eye(4), []
        for angle, row, com in zip(q, dh_rows(model)[:, :3], links.com, strict=True):
            T = T @ denavit_hartenberg(angle, *row)
            heights.append(T[2, :3] @ com + T[2, 3])
        return 9.81 * float(links.mass @ heights)

    h = 1e-6 * np.eye(6)
    slope = [(potential(q + d) - potential(q - d)) / 2e-6 for d in h]
    assert body.gravity(q) == pytest.approx(slope, abs=1e-8)


@BOTH
def test_kinetic_energy_changes_by_the_power_of_the_torques(model):
    """Coriolis torques do no work: d/dt (v'Mv / 2) = v'(M a + b - g)."""
    body, rng = RigidBody(model, puma260_inertia(model)), np.random.default_rng(4)
    q, v, a = rng.uniform(-1.0, 1.0, (3, 6))
    mass, bias = body.terms(q, v)

    def energy(t):
        qt, vt = q + t * v + 0.5 * t * t * a, v + t * a
        return 0.5 * vt @ body.terms(qt, vt)[0] @ vt

    power = v @ (mass @ a + bias - body.gravity(q))
    assert (energy(1e-5) - energy(-1e-5)) / 2e-5 == pytest.approx(power, rel=1e-7)


def test_a_payload_is_the_same_as_a_heavier_link():
    """Two halves of a body fixed one after the other are the body."""
    links, tensor = puma260_inertia(UPENN), np.diag((1e-3, 2e-3, 2.5e-3))
    whole = links.with_payload(0.4, TOOL, tensor)
    halves = links.with_payload(0.2, TOOL, tensor / 2).with_payload(0.2, TOOL, tensor / 2)
    q = np.ones(6)
    for one, other in zip(RigidBody(UPENN, whole).terms(q, q), RigidBody(UPENN, halves).terms(q, q), strict=True):
        assert one == pytest.approx(other, abs=1e-14)


@BOTH
def test_along_other_coordinates_powers_are_the_same(model):
    """q = B x: x'Mx' is the same energy, and b along x is B'b; rotors add theirs, weightless arms have none of it."""
    body, rng = RigidBody(model, random_links(5)), np.random.default_rng(5)
    B, x, xd, rotors = np.tril(rng.normal(size=(6, 6))), *rng.normal(size=(2, 6)), rng.uniform(0.1, 1.0, 6)
    mass, bias = body.terms(B @ x, B @ xd)
    along, along_bias = body.along(B, rotors.tolist()).terms(x, xd)
    assert along == pytest.approx(B.T @ mass @ B + np.diag(rotors), rel=1e-12)
    assert along_bias == pytest.approx(B.T @ bias, rel=1e-12)
    light = body.along(B, rotors.tolist(), weight=False).terms(x, xd)[1]
    assert light == pytest.approx(B.T @ (bias - body.gravity(B @ x)), rel=1e-10)
