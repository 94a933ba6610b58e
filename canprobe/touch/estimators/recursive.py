"""`recursive`: the nine-parameter model as a square-root information filter; what runs in the 200 Hz loop.

Constant work per sample whatever the memory. Samples are collected until the contact has moved on by a step, then
taken in together: one QR of the forgotten root, the new whitened rows and what the prior has lost. Forgetting is per
millimetre travelled, never per second; a contact that does not move adds nothing and forgets nothing. The information
is carried along from contact frame to contact frame by `S' = Tᵀ S T`. The covariance is the sandwich of `score`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array, inverted, positive, solved, upper_root
from canprobe.touch.anchor import Anchor, anchor, foot
from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.estimators.base import Dropped, Gate
from canprobe.touch.estimators.change import ChangeTest
from canprobe.touch.estimators.score import Score
from canprobe.touch.estimators.travel import Spread, Travel
from canprobe.touch.frames import homogeneous, tangent_rotation, transported_rotation
from canprobe.touch.noise import Correlation, Noise
from canprobe.touch.nonlinear import CHI2_999, fit, robust
from canprobe.touch.prior import Prior
from canprobe.touch.quadric import UNIT, Design, curvature_jacobian, design, rows, transport
from canprobe.touch.quadric_row import sample_rows
from canprobe.touch.rank import SPREAD, Decision, decide, spread_of

DIFFUSE = 1e-2
"""Root of the information, in units of the memory, that keeps an untouched filter regular: K known to ±200/memory."""
STEP = 0.025
"""Travel between two updates over the memory."""
ANCHOR = 0.05
"""Travel between two changes of the working frame over the memory."""
CROWD = 2.0
"""Most samples per metre that count in full, over the nominal `window / memory`."""
START = (0.1, 0.4)
"""Travel over the memory at the first and last batch solution of the start; it doubles from one to the next."""
GROWTH = 1.4
START_SAMPLES = 128

AGREEING = 11.34
"""Squared innovation, over the usual, up to which a sample may lie on the surface before a change: 99 % of χ² of 3."""


class _Pending(NamedTuple):
    point: Array
    normal: Array
    sigma_point: float
    sigma_normal: float


class RecursiveEstimator:
    """Square-root information filter over the contact's path.

    Args:
        sigma_point, sigma_normal: effective noise, m and rad.
        memory_m: path after which a sample's information has fallen to 1/e, m.
        window: samples per memory at the nominal pace; slower motion is not believed more than twice that.
        prior: None for `Prior.weak` over the memory; none on curvature itself, which forgetting would wear away.
        correlation: of the noise along the path. The samples are weighed as if they were independent, the covariance
            is what such an answer has under correlated noise.
    """

    def __init__(
        self,
        *,
        sigma_point: float,
        sigma_normal: float,
        memory_m: float = 0.02,
        window: int = 160,
        prior: Prior | None = None,
        correlation: Correlation | None = None,
    ) -> None:
        self.dropped = Dropped()
        self._gate = Gate(sigma_point, sigma_normal)
        self._memory = positive("memory_m", memory_m)
        self._crowd = CROWD * positive("window", window) / memory_m
        self._prior = Prior.weak(memory_m) if prior is None else prior
        if math.isfinite(self._prior.sigma_curvature):
            raise UsageError("prior: expected none on curvature itself for 'recursive', got " + self._prior.name)
        self._prior_rows = self._make_prior_rows()
        self._score = Score(self._prior_rows.T @ self._prior_rows, correlation)
        self.reset()

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._gate.reset()
        self._last: ContactSample | None = None
        self._pending: deque[_Pending] = deque(maxlen=16)
        self._travel = Travel(max(STEP * self._memory, 3.0 * self._gate.sigma_point))
        self._spread = Spread()
        self._change = ChangeTest()
        self._doubtful = 0.0

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        if not self._gate.passes(sample, self.dropped):
            return
        self._pending.append(_Pending(sample.p_base, sample.n_base, *self._gate.sigmas(sample)))
        if self._last is None:
            self._begin(self._pending[-1])
        self._last = sample
        moved = self._travel.add(sample.p_base)
        if moved > 0.0:
            crowd = self._absorb(moved)
            if self._next_start < math.inf:
                self._start_up(1.0 / math.sqrt(crowd))
            self._pending.clear()

    def estimate(self) -> SurfaceEstimate | None:
        """The answer at the last contact; None before the contact has moved."""
        if self._last is None or self._spread.weight == 0.0:
            return None
        L, R = self._memory, self._T[:3, :3]
        a = anchor(self._c, self._T, R.T @ (self._last.p_base - self._T[:3, 3]) / L, L)
        tangent = a.T_frame_contact[:3, :2]
        # what only the linear start says is not called observed
        spread = tangent.T @ self._spread.covariance @ tangent * (float(self._settled) / self._gate.sigma_point**2)
        size = 2.0 * math.sqrt(a.c[6] ** 2 + 2.0 * a.c[7] ** 2 + a.c[8] ** 2)
        q = a.M[6:] @ self._inverse / UNIT[:, None]
        decision = decide(inverted(upper_root(q.T)).T, spread, size)
        known = decision.vectors[:, decision.passed]
        a.c[6:] = UNIT * (known @ (known.T @ (a.c[6:] / UNIT)))
        singular = np.linalg.svd(self._root, compute_uv=False)
        return build_estimate(
            self._solution(a, decision),
            length=L,
            T_frame_contact=a.T_frame_contact,
            condition_number=float(singular[0] / singular[-1]),
            innovation=self._change.innovation,
            distance=min(self._travel.total, L),
            samples=self._spread.weight,
            method="recursive",
            prior=self._prior.name,
            notes=self._notes(),
        )

    def _solution(self, a: Anchor, decision: Decision) -> Solution:
        root = solved(a.M.T, self._root.T).T
        if decision.rank < 3:
            return Solution(a.c, np.full((3, 3), math.nan), decision, has_prior=False, root=root)
        noise = self._inverse.T @ self._score.matrix @ self._inverse
        D = curvature_jacobian(a.c) @ a.M @ self._inverse
        sandwich = solved(np.asarray(np.linalg.cholesky(noise), dtype=np.float64), root)
        return Solution(a.c, D @ noise @ D.T, decision, has_prior=False, root=sandwich)

    def _notes(self) -> tuple[str, ...]:
        changes, doubtful = self._change.alarms, round(self._doubtful)
        notes = (f"the surface changed {changes} times: memory shortened",) if changes else ()
        return (*notes, f"{doubtful} samples with reduced weight") if doubtful else notes

    def _make_prior_rows(self) -> Array:
        A, _ = self._prior.rows(self._memory)
        own = DIFFUSE * np.eye(9)
        own[3:6] = A[:3]
        return own

    def _begin(self, sample: _Pending) -> None:
        """Start from nothing at a sample."""
        self._T = homogeneous(tangent_rotation(-sample.normal), sample.point)
        self._c = np.zeros(9)
        self._set_root(self._prior_rows)
        self._score.reset()
        self._start: list[_Pending] = []
        self._started = self._travel.total
        self._next_start = START[0] * self._memory
        self._settled = False

    def _set_root(self, root: Array) -> None:
        self._root, self._inverse = root, inverted(root)

    def _absorb(self, moved: float) -> float:
        """Take in what is pending; the weight of each sample where they are crowded, else 1."""
        kept = math.exp(-moved / self._memory)
        block = self._rows_of_pending()
        weight = np.ones(len(self._pending))
        if self._settled:
            d2 = _innovations(block, self._inverse * (1.0 / math.sqrt(kept)))
            weight = CHI2_999 / np.maximum(d2, CHI2_999)  # falls with the square: the further off, the less it pulls
            if self._change.take(d2):
                self._drop_agreeing(d2)
                self._begin(self._pending[-1])
                block, weight, kept = self._rows_of_pending(), np.ones(len(self._pending)), 0.0
        crowd = min(1.0, self._crowd * moved / len(self._pending))
        self._doubtful = math.exp(-moved / self._memory) * self._doubtful + np.count_nonzero(weight < 1.0)
        self._spread.fade(kept)
        self._spread.add(np.array([s.point for s in self._pending]), crowd * weight)
        self._update(kept, block * np.sqrt(crowd * weight).repeat(3)[:, None], moved)
        return crowd

    def _update(self, kept: float, block: Array, moved: float) -> None:
        """One QR of the forgotten root, what the prior has lost, and new rows (m, 10)."""
        lost = math.sqrt(1.0 - kept) * self._prior_rows
        stacked = np.empty((18 + len(block), 10))
        stacked[:9, :9], stacked[:9, 9] = math.sqrt(kept) * self._root, 0.0
        stacked[9:18, :9], stacked[9:18, 9] = lost, -(lost @ self._c)
        stacked[18:] = block
        full = upper_root(stacked)
        self._set_root(full[:9, :9])
        self._c = self._c + self._inverse @ full[:9, 9]
        self._score.take(block[:, :9], moved, kept)
        if self._settled:
            self._move_frame()

    def _drop_agreeing(self, d2: Array) -> None:
        """Forget the pending samples up to the last that still agrees with the surface before a change."""
        agree = np.flatnonzero(d2[:-1] <= AGREEING * self._change.usual)
        for _ in range(int(agree[-1]) + 1 if len(agree) else 0):
            self._pending.popleft()

    def _start_up(self, wider: float) -> None:
        """Solve the first samples again as a batch: until then the filter is linear, as if |∇f| were 1 everywhere."""
        self._start += [
            s._replace(sigma_point=wider * s.sigma_point, sigma_normal=wider * s.sigma_normal) for s in self._pending
        ]
        if len(self._start) > START_SAMPLES:
            self._start = self._start[::2]
        travelled = self._travel.total - self._started
        if travelled < self._next_start:
            return
        last = travelled >= START[1] * self._memory
        T = homogeneous(tangent_rotation(-self._start[-1].normal), self._start[-1].point)
        d = self._design(T, self._start)
        if not last and float(np.linalg.eigvalsh(spread_of(d.X, d.point_variance))[0]) < SPREAD:
            return
        self._next_start = travelled * GROWTH
        fitted = fit(d, self._prior.rows(self._memory))
        if fitted.converged and (last or fitted.decision.rank == 3):
            self._T, self._c = T, fitted.c
            self._set_root(upper_root(np.concatenate([fitted.root, DIFFUSE * np.eye(9)])))
            self._score.start(self._root, _weighted_rows(fitted.c, d), travelled)
            self._settled = True
        if last:
            self._next_start, self._start, self._settled = math.inf, [], True

    def _design(self, T: Array, samples: list[_Pending]) -> Design:
        L, R = self._memory, T[:3, :3]
        points = (np.array([s.point for s in samples]) - T[:3, 3]) @ R / L
        normals = np.array([s.normal for s in samples]) @ R
        noise = Noise(np.array([s.sigma_point for s in samples]) / L, np.array([s.sigma_normal for s in samples]))
        return design(points, normals, noise)

    def _rows_of_pending(self) -> Array:
        """(3n, 10): whitened Jacobian and minus residual; until the filter has settled, linearised on a plane."""
        R, origin, L = self._T[:3, :3], self._T[:3, 3], self._memory
        c = self._c.tolist() if self._settled else [0.0] * 9
        normals = np.array([s.normal for s in self._pending]) @ R
        x = (np.array([s.point for s in self._pending]) - origin) @ (R / L)
        equations: list[list[float]] = []
        for s, xi, ni in zip(self._pending, x.tolist(), normals.tolist(), strict=True):
            equations += sample_rows(c, xi, ni, (s.sigma_point / L) ** 2, s.sigma_normal**2)
        block = np.array(equations)
        if not self._settled:
            block[:, 9] -= block[:, :9] @ self._c
        return block

    def _move_frame(self) -> None:
        assert self._last is not None
        L, R, origin = self._memory, self._T[:3, :3], self._T[:3, 3]
        x = R.T @ (self._last.p_base - origin) / L
        if float(x @ x) < ANCHOR**2:
            return
        x, z = foot(self._c, x)
        turned = transported_rotation(np.eye(3), z)
        self._c, M = transport(self._c, homogeneous(turned, x))
        self._c[:3] = 0.0
        back = inverted(M)
        self._root, self._inverse = self._root @ back, M @ self._inverse
        self._score.carry(back)
        self._T = homogeneous(R @ turned, origin + R @ (L * x))


def _weighted_rows(c: Array, d: Design) -> Array:
    """(n, 3, 9): whitened rows of a batch solution, weighted as it did."""
    r, J, _ = rows(c, d)
    weight, _ = robust(np.einsum("ij,ij->i", r, r))
    result: Array = J * np.sqrt(weight)[:, None, None]
    return result


def _innovations(block: Array, inverse: Array) -> Array:
    """Squared innovations (n,), χ² of 3 each, of whitened rows (3n, 10) under an inverse root of information."""
    predicted = block[:, :9] @ inverse
    square = block[:, 9] ** 2 / (1.0 + np.einsum("ij,ij->i", predicted, predicted))
    result: Array = square.reshape(-1, 3).sum(axis=1)
    return result
