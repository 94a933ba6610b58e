"""An estimator of motion with the contact patch as its second sensor."""

from __future__ import annotations

from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.estimators.base import Dropped, Estimator
from canprobe.touch.patch_curvature import PatchCurvature
from canprobe.touch.patch_fusion import patch_estimate, with_patch


class PatchedEstimator:
    """Any estimator, its answers completed by the patch (`patch_fusion`); before the contact moves, the patch alone.

    Args:
        motion: the estimator of points and normals.
        patch: the images.
        length: memory of `motion`, m.
    """

    def __init__(self, motion: Estimator, patch: PatchCurvature, length: float) -> None:
        self.patch = patch
        self._motion = motion
        self._length = length
        self._last: ContactSample | None = None

    @property
    def dropped(self) -> Dropped:
        """Samples that were not used, by neither sensor."""
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
        return motion if found is None else with_patch(motion, found, self._length)

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._motion.reset()
        self.patch.reset()
        self._last = None
