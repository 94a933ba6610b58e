"""Places that a whole arm keeps out of: a floor and boxes, against spheres round its links.

A link whose collision solids the URDF has is in spheres of its own (`link_spheres`). Any other is the straight line
from the axis of its joint to that of the next, as thick as a radius. What moves with the second joint and beyond is
looked at, as the base and the column on it stand where they stand; and what the flange carries, a line to the probe.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from canprobe.mechanics.robot.chain import Chain, link_frames
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class KeepOut:
    """A floor and boxes.

    Attributes:
        floor: height of the floor in base, m; minus infinity without one.
        boxes: lowest and highest corner of each box in base (m, 2, 3), m.
        link_radius: radius of the links that have no spheres, m.
        probe: (3,) centre of the probe in the flange frame, m.
        probe_radius: radius of the probe round it, m.
        spheres: (m, 5) spheres round the other links, as `link_spheres` gives them.
    """

    floor: float
    boxes: Floats
    link_radius: float
    probe: Floats
    probe_radius: float
    spheres: Floats = field(default_factory=lambda: np.zeros((0, 5)))

    def touched(self, chain: Chain, q: Floats) -> str | None:
        """What the arm touches, and which part of it goes deepest, in words; None where it touches nothing.

        Args:
            chain: the arm.
            q: (n,) joint positions, rad or m.
        """
        T = link_frames(chain, q)
        probe = T[-1, :3, :3] @ self.probe + T[-1, :3, 3]
        points, lines = _along(np.vstack([T[1:, :3, 3], probe]), 0.5 * self.link_radius)
        parts, links = lines + 2, self.spheres[:, 0].astype(int)  # numbers of joints; the line to the probe is one more
        bare = ~np.isin(parts, links)
        centres = np.einsum("mij,mj->mi", T[links, :3, :3], self.spheres[:, 1:4]) + T[links, :3, 3]
        points = np.vstack([points[bare], centres, probe])
        parts = np.concatenate([parts[bare], links, [chain.n + 2]])
        radii = np.concatenate([np.full(bare.sum(), self.link_radius), self.spheres[:, 4], [self.probe_radius]])

        def deepest(distances: Floats) -> str:
            part = parts[k := distances.argmin()]
            name = {1: "what the flange carries", 2: "the probe"}.get(part - chain.n, f"the link of joint {part}")
            return f"{name} comes to {1e3 * distances[k]:.0f} mm"

        heights = points[:, 2] - radii
        if heights.min() < self.floor:
            return f"{deepest(heights)}, the floor is at {1e3 * self.floor:.0f} mm"
        for number, (lowest, highest) in enumerate(self.boxes, start=1):
            away = np.maximum(np.maximum(lowest - points, points - highest), 0.0)
            if (distances := np.linalg.norm(away, axis=1) - radii).min() < 0.0:
                return f"{deepest(distances)} from box {number} of keep_out.boxes_mm"
        return None


def _along(corners: Floats, spacing: float) -> tuple[Floats, npt.NDArray[np.int_]]:
    """Points (m, 3) along the lines between corners (k, 3), no further apart than a spacing, m; and their lines."""
    ways = np.diff(corners, axis=0)
    counts = np.ceil(np.linalg.norm(ways, axis=1) / max(spacing, 1e-3)).astype(int) + 1
    shares = (np.linspace(0.0, 1.0, n)[:, None] for n in counts)
    points = np.vstack([start + share * way for start, share, way in zip(corners[:-1], shares, ways, strict=True)])
    return points, np.repeat(np.arange(len(counts)), counts)
