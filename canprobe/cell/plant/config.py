"""Configuration of a plant: arm, probe, object and array."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from canprobe.cell.plant.taxels import TaxelConfig
from canprobe.cell.scene.hardware import Fidelity
from canprobe.cell.scene.setup import Carrier, Dynamics
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.model import ArmModel, Body
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True)
class PressMotion:
    """Motion of a probe without an arm: a slow sinusoidal indentation at the object's reference point.

    Args:
        force_n: force at the mean depth.
        swing: amplitude of the depth over its mean.
        frequency_hz: frequency of the swing.
        after_s: time from the first image; until then the probe is off the object, as an array that is tared has to be.
    """

    force_n: float = 2.0
    swing: float = 0.4
    frequency_hz: float = 0.5
    after_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PlantConfig:
    """Configuration of a plant.

    Args:
        model: the arm; None for a sensor alone, pressed on the object by ``press``.
        q0: (n,) joint positions at time 0, rad or m; empty without an arm.
        T_flange_probe_centre: (4, 4) centre of the probe sphere in the flange frame, z = pole of the pad, m.
        radius_m: probe radius.
        stiffness_n_m3: stiffness of the elastic layer (K/h).
        damping_s_m: damping of the contact, Hunt-Crossley alpha (assumed).
        object: object that can be touched; None without one.
        taxels: the array's imperfections; None where there is no array.
        pad: the array's taxels.
        bandwidth_hz: bandwidth of every drive, -3 dB; critically damped.
        press: motion of a probe without an arm.
        seed: seed of taxel gains and noise.
        fidelity: "ideal": each motor is a second-order system; "dynamic": rigid links, friction, drive cascade, push
            of the object.
        dynamics: what a dynamic arm has beyond its geometry.
        bodies: bodies (n,) of the links behind its joints, without the probe; None where they are not known.
        compliance: compliance (n,) of the joints of an ideal arm between motor and link, rad/(N m) or m/N; None: all
            are rigid.
        base_offset_m: position (3,) of the arm's base in the frame that counts as base.
        carrier: what the object moves with, at its speed from time 0 on; None: it stands still.
    """

    model: ArmModel | None
    q0: Floats = field(default_factory=lambda: np.zeros(0))
    T_flange_probe_centre: Floats = field(default_factory=lambda: tool_z_offset(80.0))
    radius_m: float = 0.040
    stiffness_n_m3: float = 1.27e8
    damping_s_m: float = 0.3
    object: PlacedShape | None = None
    taxels: TaxelConfig | None = field(default_factory=TaxelConfig)
    pad: Pad = field(default_factory=Pad)
    bandwidth_hz: float = 30.0
    press: PressMotion = PressMotion()
    seed: int = 0
    fidelity: Fidelity = "ideal"
    dynamics: Dynamics = field(default_factory=Dynamics)
    bodies: tuple[Body | None, ...] | None = None
    compliance: Floats | None = None
    base_offset_m: Floats = field(default_factory=lambda: np.zeros(3))
    carrier: Carrier | None = None
