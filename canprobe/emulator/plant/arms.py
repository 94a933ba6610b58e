"""The arm that a plant's configuration asks for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from canprobe.emulator.plant.arm import IdealArm
from canprobe.emulator.plant.config import PlantConfig

if TYPE_CHECKING:
    from canprobe.emulator.plant.dynamic_arm import DynamicArm
    from canprobe.emulator.plant.equations import ArmEquations, Effects


def make_arm(config: PlantConfig) -> IdealArm | DynamicArm:
    """An ideal or a dynamic arm; what the ideal one does not need is not imported.

    Args:
        config: with a model.
    """
    assert config.model is not None
    if config.fidelity == "ideal":
        return IdealArm(config.model, config.q0, config.bandwidth_hz, config.damping_ratio)
    from canprobe.emulator.plant.dynamic_arm import DynamicArm, Stepping

    d = config.dynamics
    return DynamicArm(config.model, config.q0, make_equations(config), Stepping(d.integrator, d.step_ns, d.hold_ns))


def make_equations(config: PlantConfig, effects: Effects | None = None, *, held: bool = True) -> ArmEquations:
    """Equations of motion of a dynamic arm.

    Args:
        config: with a model.
        effects: what acts; everything by default.
        held: see ``ArmEquations``.
    """
    from canprobe.emulator.plant.cascade import Cascade, DriveSettings
    from canprobe.emulator.plant.equations import ArmEquations, Effects
    from canprobe.emulator.plant.near import Neighbourhood
    from canprobe.emulator.plant.pushing import Rubbing
    from canprobe.robot.actuation import REFLECTED_INERTIA, joints_per_motor
    from canprobe.robot.dynamics import RigidBody
    from canprobe.robot.inertia import ball_inertia, puma260_inertia

    assert config.model is not None
    d, effects = config.dynamics, effects or Effects()
    ball = ball_inertia(d.payload, config.radius_m)
    links = puma260_inertia(config.model).with_payload(d.payload, config.T_flange_probe_centre, ball)
    body = RigidBody(config.model, links)
    back = joints_per_motor()
    inertia = np.array(REFLECTED_INERTIA)
    if effects.links:  # a drive is tuned to what its motor moves in the first posture
        inertia = inertia + np.diag(back.T @ body.terms(config.q0, np.zeros(6))[0] @ back)
    drives = DriveSettings(
        config.bandwidth_hz, config.damping_ratio, d.integral_s, d.velocity_feed_forward, d.torque_limit_permille
    )
    cascade = Cascade(drives, inertia)
    if config.object is None:
        return ArmEquations(body, cascade, effects=effects, held=held)
    touching = Neighbourhood(
        config.model,
        back,
        config.T_flange_probe_centre,
        config.base_offset_m,
        config.object,
        radius=config.radius_m,
        stiffness_n_m3=config.stiffness_n_m3,
        rubbing=Rubbing(config.damping_s_m, d.friction),
    )
    return ArmEquations(body, cascade, touching, effects, held=held)
