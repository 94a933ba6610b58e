"""One estimator for the loop: contacts go into the motion and the stages, and each stage refines the answer."""

from __future__ import annotations

import numpy as np

from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate
from canprobe.mechanics.touch.estimate.estimator import Estimator, Steps
from canprobe.mechanics.types import Floats


class AnswerStage:
    """One stage of the way of an answer.

    Attributes:
        is_step: whether its work is a step by itself; else it is a part of the step before it.
    """

    is_step = False

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


class OnlineEstimator(Estimator):
    """An estimator of the motion with stages that refine its answers, in order.

    Args:
        motion: estimator from points and normals.
        stages: the stages.
    """

    def __init__(self, motion: Estimator, *stages: AnswerStage) -> None:
        self.dropped = motion.dropped
        self._motion = motion
        self._stages = stages
        self._last: ContactSample | None = None

    def adding(self, sample: ContactSample) -> Steps[None]:
        before = self.dropped.total
        yield from self._motion.adding(sample)
        if self.dropped.total == before:
            self._last = sample
            for stage in self._stages:
                stage.take(sample)

    def answering(self) -> Steps[SurfaceEstimate | None]:
        if self._last is None:
            return None
        answer = yield from self._motion.answering()
        for stage in self._stages:
            if stage.is_step:
                yield
            answer = stage.refine(answer, self._last)
        return answer

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._last = None
        self._motion.reset()
        for stage in self._stages:
            stage.reset()
