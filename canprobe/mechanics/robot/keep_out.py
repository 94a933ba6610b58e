"""Places that a whole arm keeps out of: a floor and boxes, against spheres along its links.

A link is the straight line from the axis of one joint to that of the next, as thick as a radius; what moves with the
second joint and beyond is looked at, as the base and the column on it stand where they stand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from canprobe.mechanics.robot.chain import Chain, posture
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class KeepOut:
    """A floor and boxes.

    Attributes:
        floor: height of the floor in base, m; minus infinity without one.
        boxes: lowest and highest corner of each box in base (m, 2, 3), m.
        link_radius: radius of the links, m.
        probe: (3,) centre of the probe in the flange frame, m.
        probe_radius: radius of the probe round it, m.
    """

    floor: float
    boxes: Floats
    link_radius: float
    probe: Floats
    probe_radius: float

    def touched(self, chain: Chain, q: Floats) -> str | None:
        """What the arm touches, in words; None where it touches nothing.

        Args:
            chain: the arm.
            q: (n,) joint positions, rad or m.
        """
        at = posture(chain, q)
        R = np.array([at.x, at.y, at.z]).T
        corners = np.array([*at.origins[1:], at.flange])
        centre = corners[-1] + R @ self.probe
        for name, points, radius in (
            ("the arm", _along(np.vstack([corners, centre]), 0.5 * self.link_radius), self.link_radius),
            ("the probe", centre[None], self.probe_radius),
        ):
            if (low := points[:, 2].min() - radius) < self.floor:
                return f"{name} comes to {1e3 * low:.0f} mm, the floor is at {1e3 * self.floor:.0f} mm"
            for number, (lowest, highest) in enumerate(self.boxes, start=1):
                away = np.maximum(np.maximum(lowest - points, points - highest), 0.0)
                if (distance := float(np.linalg.norm(away, axis=1).min())) < radius:
                    return f"{name} comes to {1e3 * (distance - radius):.0f} mm from box {number} of keep_out.boxes_mm"
        return None


def _along(corners: Floats, spacing: float) -> Floats:
    """Points (m, 3) along the lines between corners (k, 3), no further apart than a spacing, m."""
    ways = np.diff(corners, axis=0)
    counts = np.ceil(np.linalg.norm(ways, axis=1) / max(spacing, 1e-3)).astype(int) + 1
    shares = (np.linspace(0.0, 1.0, n)[:, None] for n in counts)
    return np.vstack([start + share * way for start, share, way in zip(corners[:-1], shares, ways, strict=True)])
