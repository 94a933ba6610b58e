"""The motion that study `workprec` integrates: a sliding contact on the cylinder, and its reference solution.

The probe starts at rest in contact and is led over the cylinder at 25 mm/s at the indentation of 2 N, by one straight
ramp a cycle, as the cell does. Drives, links, friction and contact are all on.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from canprobe.emulator.plant.arms import make_equations
from canprobe.emulator.plant.config import PlantConfig
from canprobe.emulator.plant.contact import depth_for_force
from canprobe.emulator.plant.dynamic_arm import DynamicArm, Stepping
from canprobe.emulator.plant.taxels import TaxelConfig
from canprobe.emulator.plant.world import Plant, PlantState
from canprobe.robot.actuation import counts_per_radian
from canprobe.robot.inverse import inverse_near
from canprobe.robot.kinematics import tool_z_offset
from canprobe.robot.puma260 import UPENN, counts_to_joints, joints_to_counts
from canprobe.robot.touching import probe_pose, start_posture
from canprobe.touch.objects import make_object

Array = npt.NDArray[np.float64]

CYCLE_NS = 2_500_000
SPEED_M_S, FORCE_N = 0.025, 2.0
NUDGE_COUNTS, AT_REST_COUNTS_S = 5.0, 20.0
_POINT, _TOOL, _RADIUS = np.array((-0.120, -0.1225, 0.374)), tool_z_offset(80.0), 0.036


@cache
def trial(stiffness_n_m3: float, cycles: int) -> tuple[PlantConfig, Array]:
    """The plant and its drives' targets.

    Args:
        stiffness_n_m3: of the layer.
        cycles: of 2.5 ms.

    Returns:
        The configuration, and (cycles + 1, 6) whole counts at the ends of the cycles.
    """
    pose = np.eye(4)
    pose[:3, 3] = _POINT
    shape = make_object("cylinder", T_base_object=pose, radius=_RADIUS)
    depth = depth_for_force(FORCE_N, (1.0 / _RADIUS, 0.0), 0.040, stiffness_n_m3)
    q = start_posture(UPENN, _POINT, (0, 0, 1), radius_m=0.040, T_flange_probe=_TOOL, clearance_m=-depth)
    config = PlantConfig(
        UPENN, q, object=shape, stiffness_n_m3=stiffness_n_m3, fidelity="dynamic", taxels=TaxelConfig()
    )
    targets = []
    for k in range(cycles + 1):
        turn = SPEED_M_S * k * CYCLE_NS * 1e-9 / _RADIUS
        normal = np.array((0.0, math.sin(turn), math.cos(turn)))
        point = _POINT + _RADIUS * (normal - (0.0, 0.0, 1.0))
        q = inverse_near(UPENN, probe_pose(point, normal, 0.040 - depth, (1, 0, 0)) @ np.linalg.inv(_TOOL), q)
        targets.append(np.rint(joints_to_counts(UPENN, q)))
    counts = np.array(targets)
    start = counts_to_joints(UPENN, counts[0])  # a posture that the encoders can hold
    return PlantConfig(
        UPENN, start, object=shape, stiffness_n_m3=stiffness_n_m3, fidelity="dynamic", taxels=config.taxels
    ), counts


def integrated(stiffness_n_m3: float, cycles: int, stepping: Stepping, held: bool) -> Array | None:
    """(cycles, 12) motor counts and rates at the ends of the cycles; None where the integration broke down."""
    config, targets = trial(stiffness_n_m3, cycles)
    arm = DynamicArm(UPENN, config.q0, make_equations(config, held=held), stepping)
    seen: list[Any] = []
    with np.errstate(all="ignore"):
        for k in range(cycles):
            for i in range(6):
                arm.set_ramp(i, float(targets[k, i]), float(targets[k + 1, i]), k * CYCLE_NS, (k + 1) * CYCLE_NS)
            arm.advance((k + 1) * CYCLE_NS)
            try:
                seen.append([x for part in arm.motors() for x in part])
            except (ArithmeticError, ValueError, np.linalg.LinAlgError):
                return None
    found = np.array(seen)
    return found if np.all(np.isfinite(found)) and np.abs(found).max() < 1e9 else None


def stands(stiffness_n_m3: float, cycles: int, stepping: Stepping) -> bool:
    """Whether the arm comes to rest in contact after a nudge of one motor, as it does in truth.

    Args:
        stiffness_n_m3: of the layer.
        cycles: of 2.5 ms.
        stepping: how it is integrated.
    """
    config, _ = trial(stiffness_n_m3, 1)
    arm = DynamicArm(UPENN, config.q0, make_equations(config), stepping)
    start, fastest = arm.motor_counts(0), []
    arm.set_ramp(0, start, start + NUDGE_COUNTS, 0, CYCLE_NS)
    with np.errstate(all="ignore"):
        for k in range(cycles):
            arm.advance((k + 1) * CYCLE_NS)
            try:
                fastest.append(max(map(abs, arm.motors()[1])))
            except (ArithmeticError, ValueError, np.linalg.LinAlgError):
                return False
    return bool(max(fastest[-cycles // 4 :]) < AT_REST_COUNTS_S)  # false for NaN too


def reference(stiffness_n_m3: float, cycles: int, rtol: float) -> Array:
    """The same by scipy's Radau, cycle by cycle, nothing held."""
    from scipy.integrate import solve_ivp

    config, targets = trial(stiffness_n_m3, cycles)
    equations, scale = make_equations(config, held=False), counts_per_radian(UPENN)
    h, seen = CYCLE_NS * 1e-9, []
    y = equations.resting(targets[0] / scale)
    for k in range(cycles):
        slope = (targets[k + 1] - targets[k]) / scale / h
        equations.loops.set_reference(k * h, (targets[k] / scale).tolist(), slope.tolist())
        solved = solve_ivp(
            equations.rate, (k * h, (k + 1) * h), y, "Radau", rtol=rtol, atol=1e-2 * rtol, jac=equations.jacobian
        )
        y = solved.y[:, -1]
        seen.append(np.concatenate((y[:6] * scale, y[6:12] * scale)))
    return np.array(seen)


def observed(stiffness_n_m3: float, cycles: int, states: Array) -> dict[str, Array]:
    """What the states mean: force (n,) N, probe centre (n, 3) m, taxel pressures (n, 256) Pa.

    Args:
        stiffness_n_m3: of the layer.
        cycles: of the trial.
        states: (n, 12) counts and rates.
    """
    plant = Plant(trial(stiffness_n_m3, cycles)[0])
    at = [PlantState(0, tuple(row[:6].tolist()), tuple(row[6:].tolist())) for row in states]
    truths = [plant.truth(state) for state in at]
    return {
        "force": np.array([t["force"] for t in truths]),
        "centre": np.array([t["probe_centre"] for t in truths]),
        "taxels": np.array([plant.pressure(state).ravel() for state in at]),
    }
