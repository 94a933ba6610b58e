"""Scores of one random scene: each answer of the estimator in the loop against the truth at its last contact.

An answer counts from the first 20 mm of path on. Its region of (K11, K12, K22) holds the truth or not; its error and
what it states are compared as Frobenius norms; and it gives the truth a density. Where the true curvature has jumped
within the last 1.5 mm of the way of the contact, no answer of a smooth surface can be right: these are scored apart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.results.scores import RUN_IN_M, curvature_tensor, score_measured_force, summarise_map
from canprobe.cell.scene.model import highest
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.errors import PlanError, SafetyStop
from canprobe.lab.studies.random_scenes import DrawnScene, SceneSeed, random_scene
from canprobe.lab.studies.result import CHI2_95_OF_3, FROBENIUS
from canprobe.mechanics.types import Floats

BEHIND_JUMP_M = 1.5e-3
"""Way behind a jump of the surface on which answers are scored apart."""
JUMP_PER_M, JUMP_WAY_M = 10.0, 0.5e-3
"""A jump: least change of the principal curvatures, and the way within which they change."""


class ScoredScan(NamedTuple):
    """The result of a scan.

    Attributes:
        seed: seed of the scene.
        kind: kind of the scene: that of its object, or "foreign".
        object: kind of the object.
        cell, array, path: cell, group of the array, and strategy.
        speed_mm_s, force_n, full_scale_kpa: speed, force, and full scale of the array.
        tool_error_mm: error of the tool.
        ended: why it was refused or stopped; empty for a whole scan.
        late: number of answers after the run-in that are not behind a jump.
        scores: (n, 5) of those that observe all of K: time (s), squared error and stated variance (Frobenius), squared
            length of the error in the region's, and the logarithm of the density at the truth.
        behind_late, behind: the same of those behind a jump.
        noticed: whether the cell found the array not to be as its calibration says.
        force: share of the seconds in which the force errs by 2σ or less.
        bands, relative_bands: shares of the map's places whose height errs by 2σ or less, and by 2σ against the rest of
            the surface. NaN where nothing was touched, as for the force.
    """

    seed: int
    kind: str
    object: str
    cell: str
    array: str
    path: str
    speed_mm_s: float
    force_n: float
    full_scale_kpa: float
    tool_error_mm: float
    ended: str
    late: int
    scores: Floats
    behind_late: int
    behind: Floats
    noticed: bool = False
    force: float = math.nan
    bands: float = math.nan
    relative_bands: float = math.nan

    @property
    def share(self) -> float:
        """Share of the answers whose region holds the truth; NaN without any."""
        return float(np.mean(self.scores[:, 3] < CHI2_95_OF_3)) if len(self.scores) else math.nan

    @property
    def error_per_m(self) -> float:
        """RMS error, 1/m."""
        return math.sqrt(float(np.mean(self.scores[:, 1])))

    @property
    def stated_per_m(self) -> float:
        """RMS of the stated standard deviation, 1/m."""
        return math.sqrt(float(np.mean(self.scores[:, 2])))

    @classmethod
    def of(cls, answer: list[Any]) -> ScoredScan:
        """A scan as a sweep gives it."""
        scan = cls(*answer)
        scores, behind = (np.array(rows).reshape(-1, 5) for rows in (scan.scores, scan.behind))
        return scan._replace(scores=scores, behind=behind)


def held_share(scans: Sequence[ScoredScan]) -> float | None:
    """Share of the regions of some scans that hold the truth; None without any."""
    squares = [scan.scores[:, 3] for scan in scans if len(scan.scores)]
    return float(np.mean(np.concatenate(squares) < CHI2_95_OF_3)) if squares else None


def measure(seed: int) -> ScoredScan:
    """Carry out the scan of one scene and score it."""
    with TemporaryDirectory() as folder:
        drawn = random_scene(seed, Path(folder))
        try:
            session = Session(drawn.scene)
            if drawn.array is not None:
                session.buses.world.plant.array = drawn.array
            task: Any = make_task(session.plan)
        except PlanError as refusal:
            return as_scan(drawn, f"refused: {str(refusal).splitlines()[0]}", [], [])
        ended = ""
        try:
            with session:
                session.run(task)
        except SafetyStop as stop:
            ended = f"stopped: {stop.reason}"
    scan = as_scan(drawn, ended, *scores_of(session, task.shape.records))._replace(noticed=bool(task.remarks))
    if not task.shape.samples:
        return scan
    log, truth = session.cell.log.arrays(), session.buses.truth
    first = int(np.searchsorted(log["t_s"], task.shape.samples[0].t_s))
    score = score_measured_force(log, truth, first, len(log["t_s"]))
    heights = summarise_map(task.shape.surface_map, session.plan.setup.truth.object)
    held = heights["within_2_sigma_fraction"], heights["within_2_sigma_relative_fraction"]
    bands, relative = (math.nan if share is None else share for share in held)
    return scan._replace(force=score["force_within_2_sigma_fraction"], bands=bands, relative_bands=relative)


def as_scan(drawn: DrawnScene, ended: str, late: list[list[float]], behind: list[list[float]]) -> ScoredScan:
    """A scan with the facts of its scene; a row of scores is empty where an answer does not observe all of K."""
    scene = drawn.scene
    assert scene.sensor is not None and scene.plant is not None
    return ScoredScan(
        scene.seed, SceneSeed.of(scene.seed).kind, drawn.kind, scene.cell.name, drawn.group, scene.task.strategy,
        highest(scene.task.speed_mm_s), highest(scene.task.force_n), scene.sensor.full_scale_kpa,
        float(np.linalg.norm(scene.plant.tool_error_mm)), ended,
        len(late), np.array([row for row in late if row]).reshape(-1, 5),
        len(behind), np.array([row for row in behind if row]).reshape(-1, 5),
    )  # fmt: skip


def scores_of(session: Session, records: list[ShapeRecord]) -> tuple[list[list[float]], list[list[float]]]:
    """Scores of the answers after the run-in, and of those behind a jump; a row is empty without all of K."""
    late: list[list[float]] = []
    behind: list[list[float]] = []
    if records:
        times, jumped = session.cell.log.arrays()["t_s"], behind_jump(session.buses.truth)
        for record in (r for r in records if r.travelled_m >= RUN_IN_M):
            row = int(np.searchsorted(times, record.t_s - 1e-6))  # of the truth at its last contact
            (behind if jumped[row] else late).append(
                scored(record, session.buses.truth, row) if record.estimate.rank == 3 else []
            )
    return late, behind


def scored(record: ShapeRecord, truth: Mapping[str, Floats], row: int) -> list[float]:
    """One row of `ScoredScan.scores`, in the axes of the answer."""
    P = record.estimate.T_frame_contact[:3, :2]
    tensor = curvature_tensor(*(truth[k][row] for k in ("kappa_per_m", "direction1", "direction2")))
    D = record.estimate.K - P.T @ tensor @ P
    e, C = np.array([D[0, 0], D[0, 1], D[1, 1]]), record.estimate.covariance
    square = float(e @ np.linalg.solve(C, e))
    density = -0.5 * (square + float(np.linalg.slogdet(2.0 * math.pi * C)[1]))
    return [record.t_s, float(e**2 @ FROBENIUS), float(np.diag(C) @ FROBENIUS), square, density]


def behind_jump(truth: Mapping[str, Floats]) -> NDArray[np.bool_]:
    """Which rows (n,) of the truth lie within `BEHIND_JUMP_M` of way behind a jump of the principal curvatures."""
    steps = np.linalg.norm(np.diff(truth["contact_point_m"], axis=0), axis=1)
    way = np.concatenate(([0.0], np.cumsum(steps)))
    before = np.searchsorted(way, way - JUMP_WAY_M)
    jumps = np.linalg.norm(truth["kappa_per_m"] - truth["kappa_per_m"][before], axis=1) > JUMP_PER_M
    onset = jumps & ~np.concatenate(([False], jumps[:-1]))
    return way - np.maximum.accumulate(np.where(onset, way, -np.inf)) < BEHIND_JUMP_M
