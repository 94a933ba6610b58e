"""One cell of the stability map: the prediction of the linear loop, a short touch in lockstep, and how it ended.

`stable`: it ran to its end. `stopped`: released and stopped, with the reason. `refused`: by the plan, with the reason.
`hunting`: it ran to its end, but the force did not settle. `failed`: a hang, a NaN, an exception of ours, or a force
above the limit for longer than the stated reaction time and the retreat.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from canprobe.cell.emulated.world import World
from canprobe.cell.master.supervision import limits_of
from canprobe.cell.plant.ideal_arm import natural_frequency
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import PlantSettings, Scene, ServoSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.cell.tasks.touch import TouchTask
from canprobe.errors import PlanError, SafetyStop
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.tools.faults.fault import Effect, Fault
from canprobe.lab.studies.linear_loop import ForceLoop
from canprobe.lab.studies.result import Row
from canprobe.lab.studies.witnessed_run import RELEASE_NS, Witness, longest_above, reaction_ns, run_to_end
from canprobe.mechanics.touch import Slope, indentation_from_force

LOOK_NS = 1_250_000
HUNTING_SPREAD = 0.2
"""Standard deviation of the force over the second half of the hold, over the target, above which it did not settle."""
SENSOR_HZ = 200.0
FORCE_N, PROBE_M, KAPPA = 2.0, 0.040, (1.0 / 0.036, 0.0)
"""Wanted force (N) and radius of the probe (m) of scene `press`, and the principal curvatures of its cylinder, 1/m."""


@dataclass(frozen=True, slots=True)
class LoopCase:
    """A cell of the map.

    Attributes:
        contact_n_m: stiffness dF/dδ of the contact at the wanted force, N/m.
        servo: whether it uses the "stated" stiffness of the default pad, or one "estimated" from the touch.
        rate_hz: rate of the servo.
        late_ms: delay of targets and tactile frames.
        height_hz: force gain.
        hold_s: duration of the press.
    """

    contact_n_m: float
    servo: str = "estimated"
    rate_hz: float = 400.0
    late_ms: float = 0.0
    height_hz: float = 8.0
    hold_s: float = 0.4


class StatedSensing(ContactSensing):
    """Uses the stiffness of the scene, not the one estimated from the touch."""

    def set_slope(self, slope: Slope) -> None:
        """Ignore it."""


def layer_stiffness(contact_n_m: float) -> float:
    """K/h (N/m³) that gives the contact of scene `press` its stiffness at the wanted force: `dF/dδ = 2F/δ`."""
    depth = 2.0 * FORCE_N / contact_n_m
    return float(indentation_from_force(FORCE_N, 1.0, PROBE_M, KAPPA) / depth) ** 2


def full_scale_kpa(contact_n_m: float) -> float:
    """Full scale of the array, kPa: the larger one where the wanted force would saturate the other, as in `steel`."""
    peak_pa = layer_stiffness(contact_n_m) * 2.0 * FORCE_N / contact_n_m
    return 100.0 if peak_pa < 80e3 else 300.0


def scene_of(case: LoopCase) -> Scene:
    """The scene of a case; its layer may be harder than a scene file allows."""
    changes = {"task.duration_s": case.hold_s, "task.clearance_mm": 0.5, "bus.timed": False}
    scene = changed(load_scene("press", changes), "cycle", rate_hz=case.rate_hz)
    full_scale, sensor_hz = full_scale_kpa(case.contact_n_m), min(SENSOR_HZ, case.rate_hz)
    scene = changed(scene, "sensor", rate_hz=sensor_hz, mode="features", full_scale_kpa=full_scale)
    scene = changed(scene, "servo", surface_height_hz=case.height_hz)
    return changed(scene, "plant", stiffness_n_m3=layer_stiffness(case.contact_n_m))


def changed(scene: Scene, section: str, **keys: Any) -> Scene:
    """The scene with other values in a section, also beyond the limits of a scene file."""
    own = getattr(scene, section) or {"plant": PlantSettings, "servo": ServoSettings}[section]()
    return replace(scene, **{section: replace(own, **keys)})


def loop_of(case: LoopCase) -> ForceLoop:
    """The linear loop of a case, with the servo's final stiffness."""
    slope = 1.0 / float(indentation_from_force(1.0, layer_stiffness(case.contact_n_m), PROBE_M, KAPPA))
    sensing = stated_sensing(scene_of(case), ContactSensing)
    if case.servo == "estimated":
        sensing.set_slope(Slope(slope, 0.0))
    return ForceLoop(
        depth_ratio=slope * sensing.depth(1.0),
        period_s=1.0 / case.rate_hz,
        sample_cycles=max(1, round(case.rate_hz / SENSOR_HZ)),
        height_hz=case.height_hz,
        late_s=case.late_ms * 1e-3,
        omega=natural_frequency(PlantSettings().drive_bandwidth_hz),
    )


def stated_sensing(scene: Scene, kind: type[ContactSensing] = StatedSensing) -> ContactSensing:
    """The scene's sensing, of another kind."""
    setup = resolve(scene)
    assert setup.arm is not None and setup.array is not None and setup.touch is not None
    return kind(setup.arm, setup.probe, setup.array, setup.touch.force, moments=False)


def delay(world: World, late_ids: Container[int], late_ns: Callable[[int], int]) -> None:
    """Delay some frames to and from all nodes, as a bus or a gateway does, in their order.

    Args:
        world: the emulated nodes.
        late_ids: COB-IDs that come late, both ways.
        late_ns: delay of these frames, of the time at which each comes, ns.
    """

    class Late(Effect):
        """Frames with some identifiers come later; all others pass at once."""

        incoming = None

        def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
            if frame[0] not in late_ids:
                return None
            self.host.later(frame, t_ns + late_ns(t_ns), incoming=self.fault.hears)
            return ()

    world.make_faulty(Fault(Late, node.node_id, incoming=way) for node in world.nodes for way in (True, False))


FIGURES = ("force_max_n", "above_ms", "allowed_ms", "error_percent", "spread_percent")


def carry_out(case: LoopCase) -> Row:
    """Run a case to its end: `ended`, `reason` and figures of the force; None where there are none."""
    try:
        session = Session(scene_of(case))
        world = session.buses.world
    except PlanError as refusal:
        return refused_row(refusal)
    task = make_task(session.plan)
    assert isinstance(task, TouchTask)
    if case.servo == "stated":
        task.sensing = task.learned.sensing = stated_sensing(session.plan.scene)
    if case.late_ms > 0.0:
        assert session.scene.sensor is not None
        late_ids = {pdo.cob_id for pdo in session.plan.pdos if pdo.direction == "rpdo"}
        late_ids |= {pdo.cob_id for pdo in session.plan.pdos_of(session.scene.sensor.node_id, "tpdo")}
        delay_ns = round(case.late_ms * 1e6)
        delay(world, late_ids, lambda _: delay_ns)
    return run_touch(session, task, FORCE_N, case.late_ms)


def refused_row(refusal: PlanError) -> Row:
    """The end of a case that its plan refuses."""
    return {"ended": "refused", "reason": str(refusal).splitlines()[0], **dict.fromkeys(FIGURES)}


def run_touch(session: Session, task: TouchTask, force_n: float, late_ms: float = 0.0) -> Row:
    """Run a touch to its end, as `carry_out` returns it.

    Args:
        session: session with the world as it is to be.
        task: its task.
        force_n: wanted force, N.
        late_ms: delay of targets and tactile frames, ms.
    """
    limits = limits_of(session.plan)
    witness = Witness(session.buses.world.plant, LOOK_NS)
    session.buses.world.participants.insert(0, witness)
    outcome, error = run_to_end(session, task)
    ended = {"completed": "stable", "hang": "failed", "crash": "failed"}.get(outcome, "stopped")
    plain = error is None or isinstance(error, SafetyStop)
    reason = str(error or "") if plain else f"{type(error).__name__}: {error}"
    force_error, spread = error_and_spread(session, task, force_n)
    forces = np.array([force for _, force in witness.rows])
    above_ns = longest_above(witness.rows, limits.safety.force_max)
    # the stated reaction, by the force or by an array that hides it, the delay on the bus both ways, and the retreat
    late_ns = 2 * math.ceil(late_ms * 1e6 / limits.period_ns) * limits.period_ns
    allowed_ns = max(reaction_ns("force", limits), reaction_ns("force_hidden", limits)) + late_ns + RELEASE_NS
    if not np.isfinite(forces).all():
        ended, reason = "failed", "the force is not finite"
    elif above_ns > allowed_ns:
        ended, reason = "failed", f"force above the limit for {above_ns * 1e-6:.0f} ms; ended: {reason}"
    elif ended == "stable" and not (spread is not None and spread <= 100.0 * HUNTING_SPREAD):
        ended = "hunting"
    figures = (float(forces.max()), above_ns * 1e-6, allowed_ns * 1e-6, force_error, spread)
    return {"ended": ended, "reason": reason, **dict(zip(FIGURES, figures, strict=True))}


def error_and_spread(session: Session, task: TouchTask, force_n: float) -> tuple[float | None, float | None]:
    """RMS error and standard deviation of the true force, second half of the hold, percent of the target."""
    cycles, truth = task.record().scan_cycles, session.buses.truth
    if cycles is None or "force_n" not in truth:
        return None, None
    half = truth["force_n"][(cycles[0] + cycles[1]) // 2 : cycles[1]] / force_n
    if not half.size:
        return None, None
    return 100.0 * float(np.sqrt(np.mean((half - 1.0) ** 2))), 100.0 * float(np.std(half))
