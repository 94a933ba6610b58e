"""The runs that press hardest, of which the pages on limits and supervision speak. `python docs/hard_cases.py [NAME …]`

`docs/measure.py` takes the table from here, and `tests/test_pages_measured.py` repeats runs of it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from canprobe.cell.emulated.array_faults import CELL_FAULTS
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks.task import Phase
from canprobe.fieldbus.tools.faults import Fault
from canprobe.lab.studies import recover
from canprobe.lab.studies.fault_cases import FaultCase
from canprobe.lab.studies.fault_runs import FaultRun, run_case

HEADINGS = ("name", "what happens", "highest true force, N", "above the limit, ms", "ends with")
Score = Mapping[str, Any]


def of_study(number: int) -> Score:
    """A run of study `faults`."""
    return run_case(FaultCase.of(number))


def from_phase(scene: str, changes: Mapping[str, Any], phase: Phase, after_s: float, kind: str, **fault: Any) -> Score:
    """A run of a scene with a fault that begins a time after a phase has."""
    plan = make_plan(resolve(load_scene(scene, changes)))
    begin_ns = FaultRun(plan).begun[phase] + round(after_s * 1e9)
    return FaultRun(plan, (Fault(CELL_FAULTS[kind], start_ns=begin_ns, **fault),)).result()


def press(clearance_mm: float, phase: Phase, kind: str, speed_mm_s: float = 4.0, **fault: Any) -> Score:
    """A press of 3 N whose array has a fault from the beginning of a phase on."""
    changes = {"task.clearance_mm": clearance_mm, "task.force_n": 3.0, "task.duration_s": 0.5}
    changes["task.approach_mm_s"] = speed_mm_s
    return from_phase("press", changes, phase, 0.0, kind, node_id=16, **fault)


def stuck_joint(scene: str, joint: int, after_s: float) -> Score:
    """A scan in which the brake of a joint sticks for a second, a time after it has begun."""
    changes = {"task.duration_s": 3.0, "shape.also": ()}
    return from_phase(scene, changes, Phase.SCAN, after_s, "brake-stuck", node_id=joint, duration_ns=10**9)


def fading(speed_mm_s: float) -> Score:
    """A scan whose array reads ever less."""
    changes = {"task.speed_mm_s": speed_mm_s, "task.duration_s": 8.0, "shape.also": ()}
    return from_phase("cylinder", changes, Phase.SCAN, 0.5, "drift", node_id=16, values={"counts_s": -30.0})


def lost_while_others_move(seed: int) -> Score:
    """A run of study `recover` in which a joint stops without a word."""
    run = recover.run_case(recover.draw_case(seed))
    return {**run, "above_ms": 0.0, "outcome": "the cell came back" if run["back"] else "somebody has to look"}


CASES: Mapping[str, tuple[str, Callable[[], Score]]] = {
    "replayed-1": ("one image comes again and again, with noise: explore, dynamic plant", partial(of_study, 1727)),
    "replayed-20": ("twenty images come again and again, with noise: weave, dynamic plant", partial(of_study, 1625)),
    "gain-0.3": (
        "array reads 0.3 of the force since before its first contact: press",
        partial(press, 4.0, Phase.MOVE, "gain-lost", values={"gain": 0.3}),
    ),
    **{
        f"fading-{speed:g}mm_s": (
            f"array reads 30 counts less each second: cylinder at {speed:g} mm/s",
            partial(fading, speed),
        )
        for speed in (2.0, 10.0)
    },
    "dead-rows": ("four of sixteen rows dead in the middle of the first contact: press", partial(of_study, 297)),
    "half-torque": ("drive of joint 2 loses half of its torque: explore, dynamic plant", partial(of_study, 1469)),
    "no-torque": (
        "drive of joint 2 loses 0.9 of its torque between two touches: calibrate, dynamic plant",
        partial(of_study, 2030),
    ),
    "zero-2": ("zero of joint 2 shifts before the first motion: calibrate", partial(of_study, 244)),
    "zero-3": ("zero of joint 3 shifts before the first motion: explore", partial(of_study, 1213)),
    **{
        f"blind-{mm:g}mm": (
            f"array keeps its image from the beginning of an approach of {mm:g} mm on: press",
            partial(press, mm, Phase.APPROACH, "stuck-image"),
        )
        for mm in (4.0, 1.0, 0.5, 0.1)
    },
    **{
        f"blind-{speed:g}mm_s": (
            f"array keeps its image from the beginning of an approach of 1 mm at {speed:g} mm/s on: press",
            partial(press, 1.0, Phase.APPROACH, "stuck-image", speed),
        )
        for speed in (2.0, 1.0, 0.5)
    },
    **{
        f"stuck-{scene}-{joint}-{after_s:g}s": (
            f"brake of joint {joint} sticks {after_s:g} s after the scan has begun: {scene}",
            partial(stuck_joint, scene, joint, after_s),
        )
        for scene, joint, after_s in (("plane", 3, 0.0), ("plane", 3, 0.8), ("sphere", 3, 0.0), ("sphere", 2, 1.5))
    },
    "recover-789": ("a drive stops without a word: scan at 25 mm/s", partial(lost_while_others_move, 789)),
    "recover-980": ("a drive stops without a word as the probe settles", partial(lost_while_others_move, 980)),
}


def row(name: str) -> list[str]:
    """One row of the table, carried out."""
    what, run = CASES[name]
    score = run()
    return [name, what, f"{score['force_max_n']:.1f}", f"{score['above_ms']:.0f}", score["outcome"]]


def table(names: Sequence[str] = tuple(CASES)) -> list[list[str]]:
    """Headings and rows."""
    return [list(HEADINGS), *map(row, names)]


if __name__ == "__main__":
    for cells in table(sys.argv[1:] or tuple(CASES)):
        print(" | ".join(cells))
