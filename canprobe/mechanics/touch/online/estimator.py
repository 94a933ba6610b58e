"""One estimator for the loop: contacts go into the motion and the stages, and each stage refines the answer."""

from __future__ import annotations

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.gate import Dropped, Estimator
from canprobe.mechanics.types import Floats


class AnswerStage:
    """One step of the way of an answer."""

    def take(self, sample: ContactSample) -> None:
        """Take a contact that the motion has used."""

    def refine(self, answer: SurfaceEstimate | None, sample: ContactSample) -> SurfaceEstimate | None:
        """The answer at the last contact with what this stage knows.

        Args:
            answer: the answer of the stages before; None where they have none yet.
            sample: the last contact that was taken.
        """
        raise NotImplementedError

    def reset(self) -> None:
        """Forget everything but the settings."""


class AnswerPath:
    """Distances from answer to answer, for stages that work along the path."""

    def __init__(self) -> None:
        self._place: Floats | None = None

    def step(self, answer: SurfaceEstimate) -> float:
        """Distance of an answer from the one before, m; 0 for the first."""
        before, self._place = self._place, answer.point
        return 0.0 if before is None else float(np.linalg.norm(answer.point - before))


class OnlineEstimator:
    """An estimator of the motion with stages that refine its answers, in order.

    Args:
        motion: estimator from points and normals.
        stages: the stages.
    """

    def __init__(self, motion: Estimator, *stages: AnswerStage) -> None:
        self._motion = motion
        self._stages = stages
        self._last: ContactSample | None = None

    @property
    def dropped(self) -> Dropped:
        """Samples that were not used, by reason."""
        return self._motion.dropped

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        before = self._motion.dropped.total
        self._motion.add(sample)
        if self._motion.dropped.total == before:
            self._last = sample
            for stage in self._stages:
                stage.take(sample)

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact, or None before there is any."""
        if self._last is None:
            return None
        answer = self._motion.estimate()
        for stage in self._stages:
            answer = stage.refine(answer, self._last)
        return answer

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._last = None
        self._motion.reset()
        for stage in self._stages:
            stage.reset()
