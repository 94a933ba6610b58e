"""Search for a lost contact: the probe stops along its path and goes on towards the object, slowly and not far."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from canprobe.cell.tasks.task import Loss
from canprobe.mechanics.touch.servo import ProbePose
from canprobe.mechanics.types import Floats

SEARCH_SPEED = 2e-3
"""Speed of the search, m/s: until the first sample of the new touch takes effect, 27 ms, the layer sinks in 0.05 mm."""
BRAKE_S = 0.02
"""Time constant with which the motion along the path ends: 0.5 mm at 25 mm/s."""
REST_S = 0.25
"""Time at rest on the surface that was found, until the wanted force is reached and the scan goes on."""


class Search:
    """The probe's motion from a lost contact to the object, along its pole.

    Args:
        pose: pose of the probe where the contact was lost.
        velocity: velocity of its centre then (3,), m/s; its part along the path fades out.
    """

    def __init__(self, pose: ProbePose, velocity: Floats) -> None:
        self._start = pose
        self._sideways = velocity - pose.pole * float(velocity @ pose.pole)

    def pose(self, t: float) -> ProbePose:
        """Pose ``t`` seconds after the loss."""
        sideways = self._sideways * (BRAKE_S * (1.0 - math.exp(-t / BRAKE_S)))
        return ProbePose(self._start.centre + sideways + self._start.pole * (SEARCH_SPEED * t), self._start.pole)

    def searched(self, t: float) -> float:
        """Distance towards the object that was searched by then, m."""
        return SEARCH_SPEED * t


def summarise_losses(losses: Sequence[Loss]) -> list[dict[str, float | None]]:
    """Each loss for `summary.json`: `searched_mm`, and `regained_after_ms`, None where it was not."""
    return [
        {
            "searched_mm": 1e3 * loss.searched,
            "regained_after_ms": None if loss.regained_s is None else 1e3 * loss.regained_s,
        }
        for loss in losses
    ]


def losses_text(losses: Sequence[Mapping[str, float | None]]) -> str:
    """The losses of contact in a scan in words: how many, and whether each was regained."""
    told = ", ".join(
        f"not regained within {loss['searched_mm']:.1f} mm"
        if loss["regained_after_ms"] is None
        else f"regained after {loss['regained_after_ms']:.0f} ms and {loss['searched_mm']:.1f} mm"
        for loss in losses
    )
    return f"contact lost {len(losses)} time{'s' * (len(losses) > 1)}: {told}"
