"""The array of a plan: what its taxels support, why a task cannot be done with it, and its window on the contact.

Force is a sum over taxels. A centroid needs a few of them under the patch. The second moments of a patch, and with them
its curvature, need about sixteen: on fewer they are those of the grid.

A window holds the patch or cuts it. The patch is that on a plane, the widest on any surface without hollows. The layer
on the probe is a bed of springs: a sphere of radius R with stiffness k a volume, pressed in by d, has the force
F = π k R d² and a patch of radius a = √(2 R d), whose pressure falls from the middle to the rim as 1 - r²/a². The
window follows the centroid in steps of a taxel and may be off its middle by `FOLLOWING_TAXELS`, which needs room on
both sides. The array's blur, which carries some of the rim back inside, is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from canprobe.cell.scene.setup import Array, Calibrate, Probe, Setup, Touch
from canprobe.errors import UsageError, at_most
from canprobe.fieldbus.protocol.tactile import WINDOW_SIZES
from canprobe.mechanics.touch.stops import depth_on_plane

FOLLOWING_TAXELS = 0.75
"""Distance of the contact's centroid from the middle of the window at which the window moves."""
TOLERATED_LOSS_SHARE = 0.05
"""Share of the force that a window may miss without a warning; the array itself errs by as much."""
CARRIED_SIDE, CARRIED_SHARE = 6, 0.5
"""Smallest window, and smallest share of the force inside it, from which the rest of a patch is computed."""
CARRIED_ERROR = 0.1
"""Largest error of such a force, as a share of it, on the emulated array with its spread, blur and noise."""
_STEPS = 200
_HALVINGS = 40


def patch_radius_m(force_n: float, probe: Probe) -> float:
    """Radius of the contact patch on a plane, m."""
    return math.sqrt(2.0 * probe.radius * depth_on_plane(force_n, probe.stiffness, probe.radius))


def patch_across_taxels(force_n: float, probe: Probe, pitch_m: float) -> float:
    """Diameter of the contact patch on a plane, in taxels."""
    return 2.0 * patch_radius_m(force_n, probe) / pitch_m


def windows_of(array: Array) -> tuple[int, ...]:
    """Taxels along each window that the array has room for."""
    return tuple(side for side in WINDOW_SIZES if side <= min(array.pad.shape))


def window_choices(setup: Setup) -> tuple[tuple[int, str], ...]:
    """Windows by preference, with the reason: the smallest that holds the patch; without a force the largest first."""
    touch, array = setup.touch, setup.array
    windows = windows_of(array) if array is not None else WINDOW_SIZES
    if touch is None:
        return tuple((side, "the largest that fits; nothing is pressed") for side in reversed(windows))
    across = patch_across_taxels(touch.force, touch.probe, touch.array.pad.pitch_m)
    needed = across + 2.0 * FOLLOWING_TAXELS
    patch = (
        f"at {touch.force:g} N the patch on a plane has {2e3 * patch_radius_m(touch.force, touch.probe):.1f} mm across"
        f" and asks for {needed:.1f} taxels with {FOLLOWING_TAXELS:g} on each side for following it"
    )
    enough = [side for side in windows if side >= needed]
    less = [side for side in reversed(windows) if side < needed]
    return (
        *((side, f"{patch}: the smallest that holds it") for side in enough[:1]),
        *((side, f"{patch}: the largest that fits, cutting its rim") for side in less),
        *((side, f"{patch}: no smaller one fits") for side in enough[1:]),
    )


def measured_share(
    force_n: float, probe: Probe, side: int, pitch_m: float, off_taxels: float = FOLLOWING_TAXELS
) -> float:
    """Share of a force that a window measures.

    Args:
        force_n: force on a plane.
        probe: the probe that carries the layer.
        side: taxels along the window.
        pitch_m: pitch of the taxels.
        off_taxels: distance of the window's middle from the contact's, along one of its sides.
    """
    radius, half = patch_across_taxels(force_n, probe, pitch_m) / 2, side / 2
    first, last = max(-radius, off_taxels - half), min(radius, off_taxels + half)
    width = max(last - first, 0.0) / _STEPS
    x = first + (np.arange(_STEPS) + 0.5) * width
    y = np.minimum(half, np.sqrt(np.maximum(radius**2 - x**2, 0.0)))  # end of the column within patch and window
    columns = 2.0 * y * (1.0 - (x / radius) ** 2) - 2.0 / 3.0 * y**3 / radius**2
    return min(width * float(columns.sum()) / (math.pi / 2 * radius**2), 1.0)


def true_force_n(force_n: float, probe: Probe, side: int, pitch_m: float, most_n: float) -> float | None:
    """The largest true force where a window measures `force_n`; None where it is above `most_n`."""
    if most_n * measured_share(most_n, probe, side, pitch_m) < force_n:
        return None
    low, high = force_n, most_n
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if middle * measured_share(middle, probe, side, pitch_m) < force_n else (low, middle)
    return high


def cut_patch(setup: Setup) -> tuple[str, bool] | None:
    """How the window of a scene cuts the contact patch, with what to change, and whether the force stays safe.

    It is safe where the true force stays below `limits.force_max_n`, which the cell compares with the measured one.
    None where the window measures nearly all of the force or is still open, or the task presses nothing.
    """
    touch = setup.touch
    if touch is None or touch.array.mode != "window" or touch.array.window == "auto":
        return None
    force, probe, side, most = touch.force, touch.probe, int(touch.array.window), setup.limits.force_max
    pitch = touch.array.pad.pitch_m
    share = measured_share(force, probe, side, pitch)
    if share >= 1.0 - TOLERATED_LOSS_SHARE:
        return None
    windows = windows_of(touch.array)
    enough = [wider for wider in windows if measured_share(force, probe, wider, pitch) >= 1.0 - TOLERATED_LOSS_SHARE]
    larger = f"sensor.window = {enough[0]}" if enough else 'sensor.mode = "image"'
    ways = f"{larger} or a smaller task.force_n"
    wider = f"{ways} leaves less than {100 * TOLERATED_LOSS_SHARE:.0f} % outside"
    across = patch_across_taxels(force, probe, pitch)
    cuts = (
        f"sensor.window = {side} cuts the contact patch, which is {across:.1f} taxels across on a plane at "
        f"{force:g} N; as little as {100 * share:.0f} % of that force lies inside"
    )
    if side >= CARRIED_SIDE and share >= CARRIED_SHARE:
        carried = f"the rest is carried on from there, and the force errs by up to {100 * CARRIED_ERROR:.0f} %"
        return f"{cuts}; {carried}; {wider}", True
    cuts += f", and where the window measures {force:g} N, "
    if (true_n := true_force_n(force, probe, side, pitch, most)) is None:
        return f"{cuts}more than limits.force_max_n = {most:g} N can press; take {ways}", False
    return f"{cuts}up to {true_n:.2g} N can press; {wider}", True


PRESS_TAXELS, CENTROID_TAXELS, CURVATURE_TAXELS = 2, 4, 16
"""Taxels under the patch from which a press finds the normal of a sphere, there is a centroid, and second moments."""
COARSE_SHARE = 0.1
"""Share of a sphere's radius: taxels that are nearer to each other than this see the contact of 1 N from all sides."""


@dataclass(frozen=True, slots=True)
class Support:
    """Quantities of its task's contact that an array measures.

    Attributes:
        taxels: number of taxels under the patch on a plane at the task's lowest force; all of them where the task
            presses nothing.
        centroid: whether there are enough taxels for a centroid.
        no_curvature: why the patch shows no curvature; None where it shows it. The force is always measured.
    """

    taxels: float
    centroid: bool
    no_curvature: str | None

    @property
    def curvature(self) -> bool:
        """Whether the patch shows the curvature."""
        return self.no_curvature is None

    def __str__(self) -> str:
        has = ["force", *(["centroid"] if self.centroid else []), *(["curvature"] if self.curvature else [])]
        text = " and ".join([", ".join(has[:-1]), has[-1]] if len(has) > 1 else has)
        return text if self.curvature else f"{text}; no curvature: {self.no_curvature}"


def support_of(setup: Setup) -> Support | None:
    """The quantities that the setup's array measures; None without an array."""
    array, touch = setup.array, setup.touch
    if array is None:
        return None
    taxels = float(array.pad.taxels)
    if touch is not None and not array.pad.is_flat:
        patch = math.pi * patch_radius_m(touch.least_force, touch.probe) ** 2
        taxels = min(taxels, patch / array.pad.pitch_m**2)
    lacks = None
    if array.pad.is_flat:
        lacks = "the array is flat"
    elif not array.pad.is_grid:
        lacks = "the taxels are no square grid"
    elif taxels < CURVATURE_TAXELS:
        lacks = f"fewer than {CURVATURE_TAXELS} taxels under the patch"
    return Support(taxels, taxels >= CENTROID_TAXELS, lacks)


def as_supported(setup: Setup) -> Setup:
    """The setup without curvature from the patch where its array shows none."""
    support, task = support_of(setup), setup.task
    if support is None or support.curvature or not isinstance(task, Touch) or task.shape is None:
        return setup
    return replace(setup, task=replace(task, shape=replace(task.shape, patch=False)))


def array_text(array: Array) -> str:
    """The array in a line."""
    pad = array.pad
    taxels = f"{pad.rows}×{pad.columns} taxels"
    where = "flat" if pad.mount_radius_m is None else f"on a sphere of radius {1e3 * pad.mount_radius_m:g} mm"
    spread = f"{1e3 * pad.pitch_m:g} mm apart" if pad.is_grid else "at given places"
    if pad.cell_m is not None:
        spread = " × ".join(f"{1e3 * side:g}" for side in pad.cell_m) + " mm apart"
    return f"{array.name}: {taxels} {spread}, {where}"


def array_problems(setup: Setup) -> Iterator[str]:
    """Why the task cannot be done with the array."""
    array, task, support = setup.array, setup.task, support_of(setup)
    if array is None or support is None:
        return
    if not array.pad.is_flat and array.pad.pitch_m > COARSE_SHARE * array.pad.radius_m:
        yield from _unreadable(array)
    if not array.pad.is_grid and array.raw is None and array.mode != "image":
        yield (
            f'sensor.mode = "{array.mode}": the array {array.name} is no square grid, and has neither a window nor'
            ' features; set sensor.mode = "image"'
        )
    what = 'task.kind = "scan"' if setup.scan is not None else 'task.kind = "calibrate"'
    if setup.scan is not None or isinstance(task, Calibrate):
        needs = "its contact must be able to move over the sphere of a probe; press or listen with it"
        if array.pad.is_flat:
            yield f'{what}: the array {array.name} is flat (sensor.mount = "flat"): {needs}'
        elif not support.centroid:
            covers = f"the patch covers {support.taxels:.1f} taxels"
            why = f"fewer than {CENTROID_TAXELS} show no place; raise task.force_n, or take a finer array"
            yield f"{what}: {covers} of the array {array.name}, and {why}"
    elif setup.touch is not None and not array.pad.is_flat and array.pad.is_grid and support.taxels < PRESS_TAXELS:
        yield (
            f"sensor.pitch_mm = {1e3 * array.pad.pitch_m:g}: at task.force_n = {setup.touch.least_force:g} the patch "
            f"covers {support.taxels:.1f} taxels of the array {array.name}, and fewer than {PRESS_TAXELS} do not show "
            "where on the probe it presses; raise task.force_n, or take a finer array"
        )


def speed_over_array_problems(setup: Setup) -> Iterator[str]:
    """Why a scan is too fast for its array: the contact must be found again from one image to the next."""
    array = setup.array
    if setup.scan is None or array is None or array.pad.is_flat:
        return
    most = array.pad.pitch_m * array.rate_hz
    if setup.scan.speed > most:
        moves = 1e3 * setup.scan.speed / array.rate_hz
        yield (
            f"task.speed_mm_s = {1e3 * setup.scan.speed:g}: the contact would move {moves:.3g} mm from one image to"
            f" the next (sensor.rate_hz = {array.rate_hz:g}), more than the {1e3 * array.pad.pitch_m:g} mm between"
            f" taxels; lower task.speed_mm_s to {at_most(1e3 * most)}"
        )


def _unreadable(array: Array) -> Iterator[str]:
    """Problem where no force can be read from the array, because a contact falls between its taxels."""
    from canprobe.mechanics.touch import make_patch_calibration  # scipy, for coarse arrays only

    try:
        make_patch_calibration(array.calibration, array.pad)
    except UsageError:
        pad = array.pad
        yield (
            f"sensor.pitch_mm = {1e3 * pad.pitch_m:g}: on the sphere of probe.radius_mm = {1e3 * pad.radius_m:g} a"
            f" contact is too small for taxels so far apart, and the array {array.name} shows no force; take a finer"
            " array, or a larger sphere"
        )
