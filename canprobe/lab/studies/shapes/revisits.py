"""The estimator in the loop on ground that it comes back to: its own answers beside those joined with the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from canprobe.cell.results.picture import INK, SKY, legend, log_scale, picture
from canprobe.cell.tasks.from_plan import make_shape_estimator
from canprobe.cell.tasks.shape import ShapeRecord, replay_samples
from canprobe.lab.studies.harness import Column, Row
from canprobe.lab.studies.shapes.contacts_file import read_columns, read_contacts
from canprobe.mechanics.touch.estimate.noise import CHI2_95
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.online.map_fusion import JOINED_NOTE
from canprobe.mechanics.types import Floats

METHOD, EVERY, START_M = "recursive", 8, 20e-3
"""Estimator in the loop, contacts between two answers, and path at the beginning that is not scored, m."""
COLUMNS = (
    Column("shape", "shape"),
    Column("share", "of answers", ".0%"),
    Column("own_per_m", "own 1/m", ".2f"),
    Column("joined_per_m", "joined 1/m", ".2f"),
    Column("own_coverage", "own cover", ".0%"),
    Column("joined_coverage", "joined cover", ".0%"),
)


class Revisit(NamedTuple):
    """A shape of a file of contacts."""

    shape: str
    path: str
    sha256: str


def measure(case: Revisit) -> Row:
    """Errors of K and shares of regions that hold the truth, of both, at the answers that were joined; None: none."""
    contacts, truth = read_contacts(Path(case.path), case.shape), read_columns(Path(case.path), case.shape)
    assert contacts.task.shape is not None
    tree, tensors = cKDTree(truth["truth_point"]), truth["truth_tensor"].reshape(-1, 3, 3)
    both: list[dict[float, ShapeRecord]] = []
    for revisit in (False, True):
        task = replace(contacts.task, shape=replace(contacts.task.shape, revisit=revisit))
        records = replay_samples(make_shape_estimator(task, METHOD), contacts.samples, EVERY)
        both.append({record.t_s: record for record in records})
    found: list[tuple[tuple[float, bool], ...]] = []
    answers = 0
    for t_s in both[0].keys() & both[1].keys():
        estimates = [records[t_s].estimate for records in both]
        place = tree.query(estimates[1].point)[1]
        if both[1][t_s].travelled_m < START_M or truth["truth_edge"][place]:
            continue
        answers += 1
        if estimates[0].rank == 3 and any(JOINED_NOTE in note for note in estimates[1].notes):
            found.append(tuple(_error(e.K, e.covariance, e.T_frame_contact, tensors[place]) for e in estimates))
    row: Row = {"shape": case.shape, "share": len(found) / max(answers, 1)}
    for k, name in enumerate(("own", "joined")):
        errors, held = np.array([one[k] for one in found]).reshape(-1, 2).T
        row[f"{name}_per_m"] = rms(errors) if found else None
        row[f"{name}_coverage"] = float(held.mean()) if found else None
    return row


def _error(K: Floats, covariance: Floats, T: Floats, tensor: Floats) -> tuple[float, bool]:
    """Error of K (Frobenius), 1/m, and whether its 95 % region holds the truth."""
    d = K - T[:3, :2].T @ tensor @ T[:3, :2]
    entries = np.array([d[0, 0], d[0, 1], d[1, 1]])
    return float(np.linalg.norm(d)), bool(entries @ np.linalg.solve(covariance, entries) < CHI2_95)


def findings(rows: Sequence[Row]) -> tuple[str, ...]:
    """How much better or worse the joined answers are, over the shapes."""
    known = [row for row in rows if row["own_per_m"] is not None and row["own_per_m"] > 0.0]
    if not known:
        return ("The estimator in the loop did not come back to ground that it had touched.",)
    ratio = math.exp(float(np.mean([math.log(row["joined_per_m"] / row["own_per_m"]) for row in known])))
    better = sum(row["joined_per_m"] < row["own_per_m"] for row in known)
    held = [float(np.mean([row[f"{name}_coverage"] for row in known])) for name in ("own", "joined")]
    worst = max(known, key=lambda row: row["joined_per_m"] / row["own_per_m"])
    return (
        f"On ground that was touched before `{METHOD}` joined with the map (`shape.revisit`) has {ratio:.2f} of its own"
        f" error of K, geometric mean over {len(known)} shapes; it is better on {better}, the least good is"
        f" {worst['shape']}: {worst['own_per_m']:.2f} and {worst['joined_per_m']:.2f} 1/m. Regions hold the truth in"
        f" {held[0]:.0%} and {held[1]:.0%}.",
    )


def draw(rows: Sequence[Row], path: Path) -> None:
    """Errors of both, shape by shape."""
    known = [row for row in rows if row["own_per_m"] is not None]
    title = "Error of K on ground that was touched before: the estimator in the loop, alone and joined with the map"
    with picture(path, title, 3.6) as figure:
        axes = figure.subplots()
        for name, colour, marker in (("own", SKY, "o"), ("joined", INK, "*")):
            axes.plot([row[f"{name}_per_m"] for row in known], marker, color=colour, label=name)
        axes.set_xticks(range(len(known)), [row["shape"] for row in known], rotation=30)
        axes.set_ylabel("RMS error of K (1/m)")
        log_scale(axes, "y")
        legend(figure)
