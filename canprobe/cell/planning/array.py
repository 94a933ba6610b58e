"""The array of a plan: what its taxels support, and why a task cannot be done with it.

Force is a sum over taxels. A centroid needs a few of them under the patch. The second moments of a patch, and with them
its curvature, need about sixteen: on fewer they are those of the grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

from canprobe.cell.planning.window import patch_radius_m
from canprobe.cell.scene.setup import Array, Calibrate, Setup, Touch
from canprobe.errors import UsageError, at_most

PRESS_TAXELS, CENTROID_TAXELS, CURVATURE_TAXELS = 2, 4, 16
"""Taxels under the patch from which a press finds the normal of a sphere, there is a centroid, and second moments."""
COARSE_SHARE = 0.1
"""Share of a sphere's radius: taxels that are nearer to each other than this see the contact of 1 N from all sides."""


@dataclass(frozen=True, slots=True)
class Support:
    """Quantities of its task's contact that an array measures.

    Attributes:
        taxels: number of taxels under the patch on a plane at the task's force; all where the task presses nothing.
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
        patch = math.pi * patch_radius_m(touch.force, touch.probe) ** 2
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
            f"sensor.pitch_mm = {1e3 * array.pad.pitch_m:g}: at task.force_n = {setup.touch.force:g} the patch covers "
            f"{support.taxels:.1f} taxels of the array {array.name}, and fewer than {PRESS_TAXELS} do not show where "
            "on the probe it presses; raise task.force_n, or take a finer array"
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
