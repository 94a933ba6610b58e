"""The dynamic arm: known systems in its limits, derivatives as stated, asking changes nothing."""

import math
from dataclasses import replace

import numpy as np
import pytest
from puma_arm import BODIES, ELBOW_FORM, POINT, TOOL, UPENN, pressing
from scipy.integrate import solve_ivp

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.dynamic_arm import DynamicArm
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.equations import ArmEquations
from canprobe.cell.plant.ideal_arm import NEVER, IdealArm, Reference
from canprobe.cell.plant.plant import Plant
from canprobe.cell.scene.setup import Dynamics
from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import Chain, forward, forward_jacobian
from canprobe.mechanics.robot.denavit_hartenberg import from_dh
from canprobe.mechanics.robot.model import (
    ArmModel,
    Body,
    Joint,
    joints_per_motor,
    units_per_motor,
    units_to_joints,
)
from canprobe.mechanics.touch.objects import make_object

CYCLE = 2_500_000
POSE = np.eye(4)
POSE[:3, 3] = POINT
CYLINDER = make_object("cylinder", T_base_object=POSE, radius=0.036)


def config(depth=0.43e-3, shape=CYLINDER, **dynamics):
    return pressing(shape, depth, fidelity="dynamic", dynamics=Dynamics(**dynamics))


def without_friction(c):
    joints = tuple(replace(joint, coulomb=0.0, viscous=0.0) for joint in c.model.joints)
    return replace(c, model=replace(c.model, joints=joints))


def state(arm):
    return arm._y.copy()


def ramps(arm, cycles=60, counts=0.5, extra=lambda t: None):
    """Every motor on a ramp of its own for a while, then at rest: positions in the middle of each cycle."""
    start, seen = arm.motors()[0], []
    for k in range(cycles + 20):
        arm.advance(k * CYCLE)
        if k < cycles:
            for i, c in enumerate(start):
                step = counts * (i + 1)
                arm.set_ramp(i, c + k * step, c + (k + 1) * step, k * CYCLE, (k + 1) * CYCLE)
        extra(k * CYCLE)
        arm.advance(k * CYCLE + 1_000_000)
        seen.append(arm.motors()[0])
    return np.array(seen)


def test_motors_alone_are_the_ideal_arm():
    c = replace(without_friction(config(shape=None, integral_s=0.0, payload=0.0)), bodies=(None,) * 6)
    ideal = ramps(IdealArm(UPENN, c.q0))
    exact = ramps(DynamicArm(replace(c, dynamics=replace(c.dynamics, integrator="rk4", step_ns=25_000))))
    assert exact == pytest.approx(ideal, abs=1e-9)
    close = ramps(DynamicArm(c))
    assert 1e-6 < np.abs(close - ideal).max() < 0.01


def test_asking_changes_nothing():
    quiet, curious = DynamicArm(config()), DynamicArm(config())

    def ask(t):
        for dt in (100_000, 370_001, 700_000):
            curious.advance(t + dt)
            curious.motors()
            curious.torque_permille(2)

    assert np.array_equal(ramps(quiet), ramps(curious, extra=ask))


@pytest.mark.parametrize("rate", [0.3, -0.3, 0.004])
def test_motors_and_gears_rub_as_published(rate):
    """Viscous and Coulomb friction of each axis, scaled from the PUMA 560's; tanh turns the sign over 0.01 rad/s."""
    viscous, coulomb = (0.32, 0.52, 0.22, 0.023, 0.023, 0.012), (2.2, 1.1, 0.57, 0.10, 0.083, 0.064)
    c = config(shape=None)
    y = state(DynamicArm(c)) + np.repeat((0.0, rate, 0.0), 6)
    rough, smooth = ArmEquations(c), ArmEquations(without_friction(c))
    for e in (rough, smooth):
        e.hold(y)
    drag = rough.mass @ (rough.rate(0.0, y) - smooth.rate(0.0, y))[6:12]
    expected = np.array(viscous) * rate + np.array(coulomb) * np.tanh(rate / 0.01)
    assert drag == pytest.approx(-expected, rel=1e-9)


def test_torque_ends_at_its_limit_and_the_motor_arrives_all_the_same():
    weak = DynamicArm(replace(config(shape=None, torque_limit_permille=1000), q0=ELBOW_FORM))
    start = weak.motor_counts(0)
    weak.set_ramp(0, start, start + 2000.0, 0, 10_000_000)
    most = 0
    for k in range(400):
        weak.advance(k * CYCLE)
        most = max(most, abs(weak.torque_permille(0)))
    assert most == 1000
    assert weak.motor_counts(0) == pytest.approx(start + 2000.0, abs=2.0)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_velocity_feed_forward_removes_the_lag(share):
    arm = DynamicArm(replace(config(shape=None, velocity_feed_forward=share), q0=ELBOW_FORM))
    start, speed = arm.motor_counts(0), 4000.0
    arm.set_ramp(0, start, start + speed, 0, 1_000_000_000)
    arm.advance(900_000_000)
    behind = (start + 0.9 * speed - arm.motor_counts(0)) / speed
    assert behind == pytest.approx((1.0 - share) * IdealArm(UPENN, ELBOW_FORM).lag_s, abs=2e-5)


def test_held_dynamics_cost_little_in_a_cycle():
    """Mass matrix, bias and geometry held over 2.5 ms against evaluated in every call, over a moving contact."""
    c = config()
    held = ramps(DynamicArm(c), cycles=20)
    free = ramps(DynamicArm(c, held=False), cycles=20)
    assert 0.0 < np.abs(held - free).max() < 0.05


def test_references_bend_where_they_should():
    r = Reference(10.0)
    assert r.at(0) == (10.0, 0.0)
    assert r.next_bend(0) == NEVER
    r.add((100, 200, 10.0, 30.0), 0)
    r.add((300, 300, 30.0, 5.0), 0)
    assert [r.next_bend(t) for t in (0, 100, 200, 300)] == [100, 200, 300, NEVER]
    assert r.at(150) == (20.0, pytest.approx(2e8))
    assert r.at(250) == (30.0, 0.0)
    assert r.at(300) == (5.0, 0.0)
    r.add((120, 220, 14.0, 0.0), 160)
    assert r.at(170) == (pytest.approx(7.0), pytest.approx(-1.4e8))
    assert r.at(400) == (0.0, 0.0)


# Arms of other kinds: seven joints, and a gantry of three slides that carries the probe downwards.


def solids(n):
    return tuple(Body(2.0 - 0.2 * i, np.array((0.0, 0.02, 0.05)), 4e-3 * np.eye(3)) for i in range(n))


def seven():
    """Spherical shoulder, elbow, spherical wrist; drives geared one to one hundred, one counting backwards."""
    right, rows = math.pi / 2, []
    for i, d in enumerate((0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126)):
        rows.append((0.0, 0.0 if i == 6 else right if i % 2 else -right, d, 0.0))
    chain = from_dh(rows, name="seven")
    joints = tuple(Joint(name, False, -3.0, 3.0, 2.0, rated_torque=40.0, rotor_inertia=0.2) for name in chain.joints)
    units = np.diag((1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0)) * 1e5 / (2 * math.pi)
    q0 = np.radians((10.0, 30.0, -15.0, -80.0, 20.0, 70.0, 5.0))
    return ArmModel(chain, joints, units, np.arange(7) * 1000.0), q0


def gantry():
    """Slides along base x, y and z; the flange looks down."""
    fixed, flange = np.array([np.eye(4)] * 3), np.eye(4)
    x_up = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))  # z along base x
    y_up = x_up @ x_up  # z along base y
    fixed[0, :3, :3], fixed[1, :3, :3], fixed[2, :3, :3] = x_up, x_up.T @ y_up, y_up.T
    flange[:3, :3] = np.diag((1.0, -1.0, -1.0))
    chain = Chain("gantry", ("x", "y", "z"), (True,) * 3, fixed, flange)
    slide = {"rated_torque": 100.0, "rotor_inertia": 5.0, "coulomb": 3.0, "viscous": 20.0}
    joints = tuple(Joint(name, True, -0.5, 0.5, 0.5, **slide) for name in chain.joints)
    return ArmModel(chain, joints, 1e6 * np.eye(3), np.zeros(3)), np.array((0.1, -0.05, 0.2))


def puma():
    """Its wrist is coupled: the motors share the torques of the joints."""
    return UPENN, ELBOW_FORM


def on_a_plane(made, depth=2e-4, friction=1.0):
    """The arm with its probe pressed into a plane under it; `friction`: share of the joints' Coulomb friction."""
    model, q0 = made()
    joints = tuple(replace(joint, coulomb=friction * joint.coulomb) for joint in model.joints)
    centre = (forward(model.chain, q0) @ TOOL)[:3, 3]
    pose = np.eye(4)
    pose[:3, 3] = centre - (0.0, 0.0, 0.04 - depth)
    shape = make_object("plane", T_base_object=pose)
    bodies = BODIES["puma260"] if made is puma else solids(model.n)
    return PlantConfig(replace(model, joints=joints), q0, object=shape, fidelity="dynamic", bodies=bodies)


EACH = pytest.mark.parametrize("made", [puma, seven, gantry])


def rated_torques(model):
    """(n,) in the drive's own sense."""
    return np.sign(units_per_motor(model)) * [joint.rated_torque for joint in model.joints]


@EACH
def test_at_rest_the_motors_carry_the_weight_and_nothing_moves(made):
    model, q0 = made()
    arm = DynamicArm(replace(on_a_plane(made), object=None))
    rest = arm.motors()[0]
    torques = [arm.torque_permille(i) for i in range(model.n)]
    arm.advance(200_000_000)
    assert arm.motors()[0] == pytest.approx(rest, abs=1e-3)
    assert units_to_joints(model, arm.motors()[0]) == pytest.approx(q0, abs=1e-8)
    weight = joints_per_motor(model).T @ arm.equations.body.terms(q0, 0.0)[1]
    assert torques == pytest.approx(1e3 * weight / rated_torques(model), abs=0.51)
    if made is gantry:  # masses of z and the probe
        assert weight == pytest.approx((0.0, 0.0, 9.81 * (1.6 + 0.3)), abs=1e-9)
        assert np.diag(arm.equations.mass) == pytest.approx(5.0 + np.array((5.7, 3.7, 1.9)))  # with rotors


@pytest.mark.parametrize("made", [seven, gantry])
def test_an_arm_follows_its_drives_as_scipys_radau_integrates_it(made):
    """Every motor on a ramp of its own, sliding over the plane, nothing held in the reference."""
    model, _ = made()
    c = on_a_plane(made)
    arm, exact, cycles = DynamicArm(c), ArmEquations(c, held=False), 8
    scale = units_per_motor(model)
    start, step = np.array(arm.motors()[0]), 4e-5 * scale * (1.0 + np.arange(model.n)) / model.n
    y = exact.resting((start - model.zero_units) / scale)
    for k in range(cycles):
        t = k * CYCLE
        for i in range(model.n):
            arm.set_ramp(i, start[i] + k * step[i], start[i] + (k + 1) * step[i], t, t + CYCLE)
        arm.advance(t + CYCLE)
        at = (start + k * step - model.zero_units) / scale
        exact.loops.set_reference(1e-9 * t, at, step / scale / (1e-9 * CYCLE))
        span = 1e-9 * t, 1e-9 * (t + CYCLE)
        y = solve_ivp(exact.rate, span, y, "Radau", rtol=1e-8, atol=1e-11, jac=exact.jacobian).y[:, -1]
    n = model.n
    moved = np.array(arm.motors()[0]) - start
    assert moved == pytest.approx(y[:n] * scale + model.zero_units - start, abs=2e-3 * np.abs(moved).max())
    assert np.array(arm.motors()[1]) == pytest.approx(y[n : 2 * n] * scale, abs=1e-2 * np.abs(arm.motors()[1]).max())
    assert np.abs(moved).max() > 3.0


@EACH
def test_slopes_are_those_of_the_equations_and_the_shifted_solver_solves(made):
    model, q0 = made()
    n, e = model.n, ArmEquations(on_a_plane(made))
    y = e.resting(np.linalg.solve(joints_per_motor(model), q0))
    y[n : 2 * n] = 1e-3 * (1.0 + np.arange(n))
    y[2 * n] += 3.0 * e.loops.limit[0]  # one motor at its limit
    e.hold(y)
    e.loops.set_reference(0.0, y[:n] + 1e-4, np.full(n, 0.1))
    J = e.jacobian(0.0, y)
    slope = np.array([(e.rate(0.0, y + d) - e.rate(0.0, y - d)) / 2e-7 for d in 1e-7 * np.eye(3 * n)]).T
    assert J[:, n:] == pytest.approx(slope[:, n:], rel=1e-4, abs=1e-5 * np.abs(J).max())
    drift = (e.rate(1e-6, y) - e.rate(-1e-6, y)) / 2e-6
    assert e.linearised(0.0, y, 7e-4).drift == pytest.approx(drift, rel=1e-5, abs=1e-5)
    r = np.random.default_rng(0).normal(size=3 * n)
    solved = e.linearised(0.0, y, 7e-4).solve(r)
    assert solved == pytest.approx(np.linalg.solve(np.eye(3 * n) - 7e-4 * J, r), rel=1e-8, abs=1e-9)


def test_an_arm_without_bodies_has_no_dynamics():
    with pytest.raises(PlanError, match="the masses of arm 'puma260' are not known"):
        DynamicArm(replace(config(), bodies=None))


def pressed(made, force_n, fidelity, friction):
    """A plant at rest with its probe on a plane; `friction`: share of the joints' and the contact's friction."""
    c = on_a_plane(made, depth_for_force(force_n, (0.0, 0.0), 0.04, 1.27e8), friction)
    plant = Plant(replace(c, fidelity=fidelity, dynamics=Dynamics(friction=0.3 * friction)))
    plant.advance(800_000_000)
    return plant


@pytest.mark.parametrize(("made", "force_n"), [(puma, 3.0), (seven, 30.0), (gantry, 30.0)])
def test_both_arms_report_the_torque_against_a_push(made, force_n):
    """At rest the dynamic arm's is weight less push, but for what friction carries; the ideal arm has no weight."""
    for friction in (1.0, 0.0):
        ideal, dynamic = (pressed(made, force_n, fidelity, friction) for fidelity in ("ideal", "dynamic"))
        model = dynamic.arm.model
        ratio = dynamic.truth()["force"] / ideal.truth()["force"]
        assert ratio == pytest.approx(1.0, abs=0.02)
        weight = joints_per_motor(model).T @ dynamic.arm.equations.body.terms(dynamic.truth()["q"], 0.0)[1]
        rated = rated_torques(model)
        found = [dynamic.torque_permille(i) for i in range(model.n)] - 1e3 * weight / rated
        push = np.array([ideal.torque_permille(i) for i in range(model.n)])
        J = forward_jacobian(model.chain, ideal.truth()["q"], TOOL)[1][:3] @ joints_per_motor(model)
        assert push == pytest.approx(-1e3 * (J.T @ (ideal.truth()["force"] * np.array((0, 0, 1)))) / rated, abs=0.51)
        bound = [1e3 * joint.coulomb / joint.rated_torque for joint in model.joints]
        assert (np.abs(found - ratio * push) <= np.array(bound) + 0.01 * np.abs(push) + 1.0).all()
        assert np.abs(push).max() > 5.0 * force_n
