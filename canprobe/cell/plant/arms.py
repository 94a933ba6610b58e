"""The arm that a plant's configuration asks for."""

from __future__ import annotations

import numpy as np

from canprobe.cell.plant.cascade import DriveLoops
from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.dynamic_arm import DynamicArm, Stepping
from canprobe.cell.plant.equations import ArmEquations, Effects
from canprobe.cell.plant.ideal_arm import IdealArm
from canprobe.cell.plant.pushing import Neighbourhood, Rubbing
from canprobe.errors import PlanError
from canprobe.mechanics.robot.dynamics import GRAVITY_M_S2, RigidBody, ball, dynamics_problem, joined
from canprobe.mechanics.robot.model import joints_per_motor


def make_arm(config: PlantConfig) -> IdealArm | DynamicArm:
    """An ideal or a dynamic arm.

    Args:
        config: configuration of a plant with an arm.

    Raises:
        PlanError: a dynamic arm without bodies, or without the extra `dynamics`.
    """
    assert config.model is not None
    if config.fidelity == "ideal":
        return IdealArm(config.model, config.q0, config.bandwidth_hz, config.damping_ratio)
    d = config.dynamics
    return DynamicArm(config.model, config.q0, make_equations(config), Stepping(d.integrator, d.step_ns, d.hold_ns))


def make_equations(config: PlantConfig, effects: Effects | None = None, *, held: bool = True) -> ArmEquations:
    """Equations of motion of a dynamic arm.

    Args:
        config: configuration of a plant with an arm and the bodies of its links.
        effects: effects that act; all by default.
        held: see ``ArmEquations``.

    Raises:
        PlanError: see ``make_arm``.
    """
    assert config.model is not None
    model, d, T_probe, effects = config.model, config.dynamics, config.T_flange_probe_centre, effects or Effects()
    if config.bodies is None:
        raise PlanError([dynamics_problem(model.name, None) or ""])
    centre = (model.chain.T_last_flange @ T_probe)[:3, 3]
    bodies = *config.bodies[:-1], joined(config.bodies[-1], ball(d.payload, config.radius_m, centre))
    body = RigidBody(model.chain, bodies, GRAVITY_M_S2 if effects.gravity else 0.0)
    back = joints_per_motor(model)
    inertia = np.array([joint.rotor_inertia for joint in model.joints])
    if effects.links:  # a drive is tuned to what its motor moves in the first posture
        inertia = inertia + np.diag(back.T @ body.terms(config.q0, np.zeros(model.n))[0] @ back)
    loops = DriveLoops(model, inertia, config.bandwidth_hz, config.damping_ratio, d, friction=effects.friction)
    if config.object is None:
        return ArmEquations(model, body, loops, effects=effects, held=held)
    touching = Neighbourhood(
        model.chain,
        back,
        T_probe,
        config.base_offset_m,
        config.object,
        radius=config.radius_m,
        stiffness_n_m3=config.stiffness_n_m3,
        rubbing=Rubbing(config.damping_s_m, d.friction),
    )
    return ArmEquations(model, body, loops, touching, effects, held=held)
