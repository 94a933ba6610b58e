"""Extreme cases of study `stability`, in one table: each ends right, refused by the plan, or stopped with the reason.

A case is the packaged scene `press` or `cylinder` with one thing at an extreme: dead rows of the array, counts of a few
bits, a layer from 10⁴ to 10¹² N/m³, a servo from 50 to 1000 Hz, drives from 3 to 300 Hz, an object of 5 mm to 10 m, a
probe of 1 mm, encoders up to 100 × as coarse, ten times the speed, arm or wrist at or near a singular pose, a period
that jitters. Nothing else is adapted to it.

`right`: it ran to its end, the true force is within `FORCE_PERCENT` of the target (RMS), and the curvature of a scan is
within `CURVATURE_SHARE` of κ + 1/R_p, or within what it states, or said to be not observed. `wrong`: it ran to its end
and is not right, or failed as a touch of `stability_runs` can. Values beyond the limits of a scene file are set too.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D

from canprobe.cell.results.picture import AMBER, BLUE, GREY, ORANGE, legend, picture
from canprobe.cell.scene.geometry import T_flange_probe
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import ProbeSettings, Scene, highest
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.touch import TouchTask
from canprobe.errors import PlanError
from canprobe.fieldbus.protocol.frames import SYNC_ID
from canprobe.lab.studies.random_scenes import CELLS
from canprobe.lab.studies.region_scores import scores_of
from canprobe.lab.studies.result import CHI2_95_OF_3, Row, StudyResult, measuring_facts
from canprobe.lab.studies.stability_runs import changed, delay, refused_row, run_touch
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.inverse import inverse_near

SENSOR_HZ = {500.0: 250.0}
"""Rate of the tactile frames where 200 Hz does not divide the servo's."""
HOLD_S, SCAN_S = 1.0, 2.0
FORCE_PERCENT, CURVATURE_SHARE = 20.0, 0.1
HELD_SHARE = 0.5
"""Least share of the answers of a scan whose regions hold the truth: the answers of one memory are one draw."""
MODEL = (
    "fieldbus", "mechanics", "cell", "scenes", "cells", "arrays", "calibrations", "lab/studies/stability_runs.py",
    "lab/studies/stability_extremes.py", "lab/studies/region_scores.py", "lab/studies/random_scenes.py",
)  # fmt: skip
COLUMNS = (
    "extreme", "value", "task", "ended", "force_max_n", "error_percent", "curvature_per_m", "stated_per_m", "held",
    "reason",
)  # fmt: skip
END_MARKS = {
    "right": (BLUE, "o", "right"),
    "stopped": (AMBER, "s", "stopped with the reason"),
    "refused": (GREY, "X", "refused by the plan"),
    "wrong": (ORANGE, "v", "wrong"),
}
"""Colour, marker and words of each end."""


@dataclass(frozen=True, slots=True)
class ExtremeCase:
    """One case: the extreme thing, its value, and whether the scene is a scan."""

    extreme: str
    value: float
    scan: bool


def run_extremes(*, quick: bool, sweep: Sweep) -> StudyResult:
    """Carry out all cases."""
    cases = [
        ExtremeCase(name, value, scan)
        for name, (values, *_) in (list(EXTREMES.items())[:1] if quick else EXTREMES.items())
        for value in (values[:1] if quick else values)
        for scan in (False, True)
        if scan or name != "speed"
    ]
    sweep.say(f"{len(cases)} extreme cases")
    rows: list[Row] = sweep.map(measure, cases, model=MODEL)
    facts = measuring_facts(quick, 1, MODEL)
    return StudyResult("stability_extremes", rows, findings(rows), facts, partial(draw_extremes, rows), COLUMNS)


def extreme_scene(case: ExtremeCase) -> Scene:
    """The scene of a case."""
    name, seconds = ("cylinder", SCAN_S) if case.scan else ("press", HOLD_S)
    scene = load_scene(name, {"task.duration_s": seconds, "task.clearance_mm": 0.5, "bus.timed": False})
    if scene.shape is not None:
        scene = changed(scene, "shape", also=())
    return EXTREMES[case.extreme][2](scene, case.value)


def _with_dead_rows(scene: Scene, rows: float) -> Scene:
    """Dead rows in the middle of the array, where it touches."""
    first = 8 - math.ceil(rows / 2)
    return changed(scene, "plant", dead_rows=tuple(range(first, first + int(rows))))


def _with_rate(scene: Scene, rate_hz: float) -> Scene:
    """The rate of the images divides that of the servo."""
    assert scene.sensor is not None
    sensor_hz = SENSOR_HZ.get(rate_hz, min(scene.sensor.rate_hz, rate_hz))
    return changed(changed(scene, "cycle", rate_hz=rate_hz), "sensor", rate_hz=sensor_hz)


def _on_sphere(scene: Scene, radius_mm: float) -> Scene:
    """A sphere where the arm reaches in all directions; a path turns its normal by 24 deg to both sides at most."""
    length, width = min(scene.task.length_mm, 0.8 * radius_mm), min(scene.task.width_mm, 0.3 * radius_mm)
    place, _ = CELLS["puma260"]
    scene = changed(scene, "task", length_mm=length, width_mm=width, start_mm=place)
    return changed(scene, "object", kind="sphere", radius_mm=radius_mm, position_mm=place)


def _at_reach(scene: Scene, reach_mm: float) -> Scene:
    """The touch in the same direction, elsewhere."""
    x, y, z = scene.task.start_mm
    share = reach_mm / math.hypot(x, y)
    return _touched_at(scene, (share * x, share * y, z))


def _with_wrist(scene: Scene, wrist_deg: float) -> Scene:
    """A gently curved object in front of the arm, with the wrist bent by an angle at the touch."""
    at_mm, normal, posture_deg = touch_in_posture((90.0, 65.0, 15.0, -360.0, wrist_deg, 0.0))
    scene = changed(scene, "object", kind="sphere", radius_mm=300.0, rotation_deg=upright(normal))
    scene = changed(_touched_at(scene, at_mm), "task", approach_normal=normal)
    joints = {
        name: replace(joint, start_deg=start)
        for (name, joint), start in zip(scene.joints.items(), posture_deg, strict=True)
    }
    return replace(scene, joints=joints)


def _touched_at(scene: Scene, place: tuple[float, ...]) -> Scene:
    scene = changed(changed(scene, "task", start_mm=place), "object", position_mm=place)
    return changed(scene, "limits", joint_margin_deg=0.5)


def touch_in_posture(posture_deg: tuple[float, ...]) -> tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]:
    """A touch with the pole of the default probe and these joint angles, deg.

    Returns:
        Its place (3,), mm; the outward normal (3,) there; joint angles (n,) 10 mm above it, deg.
    """
    arm, probe = resolve(load_scene("press")).arm, ProbeSettings()
    assert arm is not None
    model = arm.model
    q = np.radians(posture_deg)
    T_flange_centre = T_flange_probe(probe)
    T = forward(model.chain, q) @ T_flange_centre
    pole = T[:3, 2]
    above = T.copy()
    above[:3, 3] -= 10e-3 * pole
    away = np.degrees(inverse_near(model, above, T_flange_centre, q))
    at = 1e3 * T[:3, 3] + probe.radius_mm * pole
    return tuple(at.tolist()), tuple((-pole).tolist()), tuple(away.tolist())


def upright(normal: tuple[float, ...], yaw_deg: float = 20.0) -> tuple[float, float, float]:
    """Roll, pitch and yaw, deg, of an object whose z is a unit normal."""
    yaw = math.radians(yaw_deg)
    x = math.cos(yaw) * normal[0] + math.sin(yaw) * normal[1]
    y = math.cos(yaw) * normal[1] - math.sin(yaw) * normal[0]
    return math.degrees(-math.asin(y)), math.degrees(math.atan2(x, normal[2])), yaw_deg


def _with_coarser_encoders(scene: Scene, times: float) -> Scene:
    joints = {
        name: replace(joint, counts_per_turn=(joint.counts_per_turn or 0.0) / times)
        for name, joint in scene.joints.items()
    }
    return replace(scene, joints=joints)


EXTREMES: Mapping[str, tuple[tuple[float, ...], str, Callable[[Scene, float], Scene]]] = {
    "dead rows": ((1, 2, 4, 8), "{:g}", _with_dead_rows),
    "bits of a count": ((4, 6), "{:g}", lambda scene, bits: changed(scene, "plant", adc_bits=int(bits))),
    "K/h": (
        tuple(10.0**n for n in range(4, 13)), "{:.0e} N/m³",
        lambda scene, stiffness: changed(scene, "plant", stiffness_n_m3=stiffness),
    ),
    "servo": ((50, 100, 200, 500, 1000), "{:g} Hz", _with_rate),
    "drives": ((3, 10, 100, 300), "{:g} Hz", lambda scene, hz: changed(scene, "plant", drive_bandwidth_hz=hz)),
    "radius": ((5, 12, 100, 1000, 10_000), "{:g} mm", _on_sphere),
    "probe": ((1, 5, 10_000), "{:g} mm", lambda scene, radius: changed(scene, "probe", radius_mm=radius)),
    "coarser encoders": ((10, 100), "{:g} ×", _with_coarser_encoders),
    "speed": ((50, 100, 250), "{:g} mm/s", lambda scene, v: changed(scene, "task", speed_mm_s=v)),
    "reach": ((120, 135, 350, 358, 400), "{:g} mm", _at_reach),
    "joint 5": ((0, 3), "{:g} deg", _with_wrist),
    "jitter of the period": ((5, 20, 50), "{:g} %", lambda scene, _: scene),
}  # fmt: skip
"""Thing → its values, the form of one in words, and the change of a scene to one; jitter changes the bus. `reach` is
the distance of the touch from the first joint's axis: at 127 mm the shoulder is singular, at 360 mm the elbow; `joint
5` at 0 is the singular wrist."""


def value_in_words(case: ExtremeCase) -> str:
    """Value of a case with its unit, such as 1e4 N/m³."""
    return EXTREMES[case.extreme][1].format(case.value).replace("e+0", "e").replace("e+", "e")


def measure(case: ExtremeCase) -> Row:
    """Carry out a case: its row of the table."""
    row: Row = dict.fromkeys(("curvature_per_m", "stated_per_m", "held"))
    row |= {"extreme": case.extreme, "value": value_in_words(case), "task": "scan" if case.scan else "press"}
    scene = extreme_scene(case)
    try:
        session = Session(scene)
        world = session.buses.world
    except PlanError as refusal:
        return row | refused_row(refusal)
    task = make_task(session.plan)
    assert isinstance(task, TouchTask) and world.nodes
    if case.extreme == "jitter of the period":
        jitter_ns = 1e-2 * case.value * 1e9 / scene.cycle.rate_hz
        delay(world, {SYNC_ID}, partial(sync_delay_ns, jitter_ns))
    row |= run_touch(session, task, highest(scene.task.force_n))
    late, behind = scores_of(session, task.shape.records if task.shape is not None else [])
    if scores := [one for one in (*late, *behind) if one]:
        _, errors, variances, squares, _ = np.array(scores).T
        row |= {"curvature_per_m": math.sqrt(errors.mean()), "stated_per_m": math.sqrt(variances.mean())}
        row["held"] = float(np.mean(squares < CHI2_95_OF_3))
    assert scene.probe is not None
    curved_per_m = 1e3 / scene.probe.radius_mm + float(np.abs(session.buses.truth["kappa_per_m"][-1]).max())
    return row | judged(row, curved_per_m)


def sync_delay_ns(jitter_ns: float, t_ns: int) -> int:
    """Delay of the SYNC of a time, ns: the same for all nodes, as if the master had sent it late."""
    return int(np.random.default_rng(t_ns).uniform(0.0, jitter_ns))


def judged(row: Row, curved_per_m: float) -> Row:
    """How a case ended, and why.

    Args:
        row: the row of `run_touch`, with the scores of a scan.
        curved_per_m: curvature of probe and object together, 1/m.
    """
    if row["ended"] in ("stopped", "refused"):
        return {"ended": row["ended"]}
    if row["ended"] != "stable":
        return {"ended": "wrong", "reason": f"{row['ended']}: {row['reason'] or 'the force does not settle'}"}
    wrong = []
    if not (row["error_percent"] is not None and row["error_percent"] <= FORCE_PERCENT):
        wrong.append("force")
    known = row["held"] is not None
    if known and row["held"] < HELD_SHARE and row["curvature_per_m"] > CURVATURE_SHARE * curved_per_m:
        wrong.append("curvature")
    if wrong:
        return {"ended": "wrong", "reason": " and ".join(wrong)}
    return {"ended": "right", "reason": "" if known or row["task"] == "press" else "curvature not observed"}


def findings(rows: Sequence[Row]) -> list[str]:
    """Numbers of the ends, and each case that is wrong."""
    ends = Counter(str(row["ended"]) for row in rows)
    counted = ", ".join(f"{ends[end]} {words}" for end, (*_, words) in END_MARKS.items())
    said = [f"{len(rows)} extreme cases: {counted}."]
    for row in rows:
        if row["ended"] == "wrong":
            force = row["error_percent"]
            said.append(
                f"  wrong: {row['task']}, {row['extreme']} {row['value']}: {row['reason']}; true force off by "
                f"{'–' if force is None else format(force, '.0f')} % (RMS)"
            )
    return said


def draw_extremes(rows: Sequence[Row], path: Path) -> None:
    """A panel each for presses and scans: a line for each extreme thing, a mark with its value for each case."""
    names = list(dict.fromkeys(row["extreme"] for row in rows))
    title = (
        "How extreme cases end; nothing else is adapted to them\n"
        f"right: true force within {FORCE_PERCENT:g} % of its target; curvature within a tenth of κ + 1/R_p or within"
        " what is stated, or not observed"
    )
    longest = max(len(values) for values, *_ in EXTREMES.values())
    with picture(path, title, 1.8 + 0.62 * len(names)) as figure:
        panels = figure.subplots(1, 2, sharey=True)
        for axes, task in zip(panels, ("press", "scan"), strict=True):
            for line, name in enumerate(names):
                mine = [row for row in rows if (row["extreme"], row["task"]) == (name, task)]
                for column, row in enumerate(mine):
                    colour, marker, _ = END_MARKS[row["ended"]]
                    axes.plot(column, line, marker, color=colour, markersize=7)
                    text = row["value"].split()[0]
                    axes.annotate(text, (column, line), textcoords="offset points", xytext=(0, -15), ha="center")
            axes.set(title=task, xticks=[], ylim=(len(names) - 0.35, -0.5), xlim=(-0.6, longest - 0.4))
            axes.grid(visible=False)
        units = {name: form.partition(" ")[2] for name, (_, form, _) in EXTREMES.items()}
        panels[0].set_yticks(range(len(names)), [f"{n} ({units[n]})" if units[n] else n for n in names])
        legend(figure, end_marks(END_MARKS))


def end_marks(marks: Mapping[str, tuple[str, str, str]]) -> list[Line2D]:
    """The legend of some ends, each with colour, marker and words."""
    return [Line2D([], [], color=colour, marker=m, linestyle="", label=words) for colour, m, words in marks.values()]
