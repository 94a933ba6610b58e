"""Rigid-body dynamics against Pinocchio, closed forms, and the published weight torques."""

import math
from dataclasses import replace

import numpy as np
import pytest
from puma_arm import BODIES, MODELS, UPENN

import canprobe
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import read_cell
from canprobe.cell.scene.resolve import resolve
from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import link_transforms
from canprobe.mechanics.robot.denavit_hartenberg import from_dh, tool_z_offset
from canprobe.mechanics.robot.dynamics import RigidBody, ball, impossible_bodies, joined
from canprobe.mechanics.robot.model import Body

TOOL = tool_z_offset(80.0)
BOTH = pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
HORIZONTAL = np.radians((0.0, 0.0, -90.0, 0.0, 0.0, 0.0))
SLIDING = {"six": "......", "gantry": "___", "mixed": "._.._.._", "one": "."}
"""Joints by the name of an arm: . turns, _ slides."""


def solid(rng):
    """A body that could exist: its tensor is that of a cloud of points."""
    cloud = rng.normal(0.0, 0.05, (30, 3))
    tensor = 0.01 * (np.eye(3) * (cloud * cloud).sum() - cloud.T @ cloud)
    return Body(rng.uniform(0.1, 3.0), rng.normal(0.0, 0.1, 3), tensor)


def random_arm(name):
    """Any geometry, and bodies."""
    rng, kinds = np.random.default_rng(len(name)), SLIDING[name]
    chain = from_dh(0.4 * rng.normal(size=(len(kinds), 4)), name=name, prismatic=[kind == "_" for kind in kinds])
    return chain, [solid(rng) for _ in kinds]


class Pinocchio:
    """The same arm there: its joints turn about, or slide along, the z axes of their own frames too."""

    def __init__(self, chain, bodies):
        self.pin = pin = pytest.importorskip("pinocchio")
        self.model, joint = pin.Model(), 0
        for T, slides, body, name in zip(chain.fixed, chain.prismatic, bodies, chain.joints, strict=True):
            kind = pin.JointModelPZ() if slides else pin.JointModelRZ()
            joint = self.model.addJoint(joint, kind, pin.SE3(T), name)
            if body is not None:
                self.model.appendBodyToJoint(joint, pin.Inertia(body.mass, body.com, body.tensor), pin.SE3.Identity())
        self.model.gravity.linear = np.array((0.0, 0.0, -9.81))
        self.data = self.model.createData()

    def terms(self, q, qd):
        upper = np.triu(self.pin.crba(self.model, self.data, q))
        return upper + np.triu(upper, 1).T, self.pin.nonLinearEffects(self.model, self.data, q, qd)


def agree(chain, bodies):
    body, oracle, rng = RigidBody(chain, bodies), Pinocchio(chain, bodies), np.random.default_rng(100)
    for q, qd in rng.uniform(-3.0, 3.0, (20, 2, chain.n)):
        mass, bias = body.terms(q, qd)
        expected_mass, expected_bias = oracle.terms(q, qd)
        assert mass == pytest.approx(expected_mass, rel=1e-10, abs=1e-10)
        assert bias == pytest.approx(expected_bias, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("name", SLIDING)
def test_mass_matrix_and_bias_are_those_of_pinocchio_whatever_carries_nothing(name):
    chain, bodies = random_arm(name)
    for carried in (bodies, [*bodies[:-1], None], [None] * chain.n):
        agree(chain, carried)


@BOTH
def test_so_are_those_of_a_published_table_that_no_solid_could_have(model):
    """Link 1 has no mass and turns about one axis only."""
    agree(model.chain, BODIES[model.name])


def test_a_pendulum_and_a_lift_are_the_closed_forms():
    upright = np.eye(4)
    upright[:3, :3] = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))  # z along base x
    pendulum = from_dh(np.zeros((1, 4)), T_base_mount=upright)
    body = Body(2.0, np.array((0.3, 0.0, 0.0)), np.diag((0.01, 0.02, 0.03)))
    mass, bias = RigidBody(pendulum, [body]).terms([0.4], [1.0])
    assert mass == pytest.approx(0.03 + 2.0 * 0.3**2)
    assert bias == pytest.approx(2.0 * 9.81 * 0.3 * math.cos(0.4))
    lift = from_dh(np.zeros((1, 4)), prismatic=[True])
    mass, bias = RigidBody(lift, [body]).terms([0.4], [1.0])
    assert (mass[0, 0], bias[0]) == pytest.approx((2.0, 2.0 * 9.81))


def test_weight_of_the_horizontal_arm_is_the_published_one():
    links = BODIES["puma260"]
    load = ball(0.3, 0.04, (UPENN.chain.T_last_flange @ TOOL)[:3, 3])
    bare = RigidBody(UPENN.chain, links).terms(HORIZONTAL, 0.0)[1][1]
    assert bare == pytest.approx(3.7, abs=0.05)
    loaded = RigidBody(UPENN.chain, (*links[:-1], joined(links[-1], load))).terms(HORIZONTAL, 0.0)[1][1]
    assert loaded - bare == pytest.approx(1.6, abs=0.05)


@BOTH
def test_bodies_of_the_puma_stand_where_its_denavit_hartenberg_frames_put_them(model):
    """Link 2's centre of mass lies 107 mm beside joint 1's axis, however the geometry splits that offset."""
    at = link_transforms(model.chain, np.zeros(6))[0]
    com = at[:3, :3] @ BODIES[model.name][1].com + at[:3, 3]
    assert com[1] == pytest.approx(0.107, abs=1e-12)
    assert com[0] == pytest.approx(1e-3 * read_cell(model.name).joints["joint_2"].a_mm - 0.171, abs=1e-12)


def test_halves_joined_are_the_whole():
    whole = ball(0.4, 0.1, np.array((0.1, 0.2, 0.3)))
    half = Body(0.2, whole.com, whole.tensor / 2)
    two = joined(joined(None, half), half)
    assert (two.mass, *two.com, *two.tensor.ravel()) == pytest.approx((0.4, *whole.com, *whole.tensor.ravel()))
    apart = joined(Body(1.0, np.zeros(3), np.zeros((3, 3))), Body(3.0, np.array((0.4, 0.0, 0.0)), np.zeros((3, 3))))
    assert apart.com == pytest.approx((0.3, 0.0, 0.0))
    assert apart.tensor == pytest.approx(np.diag((0.0, 0.12, 0.12)))


def test_without_mujoco_it_is_said_what_to_type(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(PlanError, match=r"pip install .*\[dynamics\]"):
        RigidBody(UPENN.chain, BODIES["puma260"])


def test_dynamics_of_moments_that_no_body_has_are_refused_and_an_ideal_arm_does_not_ask_for_them():
    bodies = [
        Body(1.0, np.zeros(3), np.diag(moments)) for moments in ((1.0, 1.0, 1.9), (1.0, 1.0, 9.0), (0.0, 0.0, 9.0))
    ]
    (problem,) = impossible_bodies(("a", "b", "c"), bodies)
    assert (
        'plant.fidelity = "dynamic": joint b moves a body with principal moments of inertia of 1, 1, 9 kg m^2'
        in problem
    )
    setup = resolve(canprobe.load_scene("free"))
    chosen = replace(setup, truth=replace(setup.truth, fidelity="dynamic", bodies=(*bodies, None, None, None)))
    with pytest.raises(PlanError, match="joint joint_2 moves a body with"):
        make_plan(chosen)
    make_plan(replace(chosen, truth=replace(chosen.truth, fidelity="ideal")))
