"""The contact of a plan: whether the joints' counts hold its force, whether the array shows all of it, in time, and
what else knows of it: the witnesses, whose checks are in `canprobe.cell.master.conditions` (rows `image_dead`, `depth`,
`force_fell`, `push_unfelt`).

The cell stops a touch when the upper end of the measured force is above the limit. So a task must leave room for it: at
its first touch, when creep is not yet what it was in the calibration, and at its end, when it is more.

The layer on the probe is a bed of springs of stiffness k a volume. On an object of principal curvatures κ, with A and B
= ½ (1/R + κ), a force F presses it in by δ = √(2 F √(AB) / (π k)), with the pressure k (δ - A x² - B y²) inside a patch
of half axes √(δ/A) and √(δ/B). The array shows that pressure blurred: a Gaussian of standard deviation σ takes
k (A + B) σ² off its peak. The model fails where the blur is as wide as the patch, which then has a higher peak, and
on a flat array, which has no such layer.

A taxel counts from a threshold on. The worst place for a contact is the corner of four taxels: each of them shows the
share q² of its force, q = ½ erf(p / (√2 σ)) with p the pitch. So the array shows a contact from the force
threshold · p² / q² on, and less than half of twice that force. Until an image shows the contact, and the command that
follows takes effect, the probe goes on at its speed. The depth δ asks for no more than k δ times the area of the array.

Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from canprobe.cell.planning.array import measured_share
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.pdos import TORQUE
from canprobe.cell.planning.sync import CYCLES_TO_EFFECT
from canprobe.cell.scene.setup import Array, Calibrate, Probe, Setup, Touch
from canprobe.errors import at_least, at_most
from canprobe.mechanics.robot.chain import forward, forward_jacobian
from canprobe.mechanics.robot.inverse import FIXED_POLE, task_rows
from canprobe.mechanics.robot.model import position_per_unit
from canprobe.mechanics.touch.depth_witness import SUSPECT_S, sigma_ahead
from canprobe.mechanics.touch.image.force_creep import decades_after, late_decades_after
from canprobe.mechanics.touch.image.force_errors import UPPER_SIGMAS, ForceSigma, upper_end
from canprobe.mechanics.touch.pad import COUNTS_MAX, THRESHOLD_COUNTS
from canprobe.mechanics.touch.sinkage import CERTAIN_SIGMAS
from canprobe.mechanics.touch.stops import (
    LEAST_PUSH_SHARE,
    MAX_FORCE_SPREAD,
    OFF_PAD_EDGE_SHARE,
    OFF_PAD_SIGMAS,
    PUSH_SIGMAS,
    TORQUE_MEAN_NS,
    TOUCH_FORCE,
    depth_on_plane,
)
from canprobe.mechanics.types import Floats

_ROUNDS = 5


def force_sigma_of(array: Array, probe: Probe, force: float, seconds: float) -> ForceSigma:
    """Standard deviation of a force that is measured some time after the touch, on a plane.

    Args:
        array: the array, with its calibration.
        probe: the probe that carries it.
        force: force, N.
        seconds: time since the touch and the tare before it, s.
    """
    errors, calibration = array.calibration.force, array.calibration
    # pressure k δ on a plane; a flat array has no such layer, and its light touches are not known
    peak_pa = probe.stiffness * depth_on_plane(force, probe.stiffness, probe.radius)
    return errors.sigma(
        force,
        array.pad.lightness(peak_pa),
        force * (decades_after(seconds) - errors.creep_decades),
        late_decades_after(seconds),
        reference=0.0 if calibration.nominal else calibration.force_sigma,
        peak=peak_pa / array.pad.full_scale_pa,
        age_s=seconds,
    )


def highest_known_force(array: Array, probe: Probe, limit: float, times: Sequence[float]) -> float:
    """Force (N) whose upper end is the limit (N), at the worst of some times since the touch (s)."""
    force = limit
    for _ in range(_ROUNDS):  # the relative standard deviation hardly changes with the force
        upper = max(upper_end(force, force_sigma_of(array, probe, force, seconds).total) for seconds in times)
        force *= limit / upper
    return force


def force_problems(setup: Setup, task: Touch | Calibrate) -> Iterator[str]:
    """Why a touch would be stopped at its wanted force: the upper end of what the array measures is above the limit."""
    limit = setup.limits.force_max
    highest = highest_known_force(task.array, task.probe, limit, (0.0, task.duration_s))
    if task.force <= highest:
        return
    share = limit / highest - 1.0
    yield (
        f"task.force_n = {task.force:g}: the array measures it to ± {100.0 * share:.1f} % ({UPPER_SIGMAS:g}σ), so that "
        f"its upper end is above limits.force_max_n = {limit:g}, which stops the touch; lower task.force_n to "
        f"{at_most(0.99 * highest)}, raise limits.force_max_n to {at_least(1.01 * task.force * (1.0 + share))}, or "
        "calibrate the array (`canprobe calibrate array CELL`)"
    )


GAIN_SPREAD = 0.05
"""Share by which one taxel shows more than another: at the edge it may seem to be pressed harder by as much."""
BLUR_TAXELS = 0.72
"""Standard deviation of the blur in taxels, from the packaged calibration: a finer array blurs over less distance."""
_Touching = TypeVar("_Touching", Touch, Calibrate)
_EVERY = 8
"""Every so many contacts along a path are enough for what changes little from one to the next."""


@dataclass(frozen=True, slots=True)
class Pressed:
    """The layer under a force on an object.

    Attributes:
        depth: δ, m.
        half_axis: longer half axis of the patch, m.
        shown_pa: peak pressure that the array shows, Pa.
    """

    depth: float
    half_axis: float
    shown_pa: float


def pressed(force_n: float, probe: Probe, array: Array, kappa: Sequence[float]) -> Pressed:
    """The layer under a force.

    Args:
        force_n: normal force of the contact, N.
        probe: the probe that carries the layer.
        array: the array under the layer.
        kappa: (2,) principal curvatures of the object, above -1/R, 1/m.
    """
    (a, b), depth = half_curvatures(probe, kappa), layer_depth(force_n, probe, kappa)
    shown = probe.stiffness * (depth - (a + b) * _blur_m(array) ** 2)
    return Pressed(depth, math.sqrt(depth / min(a, b)), shown)


def half_curvatures(probe: Probe, kappa: Sequence[float]) -> tuple[float, float]:
    """A and B, 1/m, of the probe on an object of principal curvatures (2,), 1/m."""
    return 0.5 * (1.0 / probe.radius + kappa[0]), 0.5 * (1.0 / probe.radius + kappa[1])


def layer_depth(force_n: float, probe: Probe, kappa: Sequence[float]) -> float:
    """Depth δ of the layer, m, under a force, N, on an object of principal curvatures (2,), 1/m."""
    a, b = half_curvatures(probe, kappa)
    return math.sqrt(2.0 * force_n * math.sqrt(a * b) / (math.pi * probe.stiffness))


def _blur_m(array: Array) -> float:
    return min(array.calibration.image.blur, BLUR_TAXELS * array.pad.pitch_m)


def contact_problems(task: Touch, joints: Floats, normals: Floats, kappas: Floats, force_max_n: float) -> list[str]:
    """Why a touch cannot hold its force along its path; empty for a flat array, which has no layer.

    Args:
        task: a scan or a press.
        joints: (m, n) positions at its contacts, rad or m.
        normals: (m, 3) outward unit normals there.
        kappas: (m, 2) principal curvatures there, above -1/R, 1/m.
        force_max_n: highest force that is allowed.
    """
    if task.array.pad.is_flat:
        return []
    some, there = joints[::_EVERY], normals[::_EVERY]

    def troubles(changed: Touch) -> set[str]:
        """Problems of a changed task, by name: a way out of one must not lead into another."""
        known = highest_known_force(changed.array, changed.probe, force_max_n, (0.0, changed.duration_s))
        unheld = settling_problem(changed, some, there, lambda _: False)
        hidden = saturation_problem(changed, kappas, lambda _: False)
        each = {"high": changed.force > known, "settling": unheld is not None, "saturation": hidden is not None}
        return {name for name, there in each.items() if there}

    before = troubles(task)
    found = (
        saturation_problem(task, kappas, lambda changed: troubles(changed) <= before - {"saturation"}),
        settling_problem(task, some, there, lambda changed: troubles(changed) <= before - {"settling"}),
        edge_problem(task, joints, normals, kappas),
    )
    return [problem for problem in found if problem is not None]


def settling_problem(task: Touch, joints: Floats, normals: Floats, holds: Callable[[Touch], bool]) -> str | None:
    """Problem where the force cannot settle, because the drives count too coarsely for the layer; else None.

    Rounding to whole counts displaces the probe by σ along the normal, and with F ~ δ² the force by 2 σ/δ of itself.

    Args:
        task: a scan or a press.
        joints: (m, n) positions at its contacts, rad or m.
        normals: (m, 3) outward unit normals there.
        holds: whether a changed task has its force and shows it.
    """
    model, tool = task.arm.model, task.probe.T_flange_probe
    each = np.abs([position_per_unit(model, q, tool, normal) for q, normal in zip(joints, normals, strict=True)])
    sigmas = np.linalg.norm(each, axis=1) / math.sqrt(12.0)
    depth = pressed(task.least_force, task.probe, task.array, (0.0, 0.0)).depth
    worst = int(np.argmax(sigmas))
    spread = 2.0 * float(sigmas[worst]) / depth
    if spread <= MAX_FORCE_SPREAD:
        return None
    coarsest = int(np.argmax(each[worst]))
    joint, beyond = model.joints[coarsest], spread / MAX_FORCE_SPREAD
    ways = [f"let the drive of {joint.name} count finer"]
    force, stiffness = at_least(1.01 * task.least_force * beyond**2), at_most(0.99 * task.probe.stiffness / beyond**2)
    if holds(replace(task, force=float(force), tables={})):
        ways.append(f"raise task.force_n to {force}")
    if holds(replace(task, probe=replace(task.probe, stiffness=float(stiffness)))):
        ways.append(f"take a softer layer (probe.stiffness_n_m3 = {stiffness})")
    return (
        f"joints.{joint.name}: one count moves the probe by {1e3 * each[worst, coarsest]:.2g} mm along the normal, and "
        f"all joints together by {1e3 * sigmas[worst]:.2g} mm (1σ), where {task.least_force:g} N press the layer in by "
        f"{1e3 * depth:.2g} mm: the force would swing by {100 * spread:.0f} %, and above "
        f"{100 * MAX_FORCE_SPREAD:.0f} % it does not settle; {' or '.join(ways)}"
    )


def saturation_problem(task: _Touching, kappas: Floats, holds: Callable[[_Touching], bool]) -> str | None:
    """Problem where the array cannot show the wanted force, because its taxels saturate; else None.

    Where a window cuts the patch, more than that force presses until the window measures it.

    Args:
        task: the task that touches.
        kappas: (m, 2) principal curvatures of the object at its contacts, 1/m.
        holds: whether a changed task holds its force.
    """
    probe, array, pitch = task.probe, task.array, task.array.pad.pitch_m
    full_pa = array.pad.full_scale_pa
    if array.pad.is_flat:
        return None  # a calibration with a flat array is refused elsewhere
    windowed = array.mode == "window" and array.window != "auto"
    inside = measured_share(task.force, probe, int(array.window), pitch) if windowed else 1.0
    layers = [pressed(task.force / inside, probe, array, one) for one in kappas.tolist()]
    worst = max(layers, key=lambda one: one.shown_pa)
    if worst.shown_pa <= full_pa:
        return None
    fits = worst.depth - (worst.shown_pa - full_pa) / probe.stiffness
    lower, shown_pa = at_most(0.99 * task.force * (fits / worst.depth) ** 2), worst.shown_pa
    way = f"lower task.force_n to {lower}, or " if fits > 0.0 and holds(replace(task, force=float(lower))) else ""
    return (
        f"sensor.full_scale_kpa = {1e-3 * full_pa:g}: at task.force_n = {task.force:g} the taxels under the middle of "
        f"the contact have up to {1e-3 * shown_pa:.3g} kPa and saturate, so that the force is not measured; "
        f"{way}take an array with sensor.full_scale_kpa = {at_least(1.01e-3 * shown_pa)}"
    )


def edge_margin(task: Touch, kappa: Sequence[float] = (0.0, 0.0)) -> float:
    """Least distance of the contact's middle from the array's edge, m; nearer, the cell takes the contact as lost.

    Args:
        task: a scan or a press with an array that is wrapped on the probe.
        kappa: (2,) principal curvatures of the object there, 1/m.
    """
    array = task.array
    if array.pad.is_flat:
        return 0.0
    half_axis = pressed(task.force, task.probe, array, kappa).half_axis
    if array.mode == "features":
        return OFF_PAD_SIGMAS * math.sqrt(half_axis**2 / 6.0 + _blur_m(array) ** 2)
    return 0.5 * array.pad.pitch_m + half_axis * math.sqrt(1.0 - OFF_PAD_EDGE_SHARE + GAIN_SPREAD)


def edge_problem(task: Touch, joints: Floats, normals: Floats, kappas: Floats) -> str | None:
    """Problem where the contact would run off the array; else None.

    Args:
        task: a scan or a press.
        joints: (m, n) positions at its contacts, rad or m.
        normals: (m, 3) outward unit normals there.
        kappas: (m, 2) principal curvatures there, 1/m.
    """
    pad, probe, chain = task.array.pad, task.probe, task.arm.model.chain
    if pad.is_flat:
        return None
    axes = np.array([(forward(chain, q) @ probe.T_flange_probe)[:3, :3] for q in joints])
    x, y, z = -np.einsum("mij,mi->jm", axes, normals)  # from the probe's centre to the contact
    sine = np.hypot(x, y)
    angle = np.arctan2(sine, z)
    uv = np.abs(np.stack((x, y), axis=1)) * (probe.radius * angle / np.maximum(sine, 1e-300))[:, None]
    margins = np.array([edge_margin(task, kappa) for kappa in kappas.tolist()])
    beyond = uv + margins[:, None] - pad.half_sides_m
    worst = int(np.argmax(beyond.max(axis=1)))
    if beyond[worst].max() <= 0.0:
        return None
    axis = int(np.argmax(beyond[worst]))
    count, needs = (pad.columns, pad.rows)[axis], f"the patch at {task.force:g} N needs {1e3 * margins[worst]:.1f} mm"
    half = pad.half_sides_m[axis]
    if margins[worst] > half:
        return (
            f"sensor.{('columns', 'rows')[axis]} = {count}: the array is {2e3 * half:g} mm wide, and {needs} on each "
            "side of the middle of the contact; take a larger array, or lower task.force_n"
        )
    turns = task_rows(task.arm.model) != FIXED_POLE
    first = "lower task.rolling_share" if turns else "use an arm that tilts the probe"
    ways = [first, "shorten task.length_mm"] if task.scan is not None else [first]
    return (
        f"task: the contact would run off the array: the normal of the object is up to "
        f"{math.degrees(angle[worst]):.1f} deg from the probe's pole, and the contact {1e3 * uv[worst, axis]:.1f} mm "
        f"beside the middle of the array, which reaches {1e3 * half:.1f} mm, and {needs} of it; {' or '.join(ways)}"
    )


MIN_SHOWN_SHARE = 0.5
"""Share of the force that the array must show, whatever the place of the contact between its taxels."""


def first_shown_n(array: Array) -> float:
    """Force (N) from which the array shows a contact, wherever on its grid."""
    pad = array.pad
    if not pad.is_grid:
        return TOUCH_FORCE
    share = 0.5 * math.erf(1.0 / (math.sqrt(2.0) * BLUR_TAXELS))
    threshold_pa = pad.full_scale_pa * THRESHOLD_COUNTS / COUNTS_MAX
    return max(TOUCH_FORCE, threshold_pa * (pad.pitch_m / share) ** 2)


def force_at(depth: float, probe: Probe, array: Array, kappa: Sequence[float]) -> float:
    """Force (N) that presses the layer in by a depth (m) on an object of principal curvatures (2,), 1/m."""
    (a, b), area = half_curvatures(probe, kappa), float(array.pad.areas.sum())
    return probe.stiffness * depth * min(math.pi * depth / (2.0 * math.sqrt(a * b)), area)


def depth_at(force_n: float, probe: Probe, array: Array, kappa: Sequence[float]) -> float:
    """Depth (m) of the layer under a force: the inverse of `force_at`."""
    return max(layer_depth(force_n, probe, kappa), force_n / (probe.stiffness * float(array.pad.areas.sum())))


def blind_s(rate_hz: float, array: Array, lag_s: float) -> float:
    """Longest time from the moment when the array can show the contact to the end of the approach, s.

    Args:
        rate_hz: rate of the cycle.
        array: the array.
        lag_s: lag of the drives behind a ramp.

    The next image comes up to a period later, it arrives a period after its sample (a device of raw frames says how
    much later), and the command of that cycle takes effect `CYCLES_TO_EFFECT` later, behind the lag of the drives.
    """
    period_s = 1.0 / array.rate_hz
    arrives_s = period_s if array.raw is None else array.raw.latency_s
    return period_s + arrives_s + CYCLES_TO_EFFECT / rate_hz + lag_s


def first_touch_problems(setup: Setup, task: Touch | Calibrate, kappa: Sequence[float]) -> Iterator[str]:
    """Why a touch cannot begin: the array does not show its force, or shows it when the probe presses too hard.

    Args:
        setup: the closed setup.
        task: its task.
        kappa: (2,) principal curvatures of the object at the first contact, above -1/R, 1/m.
    """
    array, probe, limit_n = task.array, task.probe, setup.limits.force_max
    shown_n = first_shown_n(array)
    needed_n = shown_n / MIN_SHOWN_SHARE
    if shown_n > TOUCH_FORCE and task.least_force < needed_n:
        pitch_mm, full_kpa, share = 1e3 * array.pad.pitch_m, 1e-3 * array.pad.full_scale_pa, task.least_force / needed_n
        ways = [f"task.force_n = {at_least(1.01 * needed_n)}"] if needed_n < 0.9 * limit_n else []
        ways.append(
            f"sensor.pitch_mm = {at_most(0.99 * pitch_mm * math.sqrt(share))} or sensor.full_scale_kpa = "
            f"{at_most(0.99 * full_kpa * share)} of another array"
        )
        yield (
            f"sensor.pitch_mm = {pitch_mm:g}, sensor.full_scale_kpa = {full_kpa:g}: between its taxels the array shows "
            f"a contact from {shown_n:.2g} N on, and less than half of task.force_n = {task.least_force:g}; take "
            + " or ".join(ways)
        )
        return
    depth, speed = depth_at(shown_n, probe, array, kappa), task.approach.speed
    after_s = blind_s(setup.rate_hz, array, task.lag_s)
    reached_n = force_at(depth + speed * after_s, probe, array, kappa)
    known_n = highest_known_force(array, probe, limit_n, (0.0,))
    if reached_n <= known_n:
        return
    slower = 0.99 * (depth_at(known_n, probe, array, kappa) - depth) / after_s
    yield (
        f"task.approach_mm_s = {1e3 * speed:g}: the array shows a contact from {shown_n:.2g} N on, and the probe stops "
        f"up to {1e3 * after_s:.0f} ms later (sensor.rate_hz = {array.rate_hz:g}), when {reached_n:.2g} N press, "
        f"measured up to {reached_n * limit_n / known_n:.2g} N (2σ), more than limits.force_max_n = {limit_n:g}; lower "
        f"task.approach_mm_s to {at_most(1e3 * slower)}, or raise sensor.rate_hz"
    )


MAX_BLIND_SHARE = 1.2
"""Largest push that the torques show for certain, over the limit of the force, with which they bound a search."""
STEADY_S = 0.25
"""Time of an approach after which the torques without a contact are known, s."""


def reports_torque(plan: Plan) -> bool:
    """Whether each drive of the arm sends its torque (6077h)."""
    return bool(plan.setup.drives) and all(
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
    speed = plan.setup.scan.speed if plan.setup.scan is not None else 0.0
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
        why = "not each drive sends 6077h" if plan.setup.drives else "an external arm has no drives"
        return (
            f"none, as {why}: a blind array would let the search press with up to"
            f" {blind:.0f} N, {unseen:.0f} N as long as no image has changed since bring-up"
        )
    if (push := certain_push(plan)) == math.inf:
        steady_s = approach.clearance / approach.speed
        return (
            f"silent at the first contact, as {steady_s:.2f} s of approach are too short to know the torques without"
            f" it: raise task.clearance_mm to {math.ceil(STEADY_S * approach.speed * 1e4) / 10:g}"
        )
    words = f"a push of {push:.1f} N that the array does not measure: beyond 4σ of what friction may hide"
    if bounds_search(plan):
        return words
    return (
        f"{words} at task.approach_mm_s = {1e3 * approach.speed:g}; until an image has changed the search ends after"
        f" {1e3 * approach.blind_search:.2g} mm"
    )


def bounds_search(plan: Plan) -> bool:
    """Whether the torques of the drives bound the force of a search, whatever the array measures."""
    return certain_push(plan) < MAX_BLIND_SHARE * plan.setup.limits.force_max


def certain_push(plan: Plan) -> float:
    """Least push that the torques of the drives show for certain on the approach of a touch, N; infinite where none.

    The slower motors turn, the more of a push their friction may hide.
    """
    setup, touch = plan.setup, plan.setup.touch
    if touch is None or not reports_torque(plan) or touch.approach.clearance < STEADY_S * touch.approach.speed:
        return math.inf
    from canprobe.mechanics.robot.tool_push import PushGeometry, steady_sigma  # a scene that touches nothing has none

    arm, flange_tip = setup.needed_arm(), setup.probe.T_flange_tip
    T, J = forward_jacobian(arm.model.chain, arm.q_start, flange_tip)
    down = np.concatenate((touch.approach.speed * T[:3, 2], np.zeros(3)))
    rates = np.asarray(np.linalg.lstsq(J, down, rcond=None)[0], dtype=np.float64)
    geometry = PushGeometry(arm.model, flange_tip)
    sigma = steady_sigma(geometry, arm.q_start, geometry.motors(rates), TORQUE_MEAN_NS * 1e-9)
    return max(PUSH_SIGMAS * sigma, LEAST_PUSH_SHARE * setup.limits.force_max)


def _force(probe: Probe, depth: float) -> float:
    """Force at a depth, m, on a plane at the stated stiffness, N."""
    return (depth / depth_on_plane(1.0, probe.stiffness, probe.radius)) ** 2


def _depth_error(speed: float) -> float:
    """How well the depth on new ground is known at a speed, m/s: m."""
    return CERTAIN_SIGMAS * sigma_ahead(SUSPECT_S * speed)
