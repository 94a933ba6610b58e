"""Study `pipeline`: whether the online estimator's 95 % regions hold the truth with the whole sensor pipeline on.

Each cell is a lockstep scan of a packaged scene with one seed: array with blur, gain spread, hysteresis, creep,
crosstalk, noise and 8 bits, joint counts, delays, servo and plant. Every answer of the estimator in the loop after the
first 20 mm is scored against the truth at the instant of its last contact: the share of regions of (K11, K12, K22) that
hold it, and each entry's error over its stated deviation (z: mean 0 and RMS 1 for a right model).

The loop's noise model was set on the seeds `CALIBRATION` (and some of 100 and 101) and is verified on `VERIFICATION`,
which were not used for it. The table also has the errors of the contacts (height over the surface, tilt of the normal,
and the path along which they last): single contacts err less than the model says, but their errors last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.planning.make import make_plan
from canprobe.results.picture import BLUE, GREY, INK, SHADE, legend, log_scale, picture
from canprobe.results.scores import RUN_IN_M, curvature_tensor
from canprobe.scene.load import load_scene
from canprobe.scene.resolve import resolve
from canprobe.session.session import Session, resolve_scene
from canprobe.studies.harness import CHI2_95_OF_3, FROBENIUS, Array, Column, Row, StudyResult, measuring_facts
from canprobe.studies.sweep import Sweep
from canprobe.tasks.from_plan import make_task
from canprobe.tasks.shape import ShapeRecord
from canprobe.touch.contact import ContactSample

SCENES = ("cylinder", "sphere", "plane", "saddle", "ellipsoid", "bowl", "torus", "wave", "fillet")
ASKED = (0.90, 0.99)
CALIBRATION, VERIFICATION = range(2), range(102, 107)
DURATION_S = 10.0
_ROOMS = ("touch", "robot", "protocol", "planning", "cell", "session", "tasks", "emulator", "scenes")
MODEL = (*_ROOMS, "studies/pipeline.py")
ENTRIES = ("K11", "K12", "K22")
COLUMNS = (
    Column("scene", "scene"),
    Column("seeds", "seeds"),
    Column("answers", "answers"),
    Column("observed", "observed", ".3f"),
    Column("error_per_m", "error 1/m", ".2f"),
    Column("claimed_per_m", "claimed 1/m", ".2f"),
    Column("coverage", "cover", ".3f"),
    Column("within", "90-99 %"),
    *(Column(f"z_rms_{entry}", f"z {entry}", ".2f") for entry in ENTRIES),
    *(Column(f"z_mean_{entry}", f"mean z {entry}", ".2f") for entry in ENTRIES),
    Column("height_um", "height µm", ".0f"),
    Column("tilt_mrad", "tilt mrad", ".2f"),
    Column("lasts_mm", "lasts mm", ".1f"),
)


def run(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Scan the scenes."""
    scenes = SCENES[:1] if quick else SCENES
    groups = {"verification": VERIFICATION[:1]} if quick else {"calibration": CALIBRATION, "verification": VERIFICATION}
    duration = 1.8 if quick else DURATION_S
    cells = [(scene, seed, duration) for seeds in groups.values() for seed in seeds for scene in scenes]
    sweep.say(f"{len(cells)} scans of {duration:g} s")
    found = dict(zip(cells, sweep.map(measure, cells, model=MODEL), strict=True))
    every = [(scene, (scene,)) for scene in scenes]
    rows = [
        row_of(label, name, [found[scene, seed, duration] for scene in some for seed in seeds])
        for labels in (every, [("all", scenes)])
        for name, seeds in groups.items()
        for label, some in labels
    ]
    facts = measuring_facts(quick, sum(map(len, groups.values())), MODEL)
    return StudyResult("pipeline", COLUMNS, rows, findings(rows), facts, partial(draw_pipeline, rows))


def measure(cell: tuple[str, int, float]) -> dict[str, Any]:
    """One scan: the errors of its answers and of its contacts."""
    name, seed, duration = cell
    scene = resolve_scene(load_scene(name), seed=seed, duration_s=duration)
    if scene.shape is not None:
        scene = replace(scene, shape=replace(scene.shape, also=()))
    task: Any = make_task(make_plan(resolve(scene)))
    with Session(scene) as session:
        session.run(task)
    times = session.cell.log.arrays()["t_s"]
    late = [r for r in task.shape.records if r.travelled_m >= RUN_IN_M]
    return {
        "answers": [scored(r, session.truth, times) for r in late if r.estimate.rank == 3],
        "late": len(late),
        "contacts": contact_errors(task.shape.samples, session.truth, times),
    }


def scored(record: ShapeRecord, truth: dict[str, Array], times: Array) -> list[float]:
    """Error (3) of K11, K12, K22, their standard deviations (3), and the error's squared length in the region's."""
    row = _row(record.t_s, times)
    P = record.estimate.T_frame_contact[:3, :2]
    D = record.estimate.K - P.T @ curvature_tensor(*(truth[k][row] for k in ("kappa", "direction1", "direction2"))) @ P
    e, C = np.array([D[0, 0], D[0, 1], D[1, 1]]), record.estimate.covariance
    return [*e.tolist(), *np.sqrt(np.diag(C)).tolist(), float(e @ np.linalg.solve(C, e))]


def contact_errors(samples: Sequence[ContactSample], truth: dict[str, Array], times: Array) -> dict[str, float]:
    """RMS height (m) and tilt per axis (rad) of the contacts, and the path (m) along which tilt errors last."""
    rows = np.array([_row(s.t_s, times) for s in samples])
    normals, points = truth["contact_normal"][rows], truth["contact_point"][rows]
    offset = np.array([s.p_base for s in samples]) - points
    tilt = np.array([s.n_base for s in samples]) - normals
    height = np.einsum("ij,ij->i", offset, normals)
    step = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    tilt = tilt - tilt.mean(axis=0)
    power = np.array([float(np.mean(np.einsum("ij,ij->i", tilt[k:], tilt[: len(tilt) - k]))) for k in range(200)])
    below = np.flatnonzero(power < power[0] / math.e)
    return {
        "height": float(np.sqrt(np.mean(np.square(height - height.mean())))),
        "tilt": math.sqrt(power[0] / 2.0),
        "lasts": step * float(below[0] if len(below) else len(power)),
    }


def _row(t_s: float, times: Array) -> int:
    return int(np.searchsorted(times, t_s - 1e-6))


def row_of(scene: str, group: str, cells: Sequence[dict[str, Any]]) -> Row:
    """One row of the table: a scene over its seeds."""
    answers = np.array([a for cell in cells for a in cell["answers"]]).reshape(-1, 7)
    errors, sigmas, squares = answers[:, :3], answers[:, 3:6], answers[:, 6]
    z = errors / sigmas
    coverage = float(np.mean(squares < CHI2_95_OF_3))
    contacts = {k: float(np.sqrt(np.mean([c["contacts"][k] ** 2 for c in cells]))) for k in ("height", "tilt", "lasts")}
    return {
        "scene": scene, "seeds": group, "answers": len(answers),
        "observed": len(answers) / max(sum(cell["late"] for cell in cells), 1),
        "error_per_m": math.sqrt(float(np.mean(errors**2 @ FROBENIUS))),
        "claimed_per_m": math.sqrt(float(np.mean(sigmas**2 @ FROBENIUS))),
        "coverage": coverage, "within": "below" if coverage < ASKED[0] else "above" if coverage > ASKED[1] else "yes",
        **{f"z_rms_{entry}": float(np.sqrt(np.mean(z[:, i] ** 2))) for i, entry in enumerate(ENTRIES)},
        **{f"z_mean_{entry}": float(np.mean(z[:, i])) for i, entry in enumerate(ENTRIES)},
        "height_um": contacts["height"] * 1e6, "tilt_mrad": contacts["tilt"] * 1e3, "lasts_mm": contacts["lasts"] * 1e3,
    }  # fmt: skip


def findings(rows: Sequence[Row]) -> list[str]:
    """Coverage of each group, and the scenes outside 90–99 %."""
    said = []
    for row in rows:
        if row["scene"] == "all":
            said.append(
                f"{row['seeds']} seeds: {100 * row['coverage']:.1f} % of {row['answers']} regions of the online "
                "estimator hold the truth (asked for: 90–99 %), z RMS "
                + ", ".join(f"{entry} {row[f'z_rms_{entry}']:.2f}" for entry in ENTRIES)
                + "."
            )
        elif row["within"] != "yes":
            said.append(f"  {row['scene']}, {row['seeds']} seeds: {100 * row['coverage']:.1f} %, {row['within']} that.")
    return said


COLOURS = {"calibration": GREY, "verification": BLUE}
ENTRY_MARKS = {"K11": "o", "K12": "s", "K22": "D"}


def draw_pipeline(rows: Sequence[Row], path: Path) -> None:
    """Coverage, and z of each entry, by scene."""
    scenes = list(dict.fromkeys(r["scene"] for r in rows))
    groups = list(dict.fromkeys(r["seeds"] for r in rows))
    title = (
        "The online estimator with the whole sensor pipeline on: share of its 95 % regions that hold the truth,\n"
        "and errors of the entries of K over their stated standard deviation (RMS); shade: target"
    )
    with picture(path, title, 4.4) as figure:
        left, right = figure.subplots(1, 2)
        left.axhspan(0.90, 0.99, color=SHADE, linewidth=0, zorder=0)
        left.axhline(0.95, color=INK, linewidth=0.8)
        right.axhline(1.0, color=INK, linewidth=0.8)
        for j, group in enumerate(groups):
            mine = [r for r in rows if r["seeds"] == group]
            x = np.array([scenes.index(r["scene"]) for r in mine]) + 0.3 * (j - 0.5 * (len(groups) - 1))
            name = f"{group} seeds"
            left.scatter(x, [r["coverage"] for r in mine], s=30, color=COLOURS[group], label=name, zorder=3)
            for i, (entry, mark) in enumerate(ENTRY_MARKS.items()):
                y = [r[f"z_rms_{entry}"] for r in mine]
                label = f"{entry}, {name}"
                right.scatter(x + 0.07 * (i - 1), y, s=18, marker=mark, color=COLOURS[group], label=label, zorder=3)
        left.set_ylim(min(0.88, *(r["coverage"] - 0.02 for r in rows)), 1.01)
        log_scale(right, "y")
        left.set(title="coverage", ylabel="share of regions")
        right.set(title="error over stated σ", ylabel="RMS of z")
        for axes in (left, right):
            axes.set_xticks(range(len(scenes)), scenes, rotation=30, ha="right", rotation_mode="anchor")
            axes.set_xlim(-0.6, len(scenes) - 0.4)
            axes.grid(visible=False, axis="x")
        legend(figure)
