"""The dynamic arm: known systems in its limits, derivatives as stated, asking changes nothing."""

from dataclasses import replace

import numpy as np
import pytest
from puma_arm import ELBOW_FORM

from canprobe.emulator.plant.config import PlantConfig
from canprobe.emulator.plant.dynamic_arm import NEVER, DynamicArm, Reference, Stepping, make_arm, make_equations
from canprobe.emulator.plant.equations import Effects, rosenbrock2
from canprobe.emulator.plant.held_step import held_rosenbrock2
from canprobe.emulator.plant.ideal_arm import IdealArm
from canprobe.emulator.plant.plant import Plant
from canprobe.robot.chain import forward_jacobian, tool_z_offset
from canprobe.robot.inverse import start_posture
from canprobe.robot.model import joints_per_motor, joints_to_units, units_per_motor
from canprobe.robot.puma import MODELS, UPENN
from canprobe.scene.setup import Dynamics
from canprobe.touch.objects import make_object

CYCLE = 2_500_000
POINT, TOOL = np.array((-0.120, -0.1225, 0.374)), tool_z_offset(80.0)
POSE = np.eye(4)
POSE[:3, 3] = POINT
CYLINDER = make_object("cylinder", T_base_object=POSE, radius=0.036)
STRETCHED = np.radians((90.0, 10.0, -60.0, 0.0, 60.0, 0.0))
NOTHING = Effects(gravity=False, coriolis=False, friction=False, links=False, contact=False)


def config(depth=0.43e-3, shape=CYLINDER, **dynamics):
    q0 = start_posture(UPENN, POINT, (0, 0, 1), ELBOW_FORM, radius_m=0.04, T_flange_probe=TOOL, clearance_m=-depth)
    return PlantConfig(UPENN, q0, object=shape, fidelity="dynamic", dynamics=Dynamics(**dynamics))


def state(arm):
    return np.array(arm._y)


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
    c = config(integral_s=0.0)
    ideal = ramps(IdealArm(UPENN, c.q0))
    exact = ramps(DynamicArm(UPENN, c.q0, make_equations(c, NOTHING), Stepping("exponential")))
    assert exact == pytest.approx(ideal, abs=1e-9)
    close = ramps(DynamicArm(UPENN, c.q0, make_equations(c, NOTHING), Stepping()))
    assert 1e-6 < np.abs(close - ideal).max() < 0.01


def test_asking_changes_nothing():
    quiet, curious = make_arm(config()), make_arm(config())

    def ask(t):
        for dt in (100_000, 370_001, 700_000):
            curious.advance(t + dt)
            curious.motors()
            curious.torque_permille(2)

    assert np.array_equal(ramps(quiet), ramps(curious, extra=ask))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_at_rest_the_motors_carry_the_weight_and_nothing_moves(model):
    arm = make_arm(replace(config(shape=None), model=model, q0=STRETCHED))
    start = arm.motors()[0]
    torques = [arm.torque_permille(i) for i in range(6)]
    arm.advance(500_000_000)
    assert arm.motors()[0] == pytest.approx(start, abs=1e-6)
    body = arm.equations.body
    share = joints_per_motor(UPENN).T @ body.gravity(STRETCHED)
    assert torques == pytest.approx(1e3 * share / np.array((6.4, 6.4, 6.4, 1.4, 0.7, 0.7)), abs=0.51)
    assert abs(torques[1]) > 100


def test_the_push_of_the_object_is_the_force_through_the_jacobian():
    c = config(friction=0.0)
    arm, truth = make_arm(c), Plant(c).truth()
    free = make_arm(replace(c, object=None))
    for a in (arm, free):
        a.equations.hold(state(a))
    pushed = arm.equations.rate(0.0, state(arm)) - free.equations.rate(0.0, state(free))
    mass, _ = arm.equations.mass()
    J = forward_jacobian(UPENN.chain, c.q0, TOOL)[1][:3]
    expected = joints_per_motor(UPENN).T @ J.T @ (truth["force"] * truth["contact_normal"])
    assert mass @ pushed[6:12] == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert truth["force"] > 1.9


@pytest.mark.parametrize("rate", [0.3, -0.3, 0.004])
def test_motors_and_gears_rub_as_published(rate):
    """Viscous and Coulomb friction of each axis, scaled from the PUMA 560's; tanh turns the sign over 0.01 rad/s."""
    viscous, coulomb = (0.32, 0.52, 0.22, 0.023, 0.023, 0.012), (2.2, 1.1, 0.57, 0.10, 0.083, 0.064)
    c = config(shape=None)
    y = state(make_arm(c)) + np.repeat((0.0, rate, 0.0), 6)
    rough, smooth = make_equations(c), make_equations(c, Effects(friction=False))
    for e in (rough, smooth):
        e.hold(y)
    drag = rough.mass()[0] @ (rough.rate(0.0, y) - smooth.rate(0.0, y))[6:12]
    expected = np.array(viscous) * rate + np.array(coulomb) * np.tanh(rate / 0.01)
    assert drag == pytest.approx(-expected, rel=1e-9)


def test_friction_drags_against_the_sliding_and_never_feeds_it():
    c = config()
    arm, smooth = make_arm(c), make_arm(replace(c, dynamics=replace(c.dynamics, friction=0.0)))
    y = state(arm)
    y[6:9] = 0.02, -0.03, 0.05
    for a in (arm, smooth):
        a.equations.hold(y)
    mass, _ = arm.equations.mass()
    drag = mass @ (arm.equations.rate(0.0, y) - smooth.equations.rate(0.0, y))[6:12]
    power = float(drag @ y[6:12])
    sliding = np.linalg.norm(arm.equations.contact.rows[1:] @ y[6:12])
    normal_force = Plant(c).truth()["force"]
    assert sliding > 5e-3
    assert power == pytest.approx(-0.3 * normal_force * sliding, rel=0.05)


def test_jacobian_is_the_slope_and_the_shifted_solver_solves():
    c = config()
    arm = make_arm(c)
    e, y = arm.equations, state(arm)
    y[6:12] = 0.004, -0.006, 0.01, 0.02, -0.03, 0.01
    y[14] += 20.0  # one motor at its torque limit
    e.hold(y)
    e.loops.set_reference(0.0, (y[:6] + 1e-4).tolist(), [0.1] * 6)
    slope = np.array([(e.rate(0.0, y + d) - e.rate(0.0, y - d)) / 2e-7 for d in 1e-7 * np.eye(18)]).T
    J = e.jacobian(0.0, y)
    left_out = np.zeros((18, 18))
    assert J[:, 6:] == pytest.approx((slope + left_out)[:, 6:], rel=1e-4, abs=1e-3 * np.abs(J).max() * 1e-3)
    drift = (e.rate(1e-6, y) - e.rate(-1e-6, y)) / 2e-6
    assert e.drift(0.0, y) == pytest.approx(drift, rel=1e-5, abs=1e-5)
    r = np.random.default_rng(0).normal(size=18)
    assert e.linearised(0.0, y, 7e-4).solve(r) == pytest.approx(
        np.linalg.solve(np.eye(18) - 7e-4 * J, r), rel=1e-9, abs=1e-12
    )


@pytest.mark.parametrize("torque", [0.0, 20.0, -20.0], ids=["free", "at its limit", "at the other"])
@pytest.mark.parametrize("effects", [Effects(), Effects(contact=False), Effects(links=False, friction=False)])
def test_the_step_in_straight_line_code_is_the_general_step(effects, torque):
    c, rng = config(velocity_feed_forward=0.5), np.random.default_rng(1)
    e = make_equations(c, effects)
    for _ in range(5):
        y = state(make_arm(c)) + rng.normal(size=18) * np.repeat((1e-5, 0.02, 0.5), 6)
        y[14] += torque
        e.hold(y)
        e.loops.set_reference(0.3, (y[:6] + rng.normal(size=6) * 1e-4).tolist(), rng.normal(size=6).tolist())
        e.loops.set_loop(1, 5.0, 0.1, -0.7)
        new = rosenbrock2(e, 0.31, y, 625e-6)
        change = np.abs(new - y)
        assert np.abs(held_rosenbrock2(e, 0.31, y.tolist(), 625e-6) - new).max() < 1e-10 * change.max()
        away = y - np.concatenate((0.01 * e.contact.rows[0], np.zeros(12))) if e.contact is not None else y
        assert held_rosenbrock2(e, 0.31, away.tolist(), 625e-6) == pytest.approx(
            rosenbrock2(e, 0.31, away, 625e-6), abs=1e-10
        )


def test_torque_ends_at_its_limit_and_the_motor_arrives_all_the_same():
    weak = make_arm(replace(config(shape=None, torque_limit_permille=1000), q0=ELBOW_FORM))
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
    arm = make_arm(replace(config(shape=None, velocity_feed_forward=share), q0=ELBOW_FORM))
    start, speed = arm.motor_counts(0), 4000.0
    arm.set_ramp(0, start, start + speed, 0, 1_000_000_000)
    arm.advance(900_000_000)
    behind = (start + 0.9 * speed - arm.motor_counts(0)) / speed
    assert behind == pytest.approx((1.0 - share) * IdealArm(UPENN, ELBOW_FORM).lag_s, abs=2e-5)


def test_the_wrists_coupling_moves_the_motors_of_joints_5_and_6():
    """Motor coordinates of a turn of joint 4 alone: what the master's decoupling matrix says, in counts."""
    turn = np.array((0, 0, 0, 0.1, 0, 0))
    counts = joints_to_units(UPENN, turn)
    assert np.linalg.inv(joints_per_motor(UPENN)) @ turn * units_per_motor(UPENN) == pytest.approx(counts, abs=1e-9)
    assert counts[4] == pytest.approx(-9.8462 * 800 * 0.1 / (2 * np.pi))


def test_held_dynamics_cost_little_in_a_cycle():
    """Mass matrix, bias and geometry held over 2.5 ms against evaluated in every call, over a moving contact."""
    c = config()
    held = ramps(DynamicArm(UPENN, c.q0, make_equations(c), Stepping(step_ns=625_000)), cycles=20)
    free = ramps(DynamicArm(UPENN, c.q0, make_equations(c, held=False), Stepping(step_ns=625_000)), cycles=20)
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
