"""An estimator of motion with the contact patch as its second sensor."""

from __future__ import annotations

from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate import SurfaceEstimate
from canprobe.touch.estimators.base import Adding, Answering, Dropped, Estimator, adding, answering, whole
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
        whole(self.adding(sample))

    def adding(self, sample: ContactSample) -> Adding:
        """The same in the parts of the motion."""
        before = self._motion.dropped.total
        yield from adding(self._motion, sample)
        if self._motion.dropped.total == before:
            self._last = sample
            self.patch.add(sample)

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact, or None before there is any."""
        return whole(self.answering())

    def answering(self) -> Answering:
        """The same in parts: those of the motion, what the patch says, and both together."""
        patch = self.patch.still()
        motion = yield from answering(self._motion)
        if motion is None:
            return None if self._last is None else patch_estimate(self._last, self.patch, self._length)
        if motion.evidence is None:
            return motion
        yield
        found = patch.fuse(motion.T_frame_contact, motion.evidence)
        self.patch.begin_at(patch)
        if found is None:
            return motion
        yield
        return with_patch(motion, found, self._length)

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._motion.reset()
        self.patch.reset()
        self._last = None
