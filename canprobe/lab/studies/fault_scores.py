"""The score of a run with faults: force, motion and power after the stop, the summary, the log.

The force is judged in runs that press: the true force of the plant against the limit of the scene
(`limits.force_max_n`, 3 N here, 5 N by default). Two criteria hold for every fault. The force stays above the limit no
longer than the reaction to a measured force and the way back take (`force` in the table of conditions, and
`RELEASE_NS`). It never exceeds the peak that the probe can reach until the cell reacts.

The peak of the force.
Between a fault and the reaction the probe moves on in one of these ways:

- blind: without tactile frames the approach goes on, at `approach_speed`, until `sensor_stale` lets the probe retreat;
- torn: k drives stand still and the others follow their targets, until `drive_silent` stops them. Joint i alone moves
  the probe into the object by cᵢ = n·Jᵢ q̇ᵢ, so that without the set S it sinks in at Σcᵢ − Σ_S cᵢ: at most Σcᵢ and
  the k most negative cᵢ turned round. The greatest of any cycle counts, over the targets of a run without faults.
- wrong: one drive gets a corrupted target. Beyond what 607Fh allows it does not follow (reference limit); nearer, the
  motor i moves that far, ωᵢ T for one cycle, and the probe by n·Jᵢ ωᵢ T.

The first two times include one cycle until the last target is reached and the drives' lag behind a ramp, 2 ζ/ω. The
force grows with the square of the indentation, F = (δ/δ₁)² with δ₁ at 1 N, and may be at its limit at the fault:

    F ≤ (√F_limit + d / δ₁)²,  d the longest of these ways for one fault, their sum for more.

The contact's damping adds α δ̇, a hundredth at these speeds, which is left out.
Source: Hunt and Crossley 1975 for the damping; `canprobe.mechanics.touch.contact.indentation_from_force` for δ₁.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.controller import Controller
from canprobe.cell.master.joint_columns import joint_positions
from canprobe.cell.master.supervision import Limits, limits_of
from canprobe.cell.planning.units import motor_speed_limit
from canprobe.cell.results.summary import summarise
from canprobe.cell.scene.geometry import T_flange_probe
from canprobe.cell.scene.model import ServoSettings
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.probing import Phase
from canprobe.cell.tasks.task import record_of
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.mechanics.robot.chain import forward_jacobian
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.touch.contact import indentation_from_force

RELEASE_NS = 100_000_000
"""Time that the retreat has, from its command, to bring the force below the limit."""
AT_REST_RAD = 2e-4
LONGEST_S = 15.0
"""Virtual time after which a run hangs: nominal runs take two seconds, every time-out in them less than ten."""


@dataclass(frozen=True, slots=True)
class Peak:
    """Depths to which a probe can sink in until the cell reacts.

    Attributes:
        force_limit: force at the limit, N.
        depth_at_1n: depth at 1 N, m.
        blind: depth without the sensor, m.
        torn: depth with 0, 1, 2, … drives that stand still, m.
        wrong: depth by one wrong target, m.
    """

    force_limit: float
    depth_at_1n: float
    blind: float
    torn: tuple[float, ...]
    wrong: float = 0.0

    def force(self, faults: int, wrong_targets: bool = False) -> float:
        """Highest force of a run with a number of faults, N; `wrong_targets`: frames to drives are corrupted."""
        torn = self.torn[min(faults, len(self.torn) - 1)]
        ways = (self.blind, torn, self.wrong if wrong_targets else 0.0)
        sinks = max(ways) if faults < 2 else sum(ways)
        return (math.sqrt(self.force_limit) + sinks / self.depth_at_1n) ** 2


def peak_of(session: Session) -> Peak | None:
    """The peak of a scenario, from a finished run without faults; None where nothing presses."""
    scene, limits = session.scene, limits_of(session.plan)
    if scene.arm is None or scene.object is None or scene.probe is None:
        return None
    lag_s = limits.period_ns * 1e-9 + (scene.servo or ServoSettings()).drive_lag_ms * 1e-3
    blind_s, torn_s = (reaction_ns(key, limits) * 1e-9 + lag_s for key in ("sensor_stale", "drive_silent"))
    kappa = session.world.plant.truth()["kappa"]
    return Peak(
        limits.safety.force_max,
        indentation_from_force(1.0, session.plan.setup.probe.stiffness, scene.probe.radius_mm * 1e-3, kappa),
        scene.task.approach_mm_s * 1e-3 * blind_s,
        tuple((_torn_speeds(session) * torn_s).tolist()),
        _wrong_reach(session),
    )


def _model(session: Session) -> ArmModel:
    arm = session.plan.setup.arm
    assert arm is not None
    return arm.model


def _wrong_reach(session: Session) -> float:
    """Depth (m) to which the probe sinks in where one motor moves as far in a cycle as its drive allows."""
    scene, period_ns = session.scene, session.plan.sync.period_ns
    assert scene.arm is not None and scene.probe is not None
    model, share = _model(session), scene.limits.joint_speed_share
    counts = [motor_speed_limit(model, axis, share, period_ns) * period_ns * 1e-9 for axis in range(model.n)]
    q = _targets(session)
    angles = q[np.isfinite(q).all(axis=1)][-1]
    T, J = forward_jacobian(model.chain, angles, T_flange_probe(scene.probe))
    return float(np.abs(T[:3, 2] @ J[:3] @ model.q_per_unit * counts).max())


def _targets(session: Session) -> NDArray[np.float64]:
    q = joint_positions(session.cell.log.arrays(), "q_target")
    assert q is not None
    return q


def _torn_speeds(session: Session) -> NDArray[np.float64]:
    """Greatest speeds (7,), m/s, at which the probe sinks in while 0…6 joints stand still and the others move."""
    scene = session.scene
    assert scene.arm is not None and scene.probe is not None
    model, flange_probe = _model(session), T_flange_probe(scene.probe)
    q, phase = _targets(session), session.cell.log.arrays()["phase"]
    near = (phase >= Phase.APPROACH) & (phase <= Phase.RETREAT)
    rates = np.diff(q, axis=0) / (session.plan.sync.period_ns * 1e-9)
    greatest = np.zeros(model.n + 1)
    for angles, rate in zip(q[1:][near[1:]], rates[near[1:]], strict=True):
        T, J = forward_jacobian(model.chain, angles, flange_probe)
        shares = T[:3, 2] @ J[:3] * rate
        missing = np.sort(np.maximum(-shares, 0.0))[::-1]
        greatest = np.maximum(greatest, shares.sum() + np.concatenate([[0.0], np.cumsum(missing)]))
    return greatest


def reaction_ns(key: str, limits: Limits) -> int:
    """Time to the reaction to a condition of the supervision, ns."""
    within = BY_KEY[key].within
    assert within is not None
    return within(limits)


def longest_above(rows: Sequence[tuple[int, float]], limit: float) -> int:
    """Longest time without a break for which the force of (t_ns, force) rows is above the limit, ns."""
    longest = 0
    since: int | None = None
    for t_ns, force in rows:
        if force <= limit:
            since = None
            continue
        since = t_ns if since is None else since
        longest = max(longest, t_ns - since)
    return longest


def score_force(
    rows: Sequence[tuple[int, float]], limits: Limits, bound_n: float | None
) -> tuple[float, int, list[str]]:
    """Highest force, N; longest time above the limit, ns; failures, which need a bound."""
    longest = longest_above(rows, limits.safety.force_max)
    highest = max((force for _, force in rows), default=0.0)
    if bound_n is None:
        return highest, longest, []
    failures = []
    if longest > reaction_ns("force", limits) + RELEASE_NS:
        failures.append(f"force above the limit for {longest * 1e-6:.0f} ms, up to {highest:.2f} N")
    if highest > bound_n:
        failures.append(f"force of {highest:.2f} N, expected at most {bound_n:.2f} N until the cell reacts")
    return highest, longest, failures


def score_rest(moved_rad: float, nodes: Sequence[SlaveNode]) -> list[str]:
    """Motion after the stop, and drives that are not disabled."""
    failures = [f"motion after the stop: {moved_rad:.5f} rad"] if moved_rad > AT_REST_RAD else []
    for node in nodes:
        if not node.dictionary.has_index(0x6041):
            continue
        if (state := state_of(node.dictionary.number(0x6041))) in POWERED_STATES:
            failures.append(f"{node.name} is {state.name} after the stop")
    return failures


def score_summary(session: Session, task: Controller, reason: str) -> list[str]:
    """Failures to make and write a summary of the run, whatever happened in it."""
    if not session.started:
        return []
    try:
        json.dumps(summarise(session, record_of(task), {}, reason or None), allow_nan=False)
    except Exception as error:  # of any kind: a user would have lost the summary of the run
        return [f"summary: {type(error).__name__}: {error}"]
    return []


def score_log(session: Session, steps: int) -> list[str]:
    """Missing rows of cycles in the log, and missing frames in `bus.log`, where one is written."""
    failures = []
    if session.opened and (rows := len(session.cell.log)) < steps:
        failures.append(f"log: {rows} rows of {steps} cycles")
    if session.out is None:
        return failures
    try:
        lines = sum(1 for _ in read_candump(session.out / "bus.log", whole=True))
    except CanprobeError as error:
        return [*failures, f"log: {error}"]
    frames = sum(counter.frames for counter in session.record.traffic.values())
    return failures if lines == frames else [*failures, f"log: {lines} lines of {frames} frames"]
