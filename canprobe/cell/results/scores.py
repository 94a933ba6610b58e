"""Scores of a run against the plant's truth: contact over the scan, shape after the first 20 mm, its bound, its map.

The contacts of a scan are arrays, on which any estimators are scored.
"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from canprobe.cell.scene.setup import Setup, Touch
from canprobe.cell.tasks.from_plan import SIGMA_NORMAL_RAD, centroid_coupling, contact_correlation, make_shape_estimator
from canprobe.cell.tasks.shape import OwnEstimator, RenewedEstimator, ShapeRecord, ShapeTracker, replay_samples
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.mechanics.touch.image.force_errors import UPPER_SIGMAS, ForceSigma
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch import ContactSample, Estimator, SurfaceMap
    from canprobe.mechanics.touch.shapes import PlacedShape

RUN_IN_M = 0.020
"""Path after which the answers of an estimator count."""
CHECKPOINTS = 12


def curvature_tensor(kappa: Floats, direction1: Floats, direction2: Floats) -> Floats:
    """Curvature tensor (3, 3), 1/m, from principal curvatures (2,) and unit directions (3,)."""
    tensor: Floats = kappa[0] * np.outer(direction1, direction1) + kappa[1] * np.outer(direction2, direction2)
    return tensor


def score_contact(
    truth: Mapping[str, Floats], first: int, last: int, target_n: float | Floats
) -> dict[str, float | None]:
    """Force, contact and speed over cycles ``first`` ≤ k < ``last``.

    Args:
        truth: columns of the plant's truth, one row for each SYNC.
        first, last: SYNC numbers of the scan.
        target_n: wanted force, N, or that of each cycle (last - first,).
    """
    force = truth["force_n"][first:last]
    points = truth["contact_point_m"][first:last]
    times = truth["t_s"][first:last]
    if len(force) < 2:
        return dict.fromkeys(("force_rms_error_n", "force_max_n", "contact_fraction", "speed_mean_m_s"))
    travelled = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    off = force - np.broadcast_to(target_n, last - first)[: len(force)]
    return {
        "force_rms_error_n": float(np.sqrt(np.mean(off**2))),
        "force_max_n": float(truth["force_n"].max()),
        "contact_fraction": float(np.mean(force > 0)),
        "speed_mean_m_s": travelled / float(times[-1] - times[0]),
    }


def score_measured_force(
    log: Mapping[str, Floats], truth: Mapping[str, Floats], first: int, last: int
) -> dict[str, float]:
    """Error of the force that the array measured: mean and RMS of measured less true, at the instants of its samples.

    Beside them the share of seconds in which the mean error is within twice the stated standard deviation.

    Args:
        log: columns of the log, one row a cycle.
        truth: columns of the plant's truth, one row a SYNC.
        first, last: the scan, as SYNC numbers; nothing is scored where it has no sample.
    """
    measured, sampled = log["force_n"][first:last], log["sample_cycle"][first:last]
    known = np.isfinite(measured) & (sampled >= 0) & (sampled < len(truth["force_n"]))
    if not known.any():
        return {}
    error = measured[known] - truth["force_n"][sampled[known].astype(int)]
    score = {"force_true_bias_n": float(error.mean()), "force_true_rms_error_n": float(np.sqrt(np.mean(error**2)))}
    if "force_sigma_n" in log:
        times, sigma = log["t_s"][first:last][known], log["force_sigma_n"][first:last][known]
        seconds = np.floor(times - times[0]).astype(int)
        each = [(error[seconds == k].mean(), sigma[seconds == k].mean()) for k in np.unique(seconds)]
        score["force_within_2_sigma_fraction"] = float(np.mean([abs(e) <= UPPER_SIGMAS * s for e, s in each]))
    return score


def state_force_sigma(log: Mapping[str, Floats], first: int, last: int) -> dict[str, Any]:
    """The standard deviation of the measured force over a scan, as the samples state it, and its parts by their causes.

    RMS over the samples in which it is finite; those that show only a lower bound of the force are counted.

    Args:
        log: columns of the log, one row a cycle.
        first, last: the scan, as SYNC numbers.
    """
    sigma = log["force_sigma_n"][first:last]
    finite = np.isfinite(sigma)
    score: dict[str, Any] = {"force_lower_bound_fraction": float(np.mean(np.isinf(sigma[~np.isnan(sigma)])))}
    if finite.any():
        parts = np.sqrt(np.mean(np.square(log["force_sigma_parts_n"][first:last][finite]), axis=0)).tolist()
        score["force_sigma_n"] = float(np.sqrt(np.mean(np.square(sigma[finite]))))
        score["force_sigma_parts_n"] = dict(zip(ForceSigma._fields, parts, strict=True))
    return score


@dataclass(frozen=True, slots=True)
class ShapeScore:
    """Errors of one estimator over a run; None where nothing could be scored.

    Attributes:
        kappa_true_per_m: mean true principal curvatures (1/m) over the scored estimates; where none could be scored, as
            part of the curvature was not observed, over all after the run-in, or else over all.
        kappa_est_per_m: mean estimated principal curvatures (1/m).
        kappa_rms_error_per_m: RMS Frobenius norm of K_est − K_true (1/m).
        kappa_rms_error_percent: that error relative to the RMS of ‖K_true‖; None on a plane.
        normal_rms_deg, position_rms_mm: RMS errors of the estimated contact frame.
        estimates: number of scored estimates.
        observed_fraction: share of the answers after the run-in that observed all curvature.
        patch_fraction: share of the scored answers to which the contact patch contributed a tenth or more.
    """

    kappa_true_per_m: tuple[float, float] | None
    kappa_est_per_m: tuple[float, float] | None
    kappa_rms_error_per_m: float | None
    kappa_rms_error_percent: float | None
    normal_rms_deg: float | None
    position_rms_mm: float | None
    estimates: int
    observed_fraction: float | None
    patch_fraction: float | None = None


def score_shape(records: Sequence[ShapeRecord], truth: Mapping[str, Floats], sync_times: Floats) -> ShapeScore:
    """Score estimates against the truth at the instants of their last samples.

    Args:
        records: the estimates.
        truth: columns of the plant's truth, one row for each SYNC.
        sync_times: time of each SYNC on the master's clock (n,), s.
    """
    late = [r for r in records if r.travelled_m >= RUN_IN_M]
    seen = [r for r in late if bool(np.all(r.estimate.observed))]
    rows = np.searchsorted(sync_times, [r.t_s - 1e-6 for r in seen or late or records])
    if rows.max(initial=0) >= len(truth["kappa_per_m"]):
        raise UsageError(
            f"truth: expected one row per SYNC, at least {rows.max() + 1}, got {len(truth['t_s'])}: of another run?"
        )
    kappa_true = _pair(truth["kappa_per_m"][rows].mean(axis=0)) if len(rows) else None
    if not seen:
        return ShapeScore(kappa_true, None, None, None, None, None, 0, 0.0 if late else None)
    errors, norms, tilts, offsets = [], [], [], []
    for record, row in zip(seen, rows, strict=True):
        T = record.estimate.T_frame_contact
        tensor = curvature_tensor(truth["kappa_per_m"][row], truth["direction1"][row], truth["direction2"][row])
        K_true = T[:3, :2].T @ tensor @ T[:3, :2]
        errors.append(float(np.sum((record.estimate.K - K_true) ** 2)))
        norms.append(float(np.sum(K_true**2)))
        cosine = float(-T[:3, 2] @ truth["contact_normal"][row])
        sine = float(np.linalg.norm(T[:3, 2] + truth["contact_normal"][row] * cosine))
        tilts.append(np.arctan2(sine, cosine) ** 2)
        offsets.append(float(np.sum((T[:3, 3] - truth["contact_point_m"][row]) ** 2)))
    rms, scale = float(np.sqrt(np.mean(errors))), float(np.sqrt(np.mean(norms)))
    return ShapeScore(
        kappa_true_per_m=kappa_true,
        kappa_est_per_m=_pair(np.mean([r.estimate.kappa for r in seen], axis=0)),
        kappa_rms_error_per_m=rms,
        kappa_rms_error_percent=100 * rms / scale if scale > 1e-9 else None,
        normal_rms_deg=float(np.degrees(np.sqrt(np.mean(tilts)))),
        position_rms_mm=float(np.sqrt(np.mean(offsets)) * 1e3),
        estimates=len(seen),
        observed_fraction=len(seen) / len(late),
        patch_fraction=sum(r.estimate.method.endswith("patch") for r in seen) / len(seen),
    )


def bound_ratio(
    setup: Setup, tracker: ShapeTracker | None, score: ShapeScore, truth: Mapping[str, Floats], sync_times: Floats
) -> float | None:
    """Error of the online estimator over the Cramér–Rao bound on the RMS Frobenius error of K, over the run.

    The bound is the limit of unbiased estimates from the last memory of path with noise of the stated size, the mean
    over ``CHECKPOINTS`` places after the run-in. An estimator with a longer memory may be better. The ratio is None
    where the contact patch contributed to most answers, as the bound is that of points and normals, and where a window
    leaves K open.

    Args:
        setup: setup of the run.
        tracker: tracker of the contacts of the scan; None without a shape.
        score: score of the estimator.
        truth: columns of the plant's truth, one row for each SYNC.
        sync_times: time of each SYNC on the master's clock (n,), s.
    """
    shape = setup.shape
    if tracker is None or shape is None or score.kappa_rms_error_per_m is None or (score.patch_fraction or 0.0) > 0.5:
        return None
    assert setup.array is not None
    samples, memory_m = tracker.samples, shape.memory
    correlation, coupling = contact_correlation(setup.array), centroid_coupling(setup.probe)
    from canprobe.mechanics.touch import SurfaceMatrix
    from canprobe.mechanics.touch.estimate.gate import Gate
    from canprobe.mechanics.touch.estimate.likelihood import batch_of, osculating_bound

    points = np.array([s.p_base for s in samples])
    gate = Gate(1.0, SIGMA_NORMAL_RAD)
    gate = Gate(float(np.median([gate.sigmas(s)[0] for s in samples])), SIGMA_NORMAL_RAD)
    touches = [gate.measured(s, coupling) for s in samples]
    path = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
    if len(path) < 3 or path[-1] < max(RUN_IN_M, memory_m):
        return None
    squares = []
    for place in np.linspace(max(RUN_IN_M, memory_m), path[-1], CHECKPOINTS):
        last = int(np.searchsorted(path, place - 1e-12))
        first = int(np.searchsorted(path, path[last] - memory_m))
        row = int(np.searchsorted(sync_times, samples[last].t_s - 1e-6))
        T = np.eye(4)
        T[:3, 2], T[:3, 3] = -truth["contact_normal"][row], truth["contact_point_m"][row]
        T[:3, 0] = truth["direction1"][row]
        T[:3, 1] = np.cross(T[:3, 2], T[:3, 0])
        surface = SurfaceMatrix.from_curvature(np.diag(truth["kappa_per_m"][row])).transformed(np.linalg.inv(T))
        C = osculating_bound(batch_of(touches[first : last + 1], correlation), surface)
        squares.append(C[0, 0] + 2 * C[1, 1] + C[2, 2])
    mean = float(np.mean(squares))
    return score.kappa_rms_error_per_m / float(np.sqrt(mean)) if np.isfinite(mean) else None


def _pair(values: Floats) -> tuple[float, float]:
    return float(values[0]), float(values[1])


MAX_PLACES = 500
"""Most places at which a map is scored, evenly over its nodes."""
TWO_SIGMA = 1.96
_COMMON = {"lag_um": 1e6, "pad_scale_percent": 1e2, "pad_x_um": 1e6, "pad_y_um": 1e6}


def summarise_map(surface_map: SurfaceMap, shape: PlacedShape | None) -> dict[str, Any]:
    """The section ``shape.map`` of ``summary.json``: None, or NaN, for what does not apply.

    Args:
        surface_map: map of the scan.
        shape: true object; None where nobody knows it.
    """
    from canprobe.mechanics.touch.linear_algebra import rms
    from canprobe.mechanics.touch.map import nodes as column

    names = ["sigma_um", "sigma_relative_um", "disagree_fraction", "stiffness_n_m3", "stiffness_sigma_percent"]
    names += ["common", "rms_error_um", "within_2_sigma_fraction", "within_2_sigma_relative_fraction"]
    found: dict[str, Any] = {"contacts": 0, "nodes": len(surface_map)} | dict.fromkeys(names)
    if not len(surface_map):
        return found
    found["contacts"] = int(surface_map.nodes.rows[:, column.COUNT].sum())
    places = surface_map.points[:: -(-len(surface_map) // MAX_PLACES)]
    feet = surface_map.closest(places)
    known = np.isfinite(feet.sigma)
    if known.any():
        found["sigma_um"] = 1e6 * float(np.median(feet.sigma[known]))
        found["sigma_relative_um"] = 1e6 * float(np.median(feet.sigma_relative[known]))
        found["disagree_fraction"] = float(np.mean(surface_map.disagreement(places[known]) > 0.0))
    if (stiffness := surface_map.stiffness) is not None:
        found["stiffness_n_m3"], found["stiffness_sigma_percent"] = stiffness.value, 1e2 * stiffness.sigma
    if any(surface_map.noise.common):
        mean, sigma = surface_map.common.mean, np.sqrt(np.diag(surface_map.common.covariance))
        each = zip(_COMMON.items(), mean.tolist(), sigma.tolist(), strict=True)
        found["common"] = {name: [unit * value, unit * spread] for (name, unit), value, spread in each}
    if shape is not None and known.any():
        off = np.array([shape.nearest((x, y, z)).distance for x, y, z in feet.point[known].tolist()])
        found["rms_error_um"] = 1e6 * rms(off)
        found["within_2_sigma_fraction"] = float(np.mean(np.abs(off) < TWO_SIGMA * feet.sigma[known]))
        # a tool that is off displaces a turning probe's surface along its normals, and another's as it is
        displaced = np.column_stack([np.ones(len(off)), feet.normal[known]])
        bent = off - displaced @ np.linalg.lstsq(displaced, off, rcond=1e-6)[0]
        held = np.abs(bent) < TWO_SIGMA * feet.sigma_relative[known]
        found["within_2_sigma_relative_fraction"] = float(np.mean(held))
    return found


def summarise_shape(
    setup: Setup,
    tracker: ShapeTracker | None,
    estimates: dict[str, list[ShapeRecord]],
    truth: Mapping[str, Floats],
    sync_times: Floats,
) -> dict[str, Any]:
    """The section ``shape`` of ``summary.json``: figures of the first estimator, and a table of all.

    Args:
        setup: setup of the run.
        tracker: tracker of its contacts; None without a shape.
        estimates: the answers of each estimator, by name.
        truth: columns of the plant's truth, one row per SYNC; empty without a truth.
        sync_times: time of each SYNC (n,), s, on the clock of the estimates.
    """
    names = (
        *("method", "kappa_true_per_m", "kappa_est_per_m", "kappa_rms_error_per_m", "kappa_rms_error_percent"),
        *("normal_rms_deg", "position_rms_mm", "observed", "patch_fraction", "cramer_rao_ratio"),
    )
    shape: dict[str, Any] = dict.fromkeys(names)
    if not estimates:
        return shape
    method = next(iter(estimates))
    records = estimates[method]
    shape["method"] = method
    if tracker is not None and (surface_map := tracker.surface_map) is not None:
        shape["map"] = summarise_map(surface_map, setup.truth.object if truth else None)
    if records:
        shape["observed"] = [bool(o) for o in records[-1].estimate.observed]
        kappa = np.asarray(records[-1].estimate.kappa).tolist()
        shape["kappa_est_per_m"] = [one if np.isfinite(one) else None for one in kappa]
    if not truth:
        return shape
    scores = {name: score_shape(answers, truth, sync_times) for name, answers in estimates.items()}
    score = asdict(scores[method])
    score["kappa_est_per_m"] = score["kappa_est_per_m"] or shape["kappa_est_per_m"]
    shape |= {name: value for name, value in score.items() if name in names}
    shape["cramer_rao_ratio"] = bound_ratio(setup, tracker, scores[method], truth, sync_times)
    shape["methods"] = methods_table(scores)
    return shape


def methods_table(scores: Mapping[str, ShapeScore]) -> dict[str, dict[str, Any]]:
    """The table ``shape.methods`` of ``summary.json`` from the scores of methods, by name."""
    of_run = ("kappa_true_per_m", "kappa_est_per_m")
    return {
        method: {name: value for name, value in asdict(score).items() if name not in of_run}
        for method, score in scores.items()
    }


def estimate_columns(records: Sequence[ShapeRecord]) -> dict[str, Floats]:
    """Estimates as columns, one row for each estimate; the suffix of a name is its unit."""
    answers = [r.estimate for r in records]
    return {
        "t_s": np.array([r.t_s for r in records]),
        "travelled_m": np.array([r.travelled_m for r in records]),
        "K_per_m": np.array([a.K for a in answers]).reshape(-1, 2, 2),
        "K_covariance_per_m2": np.array([a.covariance for a in answers]).reshape(-1, 3, 3),
        "kappa_per_m": np.array([a.kappa for a in answers]).reshape(-1, 2),
        "observed": np.array([a.observed for a in answers], bool).reshape(-1, 2),
        "T_base_contact_m": np.array([a.T_frame_contact for a in answers]).reshape(-1, 4, 4),
    }


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
    from canprobe.mechanics.touch.estimate.gate import Gate

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
    contacts: Contacts,
    task: Touch,
    estimators: Mapping[str, str | Callable[[], OwnEstimator]],
    truth: Mapping[str, Floats],
    times: Floats,
) -> Scores:
    """Feed the contacts of a scan to each estimator, as the loop would have, and score its answers.

    Args:
        contacts: contacts of the scan, at least one.
        task: the planned task.
        estimators: estimators by their name in the table: the name of a method, or a function that makes one.
        truth: columns of the plant's truth, one row for each SYNC.
        times: time of each SYNC on the run's clock (n,), s.
    """
    samples, sync_times = contacts.samples, times - float(contacts.t_s[0] - contacts.samples[0].t_s)
    every, clock, scores = max(1, round(ESTIMATE_PERIOD_S * task.array.rate_hz)), MonotonicClock(), Scores()
    for name, what in estimators.items():
        estimator: Estimator = make_shape_estimator(task, what) if isinstance(what, str) else RenewedEstimator(what)
        before_ns = clock.now_ns()
        records = replay_samples(estimator, samples, every)
        cost_us = 1e-3 * (clock.now_ns() - before_ns) / len(samples)
        score: ShapeScore = score_shape(records, truth, sync_times)
        scores[name] = {**asdict(score), "us_per_contact": cost_us}
    return scores
