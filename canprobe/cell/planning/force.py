"""The standard deviation of the force that a task will measure, and the limit that its upper end must keep.

The cell stops a touch when the upper end of the measured force is above the limit. So a task must leave room for it: at
its first touch, when creep is not yet what it was in the calibration, and at its end, when it is more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from canprobe.cell.scene.setup import Array, Calibrate, Probe, Setup, Touch
from canprobe.errors import at_least, at_most
from canprobe.mechanics.touch.image.force_creep import decades_after, late_decades_after
from canprobe.mechanics.touch.image.force_errors import UPPER_SIGMAS, ForceSigma, upper_end
from canprobe.mechanics.touch.stops import depth_on_plane

_ROUNDS = 5


def force_sigma_of(array: Array, probe: Probe, force: float, seconds: float) -> ForceSigma:
    """Standard deviation of a force that is measured some time after the touch, on a plane.

    Args:
        array: the array, with its calibration.
        probe: the probe that carries it.
        force: force, N.
        seconds: time since the touch, s.
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
