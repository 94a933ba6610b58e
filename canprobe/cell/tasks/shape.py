"""The estimator in the loop: it takes the contacts of a scan, and its answers go to the servo and the log.

It may be a user's: one that is given, or that another package offers.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from canprobe.cell.scene.plugins import Plugin
from canprobe.errors import CanprobeError, UsageError
from canprobe.mechanics.touch.estimate.estimator import Estimator, Steps, at_once

if TYPE_CHECKING:
    from canprobe.mechanics.touch import ContactSample, SurfaceEstimate, SurfaceMap


GAP_S = 0.1
"""Time without contact after which an estimator starts afresh: a contact that is regained may be of another surface."""
SAMPLES_KEPT, RECORDS_KEPT = 40_000, 10_000
"""Contacts that a tracker keeps, the last ones, and answers, evenly over the scan: 200 s and 400 s of a scan with an
array of 200 Hz and an answer every 40 ms. A longer scan takes no more memory, and no more time at its end."""
PATH_STEP_M = 0.2e-3
"""Least step of the path of a contact: the noise of slow and light scans would add up to three times their path."""
MAPPED_AT_ONCE = 16
"""Contacts that the map takes at once, in a step of its own: 0.3 ms, half of what they cost one by one."""
MAX_CURVATURE = 1e3
"""Largest curvature of an answer, 1/m: no pad measures a ball of 1 mm, so an answer beyond it has diverged."""


@dataclass(frozen=True, slots=True)
class ShapeRecord:
    """An estimate with its place in the run.

    Attributes:
        t_s: instant of its last sample, s, since the first SYNC; in results on the run's clock.
        travelled_m: path of the contact since the start of the scan, m.
        estimate: the answer, in the base frame's terms.
        reported_s: instant of the cycle in which it was reported, s, on the same clock.
    """

    t_s: float
    travelled_m: float
    estimate: SurfaceEstimate
    reported_s: float


def on_run_clock(records: Sequence[ShapeRecord], start_s: float) -> list[ShapeRecord]:
    """Estimates of a run in which the first SYNC was due at ``start_s``."""
    return [replace(record, t_s=start_s + record.t_s, reported_s=start_s + record.reported_s) for record in records]


class ShapeTracker:
    """Feeds an estimator with the contacts of a scan and keeps its answers.

    An answer costs as much as a whole cycle and is due once in many. So the work is cut into steps, and a cycle carries
    one. The next contacts wait meanwhile: each answer is what it would be at once. Why not as many steps as there is
    time: in virtual time the same seed must give the same run.

    Args:
        estimator: the online estimator.
        every: samples between two answers.
        surface_map: map that takes the contacts, too; None: none.

    Attributes:
        records: the answers; of more than `RECORDS_KEPT` every second, every fourth and so on.
        samples: the contacts; of more than `SAMPLES_KEPT` the last ones.
        travelled_m: path of the contact without its noise, m; up to a dozen contacts behind, for which it is a mean.
        restarts: how often the estimator diverged and started afresh.
        withheld: answers that could not be computed: of a matrix that is singular or not definite.
        doubted: whether images mean another curvature than the calibration says, so that regions are wider.
    """

    def __init__(self, estimator: Estimator, every: int, surface_map: SurfaceMap | None = None) -> None:
        from canprobe.mechanics.touch.estimate.path_length import PathLength  # only where a shape is asked for

        self.records: list[ShapeRecord] = []
        self.samples: deque[ContactSample] = deque(maxlen=SAMPLES_KEPT)
        self.travelled_m = 0.0
        self.restarts = self.withheld = 0
        self.doubted = False
        self._estimator = estimator
        self._new_path = partial(PathLength, PATH_STEP_M)
        self._path_length = self._new_path()
        self._every = max(1, every)
        self._map = surface_map
        self._waiting: deque[tuple[ContactSample, float]] = deque()  # with the path up to each
        self._unmapped: list[ContactSample] = []
        self._added = self._taken = self._answers = 0
        self._record_stride = 1
        self._found: tuple[SurfaceEstimate, float, float] | None = None
        self._last_withheld = False
        self._steps = self._work()

    def add(self, sample: ContactSample) -> None:
        """Note one contact; `work` takes it."""
        if self.samples and sample.t_s - self.samples[-1].t_s > GAP_S:
            self._estimator.reset()
            self._waiting.clear()
            self._path_length = self._new_path()
            self._taken, self._found, self._steps = self._added, None, self._work()
        self.travelled_m += self._path_length.add(sample.p_base)
        self._added += 1
        self.samples.append(sample)
        self._waiting.append((sample, self.travelled_m))

    def settled(self, radius: float) -> list[ContactSample]:
        """The contacts, placed anew by what is known by now: one stiffness for all, and the curvature at each.

        In the loop a contact's depth follows from the answer before it, so heights carry the errors of answers, and
        bend where the stiffness gets better known. Where no answer knew the stiffness the contacts are as they were.

        Args:
            radius: radius of the probe, m.
        """
        known = [r for r in self.records if r.estimate.rank == 3 and r.estimate.stiffness is not None]
        if not known:
            return list(self.samples)
        from canprobe.mechanics.touch.contact import HOLLOW_LIMIT_SHARE, at_depth, indentation_from_force

        stiffness, least = known[-1].estimate.stiffness, -HOLLOW_LIMIT_SHARE / radius
        assert stiffness is not None
        at_1_n = [indentation_from_force(1.0, stiffness, radius, np.maximum(r.estimate.kappa, least)) for r in known]
        forces = np.array([max(sample.force_n, 0.0) for sample in self.samples])
        depths = np.sqrt(forces) * np.interp([s.t_s for s in self.samples], [r.t_s for r in known], at_1_n)
        return [at_depth(sample, depth, radius) for sample, depth in zip(self.samples, depths.tolist(), strict=True)]

    def work(self) -> SurfaceEstimate | None:
        """Do one step, and more where an answer would be late by another; the estimate that `answer` has to report.

        An answer that cannot be computed is withheld; an estimator that cannot take a contact starts afresh.
        """
        self._step()
        while len(self._waiting) >= self._every:
            self._step()
        return None if self._found is None else self._found[0]

    def _step(self) -> None:
        if next(self._steps, True):  # it has come to its end
            self._steps = self._work()

    def _work(self) -> Steps[None]:
        """The work on the contacts that wait, in steps."""
        while self._waiting:
            sample, travelled = self._waiting.popleft()
            yield from self._take(sample)
            if self._taken % self._every == 0:
                yield
                yield from self._answer_at(sample.t_s, travelled)
                yield
            if len(self._unmapped) >= MAPPED_AT_ONCE:
                self._extend_map()
                yield

    def _take(self, sample: ContactSample) -> Steps[None]:
        self._taken += 1
        try:
            yield from self._estimator.adding(sample)
        except np.linalg.LinAlgError:
            self._start_afresh()
        # numpy's test of three numbers took 1.2 % of a cycle
        if self._map is not None and all(map(math.isfinite, sample.p_base.tolist())):
            self._unmapped.append(sample)

    @property
    def surface_map(self) -> SurfaceMap | None:
        """The map with every contact; all work that waits is done first."""
        self._finish()
        self._extend_map()
        return self._map

    def _finish(self) -> None:
        at_once(self._steps)
        self._steps = self._work()

    def _extend_map(self) -> None:
        if self._map is not None:
            self._map.add_samples(self._unmapped)
        self._unmapped.clear()

    def answer(self, t_s: float) -> SurfaceEstimate | None:
        """The estimate, once, that has been found since it was last asked for.

        Args:
            t_s: instant of the cycle in which it is reported, s.
        """
        if self._found is None:
            return None
        (estimate, at_s, travelled), self._found = self._found, None
        self._answers += 1
        if self._answers % self._record_stride == 0:
            self.records.append(ShapeRecord(at_s, travelled, estimate, t_s))
            if len(self.records) > RECORDS_KEPT:
                self._record_stride *= 2
                del self.records[::2]  # those of the new stride stay: the second, the fourth …
        return estimate

    def answer_at_once(self, t_s: float) -> SurfaceEstimate | None:
        """Do all work that waits; the estimate, if one is due, in the cycle at an instant (s)."""
        self._finish()
        return self.answer(t_s)

    def _answer_at(self, at_s: float, travelled: float) -> Steps[None]:
        """An answer at an instant (s) and path (m); the estimator starts afresh where two in a row fail."""
        try:
            self._keep((yield from self._estimator.answering()), at_s, travelled)
        except np.linalg.LinAlgError:
            self.withheld += 1
            if self._last_withheld:
                self._start_afresh()
            self._last_withheld = not self._last_withheld
        else:
            self._last_withheld = False

    def _keep(self, estimate: SurfaceEstimate | None, at_s: float, travelled: float) -> None:
        """An estimate to be reported; where it has diverged the estimator starts afresh."""
        if estimate is None:
            return
        if has_diverged(estimate):
            self._start_afresh()
            return
        if self.doubted:
            from canprobe.mechanics.touch.online import regions  # only where a shape is asked for

            estimate = regions.scaled(estimate, regions.FOREIGN_ARRAY_FACTOR)
        self._found = estimate, at_s, travelled

    def _start_afresh(self) -> None:
        self.restarts += 1
        self._estimator.reset()


def has_diverged(estimate: SurfaceEstimate) -> bool:
    """Whether an answer is not finite, or sharper than anything that a pad can measure."""
    known = np.asarray(estimate.kappa)[np.asarray(estimate.observed)]
    finite = np.isfinite(known).all() and np.isfinite(estimate.S).all() and np.isfinite(estimate.T_frame_contact).all()
    return not (finite and bool((np.abs(known) < MAX_CURVATURE).all()))


def replay_samples(estimator: Estimator, samples: Sequence[ContactSample], every: int) -> list[ShapeRecord]:
    """Feed recorded contacts to another estimator, as the loop would have."""
    tracker = ShapeTracker(estimator, every)
    for sample in samples:
        tracker.add(sample)
        tracker.answer_at_once(sample.t_s)
    return tracker.records


class OwnEstimator(Protocol):
    """Methods that an estimator of your own needs."""

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""

    def estimate(self) -> SurfaceEstimate | None:
        """The shape at the last contact; None before there is an answer."""


class RenewedEstimator(Estimator):
    """A user's estimator in the loop: a new one is made after each loss of contact; dropped samples are not counted.

    Args:
        make: function that makes the estimator.
    """

    def __init__(self, make: Callable[[], OwnEstimator]) -> None:
        from canprobe.mechanics.touch.estimate.gate import Dropped

        self._make = make
        self.dropped = Dropped()
        self.reset()

    def reset(self) -> None:
        """Make a new one."""
        self._inner = self._make()

    def add(self, sample: ContactSample) -> None:
        self._inner.add(sample)

    def estimate(self) -> SurfaceEstimate | None:
        return self._inner.estimate()


class OfferedEstimator:
    """An estimator of another package, whose errors name it.

    Args:
        plugin: the entry point of a function that takes the settings by name and returns the estimator.
        settings: keyword arguments of that function, those of `make_estimator`.

    Raises:
        SceneError: the package cannot be imported.
        UsageError: the estimator cannot be made.
    """

    def __init__(self, plugin: Plugin, settings: dict[str, Any]) -> None:
        make = plugin.load()
        self._plugin = plugin

        def methods() -> tuple[Callable[[ContactSample], None], Callable[[], SurfaceEstimate | None]]:
            inner = make(**settings)
            return inner.add, inner.estimate

        self._add, self._estimate = self._guarded(methods)

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        self._guarded(lambda: self._add(sample))

    def estimate(self) -> SurfaceEstimate | None:
        """The shape at the last contact; None before there is an answer."""
        answer = self._guarded(self._estimate)
        from canprobe.mechanics.touch.estimate.answer import SurfaceEstimate

        if answer is not None and not isinstance(answer, SurfaceEstimate):
            raise UsageError(f"{self._plugin}: expected a SurfaceEstimate or None from estimate(), got {answer!r:.60}")
        return answer

    def _guarded(self, act: Callable[[], Any]) -> Any:
        try:
            return act()
        except CanprobeError:
            raise
        except Exception as error:  # whatever a foreign package raises; the cell stops for it
            raise UsageError(f"{self._plugin}: {type(error).__name__}: {error}") from error
