"""An estimator of motion with the contact patch as its second sensor."""

from __future__ import annotations

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.online import Dropped, Estimator
from canprobe.mechanics.touch.patch.curvature import PatchCurvature
from canprobe.mechanics.touch.patch.fused_answer import WITHDRAWAL_SHARE, patch_estimate, with_patch
from canprobe.mechanics.types import Floats


class PatchedEstimator:
    """An estimator with answers that the patch completes (`with_patch`); before the contact moves, the patch's alone.

    Args:
        motion: estimator from points and normals.
        patch: estimator from images.
        length: memory of `motion`, m.
    """

    def __init__(self, motion: Estimator, patch: PatchCurvature, length: float) -> None:
        self.patch = patch
        self._motion = motion
        self._length = length
        self._last: ContactSample | None = None
        self._place: Floats | None = None
        self._contradicted = 0.0

    @property
    def dropped(self) -> Dropped:
        """Samples that neither sensor used, by reason."""
        return self._motion.dropped

    def add(self, sample: ContactSample) -> None:
        """Take one contact with its moments."""
        before = self._motion.dropped.total
        self._motion.add(sample)
        if self._motion.dropped.total == before:
            self._last = sample
            self.patch.add(sample)

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact, or None before there is any."""
        motion = self._motion.estimate()
        if motion is None:
            return None if self._last is None else patch_estimate(self._last, self.patch, self._length)
        if motion.evidence is None:
            return motion
        found = self.patch.fuse(motion.T_frame_contact, motion.evidence)
        if found is None or not found.contradicted:
            self._contradicted = 0.0
        elif self._place is not None:
            self._contradicted += float(np.linalg.norm(motion.point - self._place))
        self._place = motion.point
        if found is None:
            return motion
        return with_patch(motion, found, self._length, withdrawn=self._contradicted > WITHDRAWAL_SHARE * self._length)

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._motion.reset()
        self.patch.reset()
        self._last = self._place = None
        self._contradicted = 0.0
