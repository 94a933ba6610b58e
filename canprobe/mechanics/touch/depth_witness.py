"""The depth of a probe in a surface that it has touched before: a force without the present images.

Contacts that are older than the suspect ones show a surface: heights and slopes of each, joined by a local quadratic
(Bayesian least squares). How deep the probe stands in it now is a force, by the layer's law `δ = d₁ √F`. The farther
the probe has gone since, the less that says: curvature that was not touched yet grows into the standard deviation.

Contacts are kept with their force, not their depth, so that a better d₁ places all of them anew. A contact that the
surface contradicts begins a suspect time; what comes in it is not believed until it agrees again, or until the path is
so long that the witness has nothing to say. A force that falls from one image to the next by more than the probe can
have moved off begins one at once: from then on d₁ is that of before, too.

A touch that goes on over new ground is followed by its `Sinkage`, too, as contacts that sink with the probe show no
surface that would contradict them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from canprobe.mechanics.touch.sinkage import CERTAIN_SIGMAS, Sinkage
from canprobe.mechanics.touch.tangent_frames import tangent_rotation
from canprobe.mechanics.types import Floats

STEP = 0.4e-3
"""Way along the surface between two kept contacts, m."""
HOLD_WAY = 0.15e-3
"""Way from its first contact within which a touch in one place is at rest, m."""
WANDER = 1e-3
"""Way from its first contact beyond which a touch in one place has wandered off it, m."""
MOST_CONTACTS, NEAR_CONTACTS = 400, 32
"""Contacts that are kept, and of those the nearest that are asked."""
REACH = 12e-3
"""Way from a contact beyond which it is not asked, m."""
SUSPECT_S = 0.1
"""Time before which a contact is not believed: a fault of the image shows within it."""
HEIGHT_SIGMA, SLOPE_SIGMA = 25e-6, 6e-3
"""Standard deviation of a contact's height, m, and slope, rad, their slow parts included."""
DEPTH_ERROR = 0.15
"""Relative error of d₁, by which contacts of other forces lie at another height."""
CURVATURE_SIGMA = 40.0
"""Standard deviation of a curvature before any contact, 1/m."""
CURVATURE_CHANGE = 12.0
"""Standard deviation of the curvature a few millimetres further, 1/m: of a fillet it jumps by 30."""
SUNK_SHARE = 0.8
"""Share of the margin to the limit by which a probe has sunk when it counts."""
CONTRADICTED_S = 0.05
"""Time for which a contradiction lasts before it counts."""
FALL_SHARE = 0.6
"""Share of the force that the depth means below which it has fallen: more than noise, bridged taxels and bumps do."""
FALL_GAP_S = 0.03
"""Longest time between two images of which a fall is told; some images may be lost."""
STEEPEST = 0.3
"""Steepest slope of the object against the surface at the last contact, by which a motion aside may lower the force."""
LEAST_FORCE = 0.2
"""Least force of which a fall is told, N."""


def sigma_ahead(way: float) -> float:
    """Standard deviation of the depth on new ground, m, a way (m) beyond the last contact that is believed."""
    return math.hypot(0.5 * HEIGHT_SIGMA, SLOPE_SIGMA * way / 3.0, 0.5 * CURVATURE_CHANGE * way * way)


@dataclass(slots=True, eq=False)
class _Kept:
    """One contact: time, s, probe's centre (3,), m, outward normal (3,), root of its force, √N."""

    t: float
    centre: Floats
    normal: Floats
    root: float

    def aside(self, other: _Kept) -> float:
        """Way of the probe along the surface to another contact, m."""
        way = other.centre - self.centre
        return float(np.linalg.norm(way - self.normal * float(way @ self.normal)))

    def falls_to(self, other: _Kept, d1: float) -> bool:
        """Whether the force of the next contact is lower than any way of the probe since this one explains."""
        depth = d1 * self.root
        off = max(float((other.centre - self.centre) @ self.normal), 0.0) + STEEPEST * self.aside(other)
        least = self.root**2 * (max(depth - off, 0.0) / depth) ** 2 if depth > 0.0 else 0.0
        return least > LEAST_FORCE and other.root**2 < FALL_SHARE * least


@dataclass(slots=True, eq=False)
class Fall:
    """A fall of the measured force that no motion explains.

    Attributes:
        t: time, s.
        within_s: time between the two images, s.
        before, after: force in them, N.
        lasts_s: time for which it has lasted, s.
    """

    t: float
    within_s: float
    before: float
    after: float
    lasts_s: float = 0.0


class DepthWitness:
    """Follows the contacts of one touch.

    Example: `witness.step(t, centre, normal, force, d1=d1, force_max=5.0)` for each image; `witness.force` once it
    `contradicts`.

    Args:
        radius: radius of the probe, m.
        holds: the touch stays in one place: only its first contacts show the surface.
        slope_sigma: standard deviation of a way of the arm against where it says that it goes, rad.

    Attributes:
        depth, sigma: depth of the probe in the surface that was touched before, m, and its standard deviation; NaN and
            infinite where nothing is known.
        force: force of that depth, or of the depth to which the probe has sunk, N.
        fall: fall of the force that no motion explains, as long as it lasts; None without one.
        contradicts: whether the depth has meant far more force than was measured for `CONTRADICTED_S`, or a touch in
            one place has wandered for as long.
        wandered: way of a touch in one place from its first contact, m, where it is beyond `WANDER`; else None.
        watched, silent: number of contacts at which the witness could say something, and could not.
    """

    def __init__(self, radius: float, *, holds: bool = False, slope_sigma: float = 0.0) -> None:
        self._radius, self._holds, self._slope_sigma = radius, holds, slope_sigma
        self.watched = self.silent = 0
        self.restart()

    def restart(self) -> None:
        """Forget the surface: a new touch begins."""
        self._believed: list[_Kept] = []
        self._recent: list[_Kept] = []
        self._deep_since: float | None = None
        self._last: _Kept | None = None
        self._sinkage = Sinkage(self._slope_sigma)
        self._d1: float | None = None
        self.fall: Fall | None = None
        self.depth, self.sigma, self.force = math.nan, math.inf, math.nan
        self.contradicts = False
        self.wandered: float | None = None

    def step(
        self, t: float, centre: Floats, normal: Floats | None, force: float, *, d1: float, force_max: float
    ) -> None:
        """Take an image.

        Args:
            t: time, s.
            centre: (3,) centre of the probe, m.
            normal: (3,) outward unit normal of the object at the contact; None where the image shows none.
            force: measured force, N.
            d1: depth at 1 N, m.
            force_max: limit of the force, N.
        """
        last = self._last
        if last is None and normal is None:
            return
        contact = _Kept(t, centre, normal if normal is not None else last.normal, math.sqrt(max(force, 0.0)))  # type: ignore[union-attr]
        if self.fall is None and last is not None and t - last.t <= FALL_GAP_S and last.falls_to(contact, d1):
            self.fall, self._d1 = Fall(t, t - last.t, last.root**2, force), d1
            self._believe(math.inf)
        self._last = contact
        d1 = self._d1 or d1
        self._look(contact, d1)
        now, limit = d1 * contact.root, d1 * math.sqrt(force_max)
        doubt = CERTAIN_SIGMAS * math.hypot(self.sigma, DEPTH_ERROR * (limit - now))
        known = doubt <= limit - now
        self.watched, self.silent = self.watched + known, self.silent + (not known)
        if self.fall is not None and (not known or force >= FALL_SHARE * self.force):
            self.fall = self._d1 = None
        least = max(doubt, 0.5 * (limit - now))
        sunk = self._sinkage.step(centre, normal, contact.root, d1) if normal is not None and not self._holds else 0.0
        sinks = sunk > SUNK_SHARE * max(limit - now, 0.0)
        if sinks:
            self.force = max(((now + sunk) / d1) ** 2, 0.0 if math.isnan(self.force) else self.force)
        deeper = sinks or (known and self.depth - now > least)
        suspect = known and self.depth - now > 0.5 * least
        aside = self._believed[0].aside(contact) if self._holds and self._believed else 0.0
        self.wandered = aside if aside > WANDER else None
        if normal is not None and not deeper and self.fall is None:
            self._recent.append(contact)
            if not suspect:
                self._believe(t - SUSPECT_S)
        wrong = deeper or self.wandered is not None
        self._deep_since = (t if self._deep_since is None else self._deep_since) if wrong else None
        self.contradicts = self._deep_since is not None and t - self._deep_since >= CONTRADICTED_S
        if self.fall is not None:
            self.fall.lasts_s = t - self.fall.t

    def _believe(self, until: float) -> None:
        """Believe the contacts up to a time, one in each `STEP` of the way or of another force."""
        while self._recent and self._recent[0].t <= until:
            one = self._recent.pop(0)
            if self._believed:
                first, last = self._believed[0], self._believed[-1]
                if self._holds and first.aside(one) > HOLD_WAY:
                    continue
                if last.aside(one) < STEP and abs(one.root - last.root) < 0.2:
                    continue
            self._believed.append(one)
            del self._believed[:-MOST_CONTACTS]

    def _look(self, contact: _Kept, d1: float) -> None:
        """Depth of the probe at a contact in the surface of the believed ones."""
        self.depth, self.sigma, self.force = math.nan, math.inf, math.nan
        if not self._believed:
            return
        centres = np.array([one.centre for one in self._believed])
        apart = np.linalg.norm(centres - contact.centre, axis=1)
        order = np.argsort(apart, kind="stable")[:NEAR_CONTACTS]  # equal distances: the older one, everywhere
        order = order[apart[order] < REACH]
        if not order.size:
            return
        normals = np.array([self._believed[k].normal for k in order])
        up = normals[0]
        facing = normals @ up > 0.8
        order, normals = order[facing], normals[facing]
        roots, upright = np.array([self._believed[k].root for k in order]), normals @ up
        points = centres[order] - normals * (self._radius - d1 * roots)[:, None]
        R = tangent_rotation(up)
        local = (points - points[0]) @ R
        slopes = -(normals @ R[:, :2]) / upright[:, None]
        x, y, z = (contact.centre - points[0]) @ R
        self._fit_and_measure(local, slopes, np.abs(roots - contact.root) * d1, (float(x), float(y), float(z)))
        if math.isfinite(self.sigma):
            self.force = (max(self.depth, 0.0) / d1) ** 2

    def _fit_and_measure(self, local: Floats, slopes: Floats, off: Floats, centre: tuple[float, float, float]) -> None:
        """Fit heights and slopes about the foot of the probe, and take its depth there."""
        x, y, height = centre
        rx, ry = local[:, 0] - x, local[:, 1] - y
        away2 = rx * rx + ry * ry
        bent = 0.5 * CURVATURE_CHANGE * away2
        w_height = 1.0 / np.sqrt(HEIGHT_SIGMA**2 + (DEPTH_ERROR * off) ** 2 + bent**2)
        w_slope = 1.0 / np.sqrt(SLOPE_SIGMA**2 + CURVATURE_CHANGE**2 * away2)
        one, none = np.ones_like(rx), np.zeros_like(rx)
        A = np.concatenate(
            [
                w_height[:, None] * np.stack([one, rx, ry, 0.5 * rx * rx, rx * ry, 0.5 * ry * ry], axis=1),
                w_slope[:, None] * np.stack([none, one, none, rx, ry, none], axis=1),
                w_slope[:, None] * np.stack([none, none, one, none, rx, ry], axis=1),
                np.diag([1e-6, 1e-6, 1e-6, *[1.0 / CURVATURE_SIGMA] * 3]),
            ]
        )
        b = np.concatenate([w_height * local[:, 2], w_slope * slopes[:, 0], w_slope * slopes[:, 1], np.zeros(6)])
        normal_matrix = A.T @ A
        try:
            covariance = np.linalg.inv(normal_matrix)
        except np.linalg.LinAlgError:
            return
        fitted = covariance @ (A.T @ b)
        residual = A @ fitted - b
        scatter2 = max(1.0, float(residual @ residual) / max(3 * len(rx) - 6, 1))  # contacts that contradict each other
        _, bx, by, hxx, hxy, hyy = fitted.tolist()
        # the foot of the sphere: where its slope is that of the surface
        stiff_xx, stiff_yy = 1.0 / self._radius - hxx, 1.0 / self._radius - hyy
        determinant = stiff_xx * stiff_yy - hxy * hxy
        if determinant <= 0.0 or stiff_xx <= 0.0:
            return  # as hollow as the probe: no one foot
        fx, fy = (stiff_yy * bx + hxy * by) / determinant, (stiff_xx * by + hxy * bx) / determinant
        inside = self._radius**2 - fx * fx - fy * fy
        if inside <= 0.0:
            return
        row = np.array([1.0, fx, fy, 0.5 * fx * fx, fx * fy, 0.5 * fy * fy])
        self.depth = float(row @ fitted) - height + math.sqrt(inside)
        ahead2 = float(np.min((rx - fx) ** 2 + (ry - fy) ** 2))
        new = 0.5 * CURVATURE_CHANGE * ahead2
        self.sigma = math.sqrt(scatter2 * (float(row @ covariance @ row) + new * new))
