"""What else than the array knows of the force, and how well: the witnesses of a plan.

The checks themselves are in `canprobe.cell.master.conditions`: rows `image_dead`, `depth`, `force_fell`,
`push_unfelt`.
"""

from __future__ import annotations

import math
from bisect import bisect_right

from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.pdos import TORQUE
from canprobe.cell.scene.setup import Calibrate, Probe, Touch
from canprobe.mechanics.touch.depth_witness import CERTAIN_SIGMAS, SUSPECT_S, sigma_ahead
from canprobe.mechanics.touch.stops import depth_on_plane

STEADY_S = 0.25
"""Time of an approach after which the torques without a contact are known, s."""


def reports_torque(plan: Plan) -> bool:
    """Whether each drive of the arm sends its torque (6077h)."""
    return plan.setup.arm is not None and all(
        any(
            (entry.index, entry.subindex) == TORQUE
            for pdo in plan.pdos_of(drive.node_id, "tpdo")
            for entry in pdo.layout.signals
        )
        for drive in plan.setup.drives
    )


def witness_rows(plan: Plan) -> list[tuple[str, str]]:
    """What else than the array bounds the force, by name; nothing without a touch."""
    touch, limits, probe = plan.setup.touch, plan.setup.limits, plan.setup.probe
    if touch is None:
        return []
    within = "0.4 s, on the move only" if touch.array.calibration.noise.assumed else "0.2 s"
    most, held = (depth_on_plane(force, probe.stiffness, probe.radius) for force in (limits.force_max, touch.force))
    margin = most - held
    speed = touch.scan.speed if isinstance(touch, Touch) and touch.scan is not None else 0.0
    error = _depth_error(speed)
    known = f"{touch.force:g} to {limits.force_max:g} N are {margin * 1e3:.2f} mm, known to {error * 1e3:.2f} mm"
    if speed:
        known += f" on new ground at {speed * 1e3:g} mm/s"
    if error > margin:
        fastest = bisect_right(range(1, 1001), margin, key=lambda mm_s: _depth_error(1e-3 * mm_s))
        known = f"silent above {fastest} mm/s: {known}"
    return [
        ("images", f"one that repeats or does not scatter is noticed within {within}"),
        ("depth", known),
        ("torques", _torques(plan, touch)),
    ]


def _torques(plan: Plan, touch: Touch | Calibrate) -> str:
    """What the torques of the drives show of the force."""
    approach, probe = touch.approach, plan.setup.probe
    if not reports_torque(plan):
        blind, unseen = _force(probe, approach.search), _force(probe, approach.blind_search)
        return (
            "none, as not each drive sends 6077h: a blind array would let the search press with up to"
            f" {blind:.0f} N, {unseen:.0f} N as long as no image has changed since bring-up"
        )
    steady_s = approach.clearance / approach.speed
    if steady_s < STEADY_S:
        return (
            f"silent at the first contact, as {steady_s:.2f} s of approach are too short to know the torques without"
            f" it: raise task.clearance_mm to {math.ceil(STEADY_S * approach.speed * 1e4) / 10:g}"
        )
    return "a push that the array does not measure, beyond 4σ of what friction may hide"


def _force(probe: Probe, depth: float) -> float:
    """Force at a depth, m, on a plane at the stated stiffness, N."""
    return (depth / depth_on_plane(1.0, probe.stiffness, probe.radius)) ** 2


def _depth_error(speed: float) -> float:
    """How well the depth on new ground is known at a speed, m/s: m."""
    return CERTAIN_SIGMAS * sigma_ahead(SUSPECT_S * speed)
