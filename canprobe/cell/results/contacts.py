"""The contacts of a scan as arrays, and the scores of any estimators on them."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from canprobe.cell.results.scores import ShapeScore, score_shape
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import SIGMA_NORMAL_RAD, centroid_coupling, make_shape_estimator
from canprobe.cell.tasks.own_estimators import OwnEstimator, RenewedEstimator
from canprobe.cell.tasks.shape import replay_samples
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.mechanics.touch import ContactSample, Estimator
from canprobe.mechanics.touch.estimate.gate import Gate
from canprobe.mechanics.types import Floats

ESTIMATE_PERIOD_S = 0.1
"""Time between two answers of an estimator that is scored afterwards."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Contacts:
    """Measured contacts of a scan, one row for each tactile frame; base frame, SI.

    Point and normal of a contact come from one centroid, so their errors are coupled: an error e of the point along
    the surface comes with an error of −e · coupling of the normal. With that, `canprobe.fit_surface` takes them as
    ``fit_surface(c.points, c.normals, sigma_point=c.covariances, sigma_normal=c.sigma_normal, coupling=c.coupling)``.

    Attributes:
        t_s: instants (n,), s, on the clock of the log.
        points: contact points on the object (n, 3), m.
        normals: outward unit normals of the object there (n, 3).
        forces: contact forces (n,), N.
        covariances: covariances of the points (n, 3, 3), m².
        normal_covariances: covariances of the normals (n, 3, 3), rad², the part coupled to the point included.
        sigma_normal: standard deviation of a normal per tangent axis without the coupled part, rad.
        coupling: coupling of the errors, 1/m; 0 where they are independent.
        samples: the contacts as estimators take them, with times since the first SYNC, s. Their depths are those of
            the end of the scan (`ShapeTracker.settled`); the estimator in the loop had those of its time.
    """

    t_s: Floats
    points: Floats
    normals: Floats
    forces: Floats
    covariances: Floats
    normal_covariances: Floats
    sigma_normal: float
    coupling: float
    samples: tuple[ContactSample, ...]

    def __len__(self) -> int:
        return len(self.samples)

    def __repr__(self) -> str:
        path = float(np.linalg.norm(np.diff(self.points, axis=0), axis=1).sum())
        mean = f", {self.forces.mean():.2f} N in the mean" if len(self) else ""
        return f"{len(self)} contacts over {1e3 * path:.1f} mm{mean}"


def contacts_of(samples: Sequence[ContactSample], task: Touch, start_s: float) -> Contacts:
    """The contacts of a scan whose first SYNC was due at `start_s` on the run's clock."""
    n = len(samples)
    normals = np.array([s.n_base for s in samples]).reshape(n, 3)
    gate, coupling = Gate(1.0, SIGMA_NORMAL_RAD), centroid_coupling(task.probe)
    point, height, normal = np.square([gate.sigmas(sample) for sample in samples]).reshape(n, 3, 1, 1).swapaxes(0, 1)
    along = normals[:, :, None] * normals[:, None, :]
    across = np.eye(3) - along
    return Contacts(
        t_s=np.array([start_s + s.t_s for s in samples]),
        points=np.array([s.p_base for s in samples]).reshape(n, 3),
        normals=normals,
        forces=np.array([s.force_n for s in samples]),
        covariances=point * across + height * along,
        normal_covariances=(normal + coupling**2 * point) * across,
        sigma_normal=SIGMA_NORMAL_RAD,
        coupling=coupling,
        samples=tuple(samples),
    )


class Scores(dict[str, dict[str, Any]]):
    """Errors of estimators on the same contacts, by name: the fields of `ShapeScore`, and ``us_per_contact``."""

    def __repr__(self) -> str:
        return "\n".join("  ".join(cell.rjust(12) for cell in row) for row in self._cells())

    def _repr_html_(self) -> str:
        rows = "".join(f"<tr><td>{'<td>'.join(map(html.escape, row))}" for row in self._cells())
        return f"<table>{rows}</table>"

    def _cells(self) -> list[list[str]]:
        columns = {
            "K (1/m)": ("kappa_rms_error_per_m", ".2f"),
            "K (%)": ("kappa_rms_error_percent", ".2f"),
            "normal (deg)": ("normal_rms_deg", ".3f"),
            "place (mm)": ("position_rms_mm", ".3f"),
            "answers": ("estimates", "d"),
            "µs/contact": ("us_per_contact", ".0f"),
        }
        cells = [["RMS error", *columns]]
        for name, score in self.items():
            values = [(score[key], form) for key, form in columns.values()]
            cells.append([name, *("–" if value is None else format(value, form) for value, form in values)])
        return cells


def score_estimators(
    samples: Sequence[ContactSample],
    task: Touch,
    estimators: Mapping[str, str | Callable[[], OwnEstimator]],
    *,
    truth: Mapping[str, Floats],
    sync_times: Floats,
) -> Scores:
    """Feed the contacts of a scan to each estimator, as the loop would have, and score its answers.

    Args:
        samples: contacts of the scan.
        task: the planned task.
        estimators: estimators by their name in the table: the name of a method, or a function that makes one.
        truth: columns of the plant's truth, one row for each SYNC.
        sync_times: time of each SYNC on the clock of the samples (n,), s.
    """
    every, clock, scores = max(1, round(ESTIMATE_PERIOD_S * task.array.rate_hz)), MonotonicClock(), Scores()
    for name, what in estimators.items():
        estimator: Estimator = make_shape_estimator(task, what) if isinstance(what, str) else RenewedEstimator(what)
        before_ns = clock.now_ns()
        records = replay_samples(estimator, samples, every)
        cost_us = 1e-3 * (clock.now_ns() - before_ns) / max(len(samples), 1)
        score: ShapeScore = score_shape(records, truth, sync_times)
        scores[name] = {**asdict(score), "us_per_contact": cost_us}
    return scores
