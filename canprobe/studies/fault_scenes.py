"""The scenes of the fault campaign: each as short as it can be with all its phases, planned once in a process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType

from canprobe.planning import Plan, make_plan
from canprobe.scene import Scene
from canprobe.scene_loader import load_scene
from canprobe.scene_resolve import resolve

FORCE_MAX_N = 3.0
_CLEARANCE_MM = 0.3


@dataclass(frozen=True, slots=True)
class Scenario:
    """One kind of run.

    Attributes:
        share: of the runs.
        scene: packaged scene that it is made of.
        rate_hz: of SYNC and sensor.
        duration_s: of the task itself.
        mode: of the sensor; None where the scene has none.
        speed_share: of the joints' speed limits, enough for the task: beyond it a drive takes a target for wrong.
    """

    share: float
    scene: str
    rate_hz: float
    duration_s: float
    mode: str | None
    speed_share: float = 0.1


SCENARIOS: Mapping[str, Scenario] = MappingProxyType(
    {
        "listen": Scenario(0.1, "listen", 100.0, 0.2, "features"),
        "free": Scenario(0.15, "free", 100.0, 0.3, None),
        "press, features": Scenario(0.5, "press", 100.0, 0.1, "features"),
        "press, window": Scenario(0.1, "press", 200.0, 0.1, "window"),
        "cylinder": Scenario(0.15, "cylinder", 200.0, 0.2, "window", 0.35),
    }
)
"""A lower rate than 400 Hz makes a run cheaper and the cell slower to react: reaction times are counted in cycles."""


@cache
def scenario_scene(name: str, timed: bool) -> Scene:
    """The scene of a scenario; on a bus where frames take their time, or none at all."""
    scenario = SCENARIOS[name]
    scene = load_scene(scenario.scene)
    task = replace(scene.task, duration_s=scenario.duration_s, clearance_mm=_CLEARANCE_MM)
    scene = replace(
        scene,
        task=task,
        bus=replace(scene.bus, timed=timed),
        cycle=replace(scene.cycle, rate_hz=scenario.rate_hz),
        limits=replace(scene.limits, force_max_n=FORCE_MAX_N, joint_speed_share=scenario.speed_share),
    )
    if scene.shape is not None:
        scene = replace(scene, shape=replace(scene.shape, also=()))
    if scene.sensor is not None:
        scene = replace(scene, sensor=replace(scene.sensor, rate_hz=scenario.rate_hz, mode=scenario.mode))  # type: ignore[arg-type]
    return scene


@cache
def scenario_plan(name: str, timed: bool) -> Plan:
    """Its plan: the same for all seeds."""
    return make_plan(resolve(scenario_scene(name, timed)))


def seeded_plan(name: str, timed: bool, seed: int) -> Plan:
    """The plan of one run."""
    plan = scenario_plan(name, timed)
    setup = plan.setup
    scene = replace(setup.scene, scene=replace(setup.scene.scene, seed=seed))
    return replace(plan, setup=replace(setup, scene=scene, seed=seed))
