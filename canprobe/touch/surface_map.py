"""A whole scan as one surface description: local patches along the contact's path.

Source: Chen, Rink and Zhang, "Local object shape from tactile sensing": an object is described by a set of local
contact frames with their surface matrices.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array, checked, positive, read_only
from canprobe.touch.local_patch import LocalPatch

SPACING_M = 2e-3
"""Path from one patch to the next, m: well below the radius of what can be felt, so that neighbours overlap."""
LEAST_RANK = 1


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class SurfaceMap:
    """Local patches in the order in which they were felt, and the path of the contact.

    Attributes:
        patches: each with its frame, matrix and covariance, by increasing `travelled_m`.
        path: (n, 3) contact points, base frame, m.
        method: estimator that the patches are from.
        points: (m, 3) contact points of the patches, base frame, m.
        normals: (m, 3) outward unit normals there.
        travelled: (m,) path of the contact until each patch, m.
    """

    patches: tuple[LocalPatch, ...]
    path: Array
    method: str = ""
    points: Array = field(init=False, repr=False)
    normals: Array = field(init=False, repr=False)
    travelled: Array = field(init=False, repr=False)

    def __post_init__(self) -> None:
        def keep(name: str, values: ArrayLike) -> None:
            object.__setattr__(self, name, read_only(values))

        keep("path", checked("path", self.path, (None, 3)))
        keep("points", np.array([patch.point for patch in self.patches]).reshape(-1, 3))
        keep("normals", np.array([patch.normal for patch in self.patches]).reshape(-1, 3))
        keep("travelled", [patch.travelled_m for patch in self.patches])
        along = [patch.travelled_m for patch in self.patches]
        for i, (before, after) in enumerate(pairwise(along), start=1):
            if after < before:
                raise UsageError(
                    f"patches[{i}].travelled_m: expected at least {before} of the one before, got {after}; patches"
                    " stand in the order in which they were felt"
                )

    def __len__(self) -> int:
        return len(self.patches)

    def __iter__(self) -> Iterator[LocalPatch]:
        return iter(self.patches)

    @property
    def memory(self) -> float:
        """Longest path that a patch rests on, m; 0 without patches."""
        return max((patch.distance_m for patch in self.patches), default=0.0)

    def thinned(self, spacing: float) -> SurfaceMap:
        """The patches at every `spacing` (m) of path; see `spaced`.

        Raises:
            UsageError: when the spacing is not above 0.
        """
        return replace(self, patches=tuple(spaced(self.patches, spacing)))

    def equals(self, other: SurfaceMap) -> bool:
        """The same patches, path and method, bit by bit."""
        same = len(self) == len(other) and self.method == other.method and np.array_equal(self.path, other.path)
        return same and all(a.equals(b) for a, b in zip(self.patches, other.patches, strict=True))


def spaced(patches: Iterable[LocalPatch], spacing: float) -> list[LocalPatch]:
    """The first patch at or after every multiple of a spacing along the path, from the first patch on.

    A contact that stands still adds none.

    Args:
        patches: by increasing `travelled_m`.
        spacing: m, above 0.
    """
    step = positive("spacing", spacing)
    kept: list[LocalPatch] = []
    last = -1
    start = None
    for patch in patches:
        start = patch.travelled_m if start is None else start
        cell = int((patch.travelled_m - start) / step + 1e-9)
        if cell > last:
            kept.append(patch)
            last = cell
    return kept


def merge_patches(
    patches: Sequence[LocalPatch], path: ArrayLike, *, spacing: float = SPACING_M, method: str = ""
) -> SurfaceMap:
    """One map of a scan from its estimates, a patch every `spacing`, without those that observed no curvature.

    Args:
        patches: of all estimates, in the order of the path.
        path: (n, 3) contact points, base frame, m.
        spacing: m.
        method: name of the estimator.

    Raises:
        UsageError: naming the field, what was expected and what was got.
    """
    usable = [patch for patch in patches if patch.rank >= LEAST_RANK]
    return SurfaceMap(patches=tuple(spaced(usable, spacing)), path=np.asarray(path, np.float64), method=method)
