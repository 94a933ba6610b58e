"""Cases of study `faults`: each kind of fault in each task, phase and plant, and files that are wrong.

The number of a case counts through kinds, tasks, phases, plants and draws, and seeds what is left to chance: which
node has the fault, when in the phase it begins, how long it lasts, and its values.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial
from random import Random
from typing import Any

from canprobe.cell.emulated.array_faults import CELL_FAULTS
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.motion import parked_posture
from canprobe.cell.scene.geometry import transform
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Arm, Setup
from canprobe.fieldbus.tools.faults import Fault, FaultKind
from canprobe.fieldbus.tools.faults.fault import FOREVER_NS
from canprobe.mechanics.robot.model import ArmModel, joints_to_units
from canprobe.mechanics.types import Floats

KINDS = tuple(CELL_FAULTS.values())
PHASES = ("start", "approach", "contact", "lift-off")
PLANTS = ("ideal", "dynamic")
TASKS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "press": ("press", {"task.force_n": 3.0, "task.duration_s": 0.6}),
    "weave": ("cylinder", {"task.duration_s": 4.0, "shape.also": ()}),
    "straight": (
        "cylinder",
        {"task.strategy": "straight", "task.width_mm": None, "task.duration_s": 4.0, "shape.also": ()},
    ),
    "explore": ("explore", {"task.duration_s": 4.0}),
    "calibrate": ("calibrate", {"task.touches": 2, "task.clearance_mm": 2.0}),
}
"""Packaged scene of each task, and what makes it as short as it can be: a scan behind an image that no longer changes
leaves the surface within three seconds."""
CLEARANCE_MM = 1.0
CONTACT_SHARE = 0.4
"""Share of the time in contact in which a fault begins; in the rest it acts."""
LIFT_OFF_NS = 300_000_000
ARRAY_SHARE = 0.3
"""Share of the faults of any node that hit the array."""
Windows = Mapping[str, tuple[int, int]]
"""Beginning and end of each phase in a run without faults, ns."""

_BOTH_WAYS = ("drop", "delay", "duplicate", "corrupt")
"""A frame that the wire corrupts is dropped for its CRC-15, all but one in 10¹⁰; a frame that is corrupted here stands
for errors behind it: in a controller's memory, a driver, a gateway."""
_DRAWN: Mapping[str, Callable[[Random], float]] = {
    "ms": lambda rng: round(10 ** rng.uniform(-1.0, 1.5), 3),
    "gap_ms": lambda rng: round(rng.uniform(0.2, 2.0), 3),
    "counts": lambda rng: rng.choice((-1, 1)) * round(10 ** rng.uniform(1.0, 4.3)),
    "command": lambda rng: rng.choice((2, 128, 129)),
    "state": lambda rng: rng.choice((4, 127)),
    "gain": lambda rng: round(rng.uniform(0.1, 0.9), 2),
    "images": lambda rng: rng.choice((1, 20)),
    "first": lambda rng: rng.randrange(4, 9),
    "rows": lambda rng: rng.randrange(1, 5),
    "counts_s": lambda rng: round(10 ** rng.uniform(0.0, 2.0), 1),
    "permille": lambda rng: rng.choice((10, 100, 500)),
}
"""How values of parameters are drawn; the others have their defaults."""


@dataclass(frozen=True, slots=True)
class FaultCase:
    """One run with a fault.

    Attributes:
        number: its number.
        kind: kind of the fault.
        task: key of `TASKS`.
        phase: phase in which the fault begins.
        plant: fidelity of the plant.
    """

    number: int
    kind: FaultKind
    task: str
    phase: str
    plant: str

    @classmethod
    def of(cls, number: int) -> FaultCase:
        """The case of a number."""
        rest, kind = divmod(number, len(KINDS))
        rest, task = divmod(rest, len(TASKS))
        rest, phase = divmod(rest, len(PHASES))
        return cls(number, KINDS[kind], tuple(TASKS)[task], PHASES[phase], PLANTS[rest % len(PLANTS)])

    def fault(self, drives: tuple[int, ...], array: int, windows: Windows) -> Fault:
        """The fault, drawn for nodes and phases of its task.

        Args:
            drives: ids of the drives.
            array: id of the array.
            windows: phases of the task.
        """
        rng, kind = Random(f"fault {self.number}"), self.kind
        at_array = kind.needs == "array" or (kind.needs == "node" and rng.random() < ARRAY_SHARE)
        return Fault(
            kind,
            node_id=array if at_array else rng.choice(drives),
            start_ns=rng.randrange(*windows[self.phase]),
            duration_ns=rng.choice((FOREVER_NS, int(10 ** rng.uniform(7.0, 9.0)))),
            share=rng.choice((1.0, 1.0, 0.5, 0.1)),
            incoming=kind.name in _BOTH_WAYS and rng.random() < 0.4,
            values={name: _DRAWN[name](rng) for name in kind.parameters if name in _DRAWN},
            seed=rng.randrange(2**32),
        )


CASES = len(KINDS) * len(TASKS) * len(PHASES) * len(PLANTS)
"""Number of cases of one draw."""


@cache
def task_scene(task: str, plant: str) -> Scene:
    """The scene of a task."""
    name, changes = TASKS[task]
    return load_scene(name, {"task.clearance_mm": CLEARANCE_MM, "plant.fidelity": plant, **changes})


@cache
def task_plan(task: str, plant: str) -> Plan:
    """The plan of a task, the same for all seeds."""
    return make_plan(resolve(task_scene(task, plant)))


# Files that are wrong: the emulated arm, tool, layer or array is not what its file says.

DEEP_MM = 25.0
"""Clearance where the tool is not as long as its file says."""
ZERO_OFF_DEG = 5.0
TrueArm = Callable[[Setup, Arm, int], ArmModel]
"""Setup, arm as its file has it, axis -> the arm that is there."""


def _geared(factor: float, setup: Setup, arm: Arm, axis: int) -> ArmModel:
    """An arm whose drive counts so many times more than its file says, right in its first posture."""
    model, q0 = arm.model, parked_posture(setup, arm)
    units = model.units_per_q.copy()
    units[axis] *= factor
    return replace(model, units_per_q=units, zero_units=joints_to_units(model, q0) - units @ q0)


def _zero_off(setup: Setup, arm: Arm, axis: int) -> ArmModel:
    """An arm whose joint stands elsewhere than its drive says; its base is where the start point needs it."""
    fixed: Floats = arm.model.chain.fixed.copy()
    fixed[axis] = fixed[axis] @ transform((0.0, 0.0, 0.0), (0.0, 0.0, ZERO_OFF_DEG))
    return replace(arm.model, chain=replace(arm.model.chain, fixed=fixed))


ARM_FILES: Mapping[str, TrueArm] = {
    "true gear × ½": partial(_geared, 0.5),
    "true gear × 2": partial(_geared, 2.0),
    "other sign": partial(_geared, -1.0),
    "zero off by 5°": _zero_off,
}
"""Wrong numbers of one joint."""
OTHER_FILES: Mapping[str, Mapping[str, Any]] = {
    "tool 20 mm longer than its file": {"plant.tool_error_mm": (0, 0, 20), "task.clearance_mm": DEEP_MM},
    "tool 20 mm shorter than its file": {"plant.tool_error_mm": (0, 0, -20), "task.clearance_mm": DEEP_MM},
    "stiffness of the file × ¼": {"probe.stiffness_n_m3": 1.27e8 / 4, "plant.stiffness_n_m3": 1.27e8},
    "stiffness of the file × 10": {"probe.stiffness_n_m3": 1.27e9, "plant.stiffness_n_m3": 1.27e8},
    "calibration of an array that reads × 0.7": {},
}
"""Wrong numbers that are of no joint, as changes of the scene."""
FOREIGN = tuple(OTHER_FILES)[-1]


@dataclass(frozen=True, slots=True)
class WrongFile:
    """A first touch with a file that is wrong.

    Attributes:
        what: key of `ARM_FILES` or `OTHER_FILES`.
        joint: number of the joint, from 1; 0 where it is of none.
        plant: fidelity of the plant.
    """

    what: str
    joint: int
    plant: str

    def plan(self) -> Plan:
        """The plan of the touch."""
        setup = resolve(load_scene(task_scene("press", self.plant), OTHER_FILES.get(self.what, {})))
        if self.joint:
            assert setup.arm is not None
            model = ARM_FILES[self.what](setup, setup.arm, self.joint - 1)
            setup = replace(setup, truth=replace(setup.truth, model=model))
        return make_plan(setup)

    def faults(self, array: int) -> tuple[Fault, ...]:
        """A foreign calibration is an array whose taxels measure less, from the beginning on."""
        return (Fault(CELL_FAULTS["gain-lost"], array, values={"gain": 0.7}),) if self.what == FOREIGN else ()


def wrong_files(joints: int) -> list[WrongFile]:
    """All wrong files of an arm with so many joints."""
    arms = [WrongFile(what, joint, plant) for what in ARM_FILES for joint in range(1, joints + 1) for plant in PLANTS]
    return [*arms, *(WrongFile(what, 0, plant) for what in OTHER_FILES for plant in PLANTS)]
