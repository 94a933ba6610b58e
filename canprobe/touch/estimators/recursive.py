"""`recursive`: the nine-parameter model as a square-root information filter; what runs in the 200 Hz loop.

Constant work per sample whatever the memory. Samples are collected until the contact has moved on by a step, then
taken in together: one QR of the forgotten root, the new whitened rows and what the prior has lost. Forgetting is per
millimetre travelled, never per second; a contact that does not move adds nothing and forgets nothing. The information
is carried along from contact frame to contact frame by `S' = Tᵀ S T`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.touch._arrays import Array, positive, upper_root
from canprobe.touch.anchor import anchor, foot
from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate import Solution, SurfaceEstimate, build_estimate
from canprobe.touch.estimators.base import Dropped, Gate
from canprobe.touch.estimators.travel import Spread, Travel
from canprobe.touch.frames import homogeneous, tangent_rotation, transported_rotation
from canprobe.touch.noise import Correlation, Noise, mixed
from canprobe.touch.nonlinear import CHI2_999, fit
from canprobe.touch.prior import Prior
from canprobe.touch.quadric import UNIT, Design, curvature_jacobian, design, rows, transport
from canprobe.touch.quadric_row import sample_rows
from canprobe.touch.rank import SPREAD, decide, spread_of

DIFFUSE = 1e-2
"""Root of the information, in units of the memory, that keeps an untouched filter regular: K known to ±200/memory."""
STEP = 0.025
"""Travel between two updates over the memory."""
ANCHOR = 0.1
"""Travel between two changes of the working frame over the memory."""
CROWD = 2.0
"""Most samples per metre that count in full, over the nominal `window / memory`."""
START = (0.2, 0.8)
"""Travel over the memory at the first and last batch solution of the start; it doubles from one to the next."""
START_SAMPLES = 128
"""Most samples of such a solution; where there are more, neighbours are averaged."""
FADE = 0.1
"""What an alarm leaves of the information's root."""
ALARM = 2.2
"""Running innovation, over its long-term mean, at which the surface is taken to have changed."""
LEAST_USUAL = 0.3
"""Least long-term innovation that an alarm is measured by; it is below 1 where the stated noise is generous."""
RUNNING, LONG_TERM = 0.1, 0.004
"""Weights of one sample in the running and in the long-term innovation."""


_ONES = np.ones(3)


class _Pending(NamedTuple):
    point: Array
    normal: Array
    sigma_point: float
    sigma_normal: float


def _mean(a: _Pending, b: _Pending, share: float) -> _Pending:
    """Two neighbouring samples as one; `share` of their noise is the same."""
    smaller = 0.5 * math.sqrt(1.0 + share)
    normal = a.normal + b.normal
    return _Pending(
        0.5 * (a.point + b.point),
        normal / math.sqrt(float(normal @ normal)),
        smaller * math.hypot(a.sigma_point, b.sigma_point),
        smaller * math.hypot(a.sigma_normal, b.sigma_normal),
    )


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
        self._correlation = correlation
        self.dropped = Dropped()
        self._gate = Gate(sigma_point, sigma_normal)
        self._memory = positive("memory_m", memory_m)
        self._crowd = CROWD * positive("window", window) / memory_m
        self._prior = Prior.weak(memory_m) if prior is None else prior
        if math.isfinite(self._prior.sigma_curvature):
            raise UsageError("prior: expected none on curvature itself for 'recursive', got " + self._prior.name)
        self._prior_rows = self._make_prior_rows()
        self._prior_score = self._prior_rows.T @ self._prior_rows
        self.reset()

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._gate.reset()
        self._last: ContactSample | None = None
        self._pending: deque[_Pending] = deque(maxlen=16)
        self._travel = Travel(max(STEP * self._memory, 3.0 * self._gate.sigma_point))
        self._spread = Spread()
        self._T = np.eye(4)
        self._c = np.zeros(9)
        self._set_root(self._prior_rows)
        self._innovation = self._usual = 1.0
        self._faded = 0
        self._first = True
        self._restart()

    def _restart(self) -> None:
        self._start: list[_Pending] = []
        self._started = self._travel.total
        self._next_start = START[0] * self._memory

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        if not self._gate.passes(sample, self.dropped):
            return
        if self._last is None:
            self._begin(sample)
        self._last = sample
        self._pending.append(_Pending(sample.p_base, sample.n_base, *self._gate.sigmas(sample)))
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
        spread = tangent.T @ self._spread.covariance @ tangent / self._gate.sigma_point**2
        size = 2.0 * math.sqrt(a.c[6] ** 2 + 2.0 * a.c[7] ** 2 + a.c[8] ** 2)
        q = a.M[6:] @ self._inverse / UNIT[:, None]
        decision = decide(np.linalg.cholesky(np.linalg.inv(q @ q.T)).T, spread, size)
        known = decision.vectors[:, decision.passed]
        a.c[6:] = UNIT * (known @ (known.T @ (a.c[6:] / UNIT)))
        D = curvature_jacobian(a.c) @ a.M @ self._inverse @ self._inverse.T
        singular = np.linalg.svd(self._root, compute_uv=False)
        return build_estimate(
            Solution(a.c, D @ self._score @ D.T, decision, has_prior=False),
            length=L,
            T_frame_contact=a.T_frame_contact,
            condition_number=float(singular[0] / singular[-1]),
            innovation=self._innovation,
            distance=min(self._travel.total, L),
            samples=self._spread.weight,
            method="recursive",
            prior=self._prior.name,
            notes=(f"the surface changed {self._faded} times: memory shortened",) if self._faded else (),
        )

    def _make_prior_rows(self) -> Array:
        A, _ = self._prior.rows(self._memory)
        own = DIFFUSE * np.eye(9)
        own[3:6] = A[:3]
        return own

    def _begin(self, sample: ContactSample) -> None:
        self._T = homogeneous(tangent_rotation(-sample.n_base), sample.p_base)

    def _set_root(self, root: Array) -> None:
        """Take a root whose rows all count in full."""
        self._root, self._inverse, self._score = root, np.linalg.inv(root), root.T @ root
        self._recent = np.zeros((3, 9))

    def _absorb(self, moved: float) -> float:
        """Take in what is pending; the weight of each sample where they are crowded, else 1."""
        kept = math.exp(-moved / self._memory)
        root = math.sqrt(kept) * self._root
        inverse = self._inverse * (1.0 / math.sqrt(kept))
        points = np.array([s.point for s in self._pending])
        block = self._rows_of_pending(points)
        weight, changed = self._judge(block, inverse)
        if changed:
            root, weight, kept = FADE * root, np.ones_like(weight), FADE**2 * kept
        crowd = min(1.0, self._crowd * moved / len(self._pending))
        self._spread.fade(kept)
        self._spread.add(points, crowd)
        block *= np.sqrt(crowd * weight).repeat(3)[:, None]
        lost = math.sqrt(1.0 - kept) * self._prior_rows
        stacked = np.empty((18 + len(block), 10))
        stacked[:9, :9], stacked[:9, 9] = root, 0.0
        stacked[9:18, :9], stacked[9:18, 9] = lost, -(lost @ self._c)
        stacked[18:] = block
        full = upper_root(stacked)
        self._root = full[:9, :9]
        self._inverse = np.linalg.inv(self._root)
        self._c = self._c + self._inverse @ full[:9, 9]
        # what the rows' noise does to an answer whose rows have faded: weights enter squared
        self._score = kept**2 * self._score + (1.0 - kept**2) * self._prior_score
        self._score += self._score_of(block[:, :9], moved, kept)
        self._move_frame()
        return crowd

    def _score_of(self, J: Array, moved: float, kept: float) -> Array:
        """What new rows (3n, 9) add to the score's covariance: with each other, and with earlier ones they resemble."""
        if self._correlation is None:
            return np.asarray(J.T @ J, dtype=np.float64)
        n = len(J) // 3
        places = moved / n * np.arange(1.0, n + 1.0)
        by_sample = J.reshape(n, 27)
        own = J.T @ mixed(self._correlation.matrix(places), J.reshape(n, 3, 9)).reshape(-1, 9)
        fades = np.exp(-places / self._correlation.length)
        cross = (fades @ by_sample).reshape(3, 9).T @ (kept * self._recent)
        newest = self._correlation.shares[:, None] * ((fades[-1] / fades) @ by_sample).reshape(3, 9)
        self._recent = kept * fades[-1] * self._recent + newest
        return np.asarray(own + cross + cross.T, dtype=np.float64)

    def _start_up(self, wider: float) -> None:
        """Solve the first samples again as a batch: the filter's first steps were linearised on a plane."""
        self._start += [
            _Pending(s.point, s.normal, wider * s.sigma_point, wider * s.sigma_normal) for s in self._pending
        ]
        if len(self._start) > START_SAMPLES:
            share = 0.0 if self._correlation is None else self._correlation.share
            self._start = [_mean(a, b, share) for a, b in zip(self._start[::2], self._start[1::2], strict=False)]
        travelled = self._travel.total - self._started
        if travelled < self._next_start:
            return
        d = self._design(self._start)
        if float(np.linalg.eigvalsh(spread_of(d.X, d.point_variance))[0]) >= SPREAD:
            fitted = fit(d, self._prior.rows(self._memory))
            if fitted.decision.rank == 3 and fitted.converged:
                self._c = fitted.c
                self._set_root(fitted.root)
                if self._correlation is not None:
                    self._score_start(rows(fitted.c, d).J, travelled, self._correlation)
            self._next_start *= 2.0
        if travelled >= START[1] * self._memory:
            self._next_start, self._start, self._first = math.inf, [], False

    def _score_start(self, J: Array, travelled: float, correlation: Correlation) -> None:
        places = np.linspace(0.0, travelled, len(J))
        resembling = mixed(correlation.matrix(places), J).reshape(-1, 9)
        self._score = self._prior_score + J.reshape(-1, 9).T @ resembling
        fades = np.exp((places - travelled) / correlation.length)
        self._recent = correlation.shares[:, None] * (fades @ J.reshape(-1, 27)).reshape(3, 9)

    def _design(self, samples: list[_Pending]) -> Design:
        L, R = self._memory, self._T[:3, :3]
        points = (np.array([s.point for s in samples]) - self._T[:3, 3]) @ R / L
        normals = np.array([s.normal for s in samples]) @ R
        noise = Noise(np.array([s.sigma_point for s in samples]) / L, np.array([s.sigma_normal for s in samples]))
        return design(points, normals, noise)

    def _rows_of_pending(self, points: Array) -> Array:
        """(3n, 10): whitened Jacobian and minus residual."""
        R, origin, L = self._T[:3, :3], self._T[:3, 3], self._memory
        c = self._c.tolist()
        normals = np.array([s.normal for s in self._pending]) @ R
        x = (points - origin) @ (R / L)
        block: list[list[float]] = []
        for s, xi, ni in zip(self._pending, x.tolist(), normals.tolist(), strict=True):
            block += sample_rows(c, xi, ni, (s.sigma_point / L) ** 2, s.sigma_normal**2)
        return np.array(block)

    def _judge(self, block: Array, inverse: NDArray[np.floating]) -> tuple[Array, bool]:
        """Weights (n,) by Huber's rule on the innovations, and whether they say that the surface has changed."""
        predicted = block[:, :9] @ inverse
        square = block[:, 9] ** 2 / (1.0 + np.einsum("ij,ij->i", predicted, predicted))
        d2 = square.reshape(-1, 3) @ _ONES
        limited = np.minimum(d2, CHI2_999)
        weight: Array = np.sqrt(CHI2_999 / np.maximum(d2, CHI2_999))
        n = len(d2)
        mean = float(np.add.reduce(limited)) / (3.0 * n)
        self._innovation += min(1.0, RUNNING * n) * (mean - self._innovation)
        self._usual += min(1.0, LONG_TERM * n) * (mean - self._usual)
        if self._first or self._innovation < ALARM * max(LEAST_USUAL, self._usual):
            return weight, False
        self._innovation = self._usual
        self._faded += 1
        self._restart()
        return weight, True

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
        back = np.linalg.inv(M)
        self._root, self._inverse = self._root @ back, M @ self._inverse
        self._score = back.T @ self._score @ back
        self._recent = self._recent @ back
        self._T = homogeneous(R @ turned, origin + R @ (L * x))
