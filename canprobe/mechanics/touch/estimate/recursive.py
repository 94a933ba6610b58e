"""`recursive`: the nine-parameter model as a square-root information filter, the estimator that runs in the loop.

The work per sample is constant whatever the memory, and no sample costs much more than another. Samples are collected
until the contact has moved on by a step, then added together (`information`). Forgetting is per millimetre travelled.
Why not per second: a contact at rest would lose what it knows, and its noise would count as new. The first stretch,
also after a change of the surface, is solved as a whole (`start`). The covariance is the sandwich of `Score`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from canprobe.errors import UsageError
from canprobe.mechanics.touch.checks import instance, positive
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.touch.estimate.answer import Anchor, Solution, SurfaceEstimate, anchor, build_estimate
from canprobe.mechanics.touch.estimate.change import ChangeTest
from canprobe.mechanics.touch.estimate.estimator import Estimator, Steps
from canprobe.mechanics.touch.estimate.gate import Dropped, Gate, MeasuredContact, slow_errors
from canprobe.mechanics.touch.estimate.information import InformationFilter
from canprobe.mechanics.touch.estimate.misfit import misfit_notes
from canprobe.mechanics.touch.estimate.noise import CHI2_99, CHI2_999, Correlation
from canprobe.mechanics.touch.estimate.nonlinear import DIFFUSE_INFORMATION
from canprobe.mechanics.touch.estimate.observed import curvature_covariance, decide, evidence_of, nothing_observed
from canprobe.mechanics.touch.estimate.omitted_terms import ExpectedMisfit
from canprobe.mechanics.touch.estimate.path_length import PathLength, Spread
from canprobe.mechanics.touch.estimate.prior import Prior
from canprobe.mechanics.touch.estimate.quadric import C_PER_Q, TO_Q_SQUARED, size_of
from canprobe.mechanics.touch.estimate.start import Start
from canprobe.mechanics.touch.linear_algebra import inverted, inverted_upper, lower_root, upper_root
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation
from canprobe.mechanics.types import Floats

UPDATE_TRAVEL_SHARE = 0.025
"""Travel between two updates, over the memory."""
MAX_DENSITY_RATIO = 2.0
"""Largest number of samples per metre that count in full, over the nominal number `window / memory`."""
MAX_PENDING = 16
"""Most samples of one step that are kept; a slower motion keeps the last ones."""
START_ALARM_SCALE = 1.6
"""Factor on the alarm's thresholds during a start, whose first answers soon correct themselves."""
CORRELATED_ALARM_SCALE = 1.75
"""Factor on the alarm's thresholds where errors of neighbours are correlated: running means vary more, and errors that
change as the contact moves over the pad treble the innovation at a turn of a weave. A false alarm costs millimetres of
larger errors. On 69 random scenes 1.4 gives 31 alarms and 1.75 gives 8, with errors 2 % smaller."""

CHANGING_NOTE = "the surface may be changing: nothing is observed"


class _Compared(NamedTuple):
    """Contacts compared with the filter: their equations, squared innovations (n,) and weights (n,)."""

    rows: Floats
    residuals: Floats
    squares: Floats
    weights: Floats


class RecursiveEstimator(Estimator):
    """Square-root information filter over the contact's path.

    Args:
        sigma_point, sigma_normal: effective standard deviations of points and normals, m and rad.
        memory_m: path after which a sample's information has fallen to 1/e, m.
        window: number of samples on one memory at the nominal speed; a slower motion has more, which count as twice
            that at most.
        prior: prior on c13, c23, c33; None for `Prior.weak` over the memory. A prior on curvature is refused, as
            forgetting would wear it away.
        coupling: coupling of the errors of point and normal (`Noise`), 1/m.
        correlation: correlation of the noise along the path. Heights are taken as independent ones of a larger variance
            (`Correlation.height_inflation`), which keeps their balance with the tilts. The tilts are weighed as if they
            were independent; the covariance is what such an answer has under correlated noise.
        quadric: whether the surface is known to be a quadric; otherwise cubic and quartic terms are allowed for
            (`OmittedTerms`).

    Raises:
        UsageError: a value is out of range, or the prior is on curvature.
    """

    def __init__(
        self,
        *,
        sigma_point: float,
        sigma_normal: float,
        memory_m: float = 0.02,
        window: int = 160,
        prior: Prior | None = None,
        coupling: float = 0.0,
        correlation: Correlation | None = None,
        quadric: bool = False,
    ) -> None:
        self._coupling = coupling
        self.dropped = Dropped()
        self._gate = Gate(sigma_point, sigma_normal)
        self._memory = positive("memory_m", memory_m)
        self._quadric = quadric
        self._full_density = MAX_DENSITY_RATIO * positive("window", window) / self._memory
        self._prior = Prior.weak(self._memory) if prior is None else instance("prior", prior, Prior)
        if math.isfinite(self._prior.sigma_curvature):
            raise UsageError("prior: expected none on curvature itself for 'recursive', got " + self._prior.name)
        self._caution = 1.0 if correlation is None else CORRELATED_ALARM_SCALE
        self._taller = 1.0
        if correlation is not None:
            self._taller = math.sqrt(correlation.height_inflation(self._memory / window))
            correlation = replace(correlation, point_share=0.0)
        self._filter = InformationFilter(self._memory, self._prior, correlation)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._gate.reset()
        self._last: MeasuredContact | None = None
        self._pending: deque[MeasuredContact] = deque(maxlen=MAX_PENDING)
        self._path_length = PathLength(max(UPDATE_TRAVEL_SHARE * self._memory, 3.0 * self._gate.sigma_point))
        self._spread = Spread()
        self._change = ChangeTest()
        self._start: Start | None = Start(self._memory, self._prior)
        self._steady = False
        self._doubtful = 0.0

    def adding(self, sample: ContactSample) -> Steps[None]:
        if not self._gate.passes(sample, self.dropped):
            return
        touch = self._gate.measured(sample, self._coupling)
        moved = self._path_length.add(sample.p_base)
        touch = touch._replace(sigma_height=self._taller * touch.sigma_height, weight=self._path_length.weight)
        self._pending.append(touch)
        if self._last is None or touch.weight == 1.0:
            self._last = touch
        if moved > 0.0:
            yield
            yield from self._step(moved)
            self._pending.clear()

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the foot of the last contact that is no outlier; None before the contact has moved."""
        if self._last is None or self._spread.weight == 0.0:
            return None
        state, notes = self._filter, self._notes()
        place = state.place(self._last.point)
        a = anchor(state.c, state.T, place, state.length)
        flat = self._flat(a)
        q = a.M[6:].dot(state.inverse) / C_PER_Q[:, None]
        changing = self._change.changing
        decision = nothing_observed() if changing else decide(inverted_upper(upper_root(q.T)).T, flat, size_of(a.c))
        # the sandwich: A⁻¹ = inverse inverseᵀ, the score between
        noise = state.inverse.T.dot(state.omitted.score.matrix[:9, :9]).dot(state.inverse)
        believed = True
        if decision.rank > 0 and not self._quadric:
            observed = decision.turned(-a.turn).vectors[:, decision.passed]
            H = state.inverse.dot(state.inverse.T)
            amended = state.omitted.amend(state.c, H, place, self._expected(), observed)
            believed = amended.average.trusted
            notes += misfit_notes(amended.average.misfit, trusted=believed)
            if believed:
                before, a = a, anchor(state.c + amended.average.shift, state.T, place, state.length)
                flat, decision = self._flat(a), decision.turned(a.turn - before.turn)
                noise += state.root.dot(amended.covariance).dot(state.root.T)
            else:
                decision = nothing_observed()
        deviation = a.M.dot(state.inverse.dot(lower_root(noise)) if believed else np.eye(9) / DIFFUSE_INFORMATION)
        covariance = curvature_covariance(a.c, deviation)
        evidence = evidence_of(a.c, covariance, flat, state.length)
        if decision.rank < 3:
            decision = decision.with_covariance(TO_Q_SQUARED * covariance)
            # the filter itself holds nothing; its answer is held at the value nearest to flat, as by `solve_rows`
            known = decision.vectors[:, decision.passed]
            a.c[6:] = C_PER_Q * (known @ (known.T @ (a.c[6:] / C_PER_Q)))
            covariance = np.full((3, 3), math.nan)
        return build_estimate(
            Solution(a.c, covariance, decision, has_prior=False, root=inverted(deviation)),
            length=state.length,
            T_frame_contact=a.T_frame_contact,
            problem_root=state.root,
            innovation=self._change.innovation,
            distance=min(self._path_length.total, self._memory),
            samples=self._spread.weight,
            method="recursive",
            prior=self._prior.name,
            notes=notes,
            evidence=None if changing else evidence,  # else a patch would complete it
        )

    def _flat(self, a: Anchor) -> Floats:
        """(2, 2) covariance of the samples in the tangent plane of an answer, over the variance of their noise."""
        # it is 0 for a start that is not steady, so that nothing counts as observed
        P = a.T_frame_contact[:3, :2]
        certain = float(self._steady) / self._gate.sigma_point**2
        flat: Floats = P.T.dot(self._spread.covariance * certain).dot(P)
        return flat

    def _expected(self) -> ExpectedMisfit:
        """Surfaces are taken to be as curved as the probe."""
        # why not less noise where innovations are small: a pad that hardly moves has small errors from contact to
        # contact, and yet ones that last for millimetres and look like cubic terms
        return ExpectedMisfit(self._coupling * self._memory, self._gate.sigma_point / self._memory)

    def _notes(self) -> tuple[str, ...]:
        changes, doubtful = self._change.alarms, round(self._doubtful)
        notes = [f"the surface changed {changes} times: memory shortened"] if changes else []
        notes += [f"{doubtful} samples with reduced weight"] if doubtful else []
        return (*notes, *self._gate.notes(), *((CHANGING_NOTE,) if self._change.changing else ()))

    def _step(self, moved: float) -> Steps[None]:
        """Add the pending samples to the filter or its start; after a change of the surface, to a new start."""
        compared = self._compared() if self._steady else None
        caution = self._caution if self._start is None else START_ALARM_SCALE * self._caution
        # a list and no generator: the test must take the contacts behind the one that raises the alarm, too
        if compared and any([self._change.take(square, caution) for square in compared.squares.tolist()]):
            explained = self._explained(compared)
            if explained is None:
                self._change.alarm()
                # pending samples up to the last that agrees with the old surface belong to that
                agree = np.flatnonzero(compared.squares[:-1] <= CHI2_99 * self._change.usual)
                for _ in range(int(agree[-1]) + 1 if len(agree) else 0):
                    self._pending.popleft()
                self._begin_again()
            else:
                compared = explained
        if self._start is not None:
            yield from self._beginning(self._start, moved)
        elif compared:
            slow = slow_errors(self._pending)
            root = np.sqrt(self._weigh(moved, compared.weights) * compared.weights)[:, None]
            self._filter.take(compared.rows * root[:, :, None], compared.residuals * root, moved, slow)
            if self._last is not None:
                self._filter.follow(self._last.point)
                if self._filter.T[:3, 2].dot(self._last.normal) > 0.0:
                    self._change.alarm()
                    self._begin_again()

    def _begin_again(self) -> None:
        """Forget the surface: it has changed, or the model has turned over."""
        # On a straight path gradients that grow along it change neither the surface below it nor its normals. Where
        # they pass zero the quadric's other side is up, and its normal points the wrong way.
        self._spread.fade(0.0)
        self._start, self._steady = Start(self._memory, self._prior), False

    def _compared(self) -> _Compared:
        rows, residuals = self._filter.equations(self._pending)
        return self._judged(rows, residuals, residuals)

    def _explained(self, found: _Compared) -> _Compared | None:
        """As `_compared`, where the terms that a quadric leaves out explain the contacts; else None."""
        if self._quadric:
            return None
        f = self._filter
        likely = f.omitted.amend(f.c, f.inverse.dot(f.inverse.T), (0.0, 0.0, 0.0), self._expected(), np.eye(3))
        explained = found.rows @ np.concatenate([likely.average.shift, likely.terms])
        left = self._judged(found.rows, found.residuals, found.residuals - explained)
        return left if self._change.usual_again(left.squares) else None

    def _judged(self, rows: Floats, residuals: Floats, unexplained: Floats) -> _Compared:
        """Contacts weighted by their places and, beyond a limit of the squared innovation d², by `(limit / d²)²`."""
        # the limit is the 99.9 % point of χ² times the running innovation: where all samples disagree, none is wrong
        squares = self._filter.squared_innovations(rows, unexplained)
        limit = CHI2_999 * max(1.0, self._change.innovation)
        weights = np.array([touch.weight for touch in self._pending]) * np.square(limit / np.maximum(squares, limit))
        return _Compared(rows, residuals, squares, weights)

    def _beginning(self, start: Start, moved: float) -> Steps[None]:
        """Add a step (m) to the solution of the first stretch, and give the filter the solution so far."""
        wider = 1.0 / math.sqrt(self._weigh(moved, np.ones(len(self._pending))))
        yield from start.adding([touch.widened(wider) for touch in self._pending], moved)
        self._steady = start.steady
        found = start.solution
        if found is None:
            last = self._pending[-1]
            self._filter.begin(homogeneous(tangent_rotation(-last.normal), last.point))
            return
        # the target of a step that is not small is a place where nobody has looked yet (`gauss_newton`)
        c = found.target if start.steady else found.c
        self._filter.adopt(start.T, c, found.root, found.rows, found.residuals_at(c), start.travelled, start.slow)
        self._doubtful = float(np.count_nonzero(found.weight < 1.0))
        if start.over:
            self._start, self._steady = None, True

    def _weigh(self, moved: float, weight: Floats) -> float:
        """Count a step (m) with the samples' weights (n,); returns the weight of each for their density, at most 1."""
        # contacts before the first mean have no measured path: at pace the first step would look crowded by them
        thinned = min(1.0, self._full_density * moved / min(len(weight), self._path_length.measured))
        kept = math.exp(-moved / self._memory)
        self._doubtful = kept * self._doubtful + np.count_nonzero(weight < 1.0)
        self._spread.fade(kept)
        self._spread.add(np.array([touch.point for touch in self._pending]), thinned * weight)
        return thinned
