"""Observations → neutral samples, in the bridge's process: patch, contact, frames and the state of the nodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import make_sensing
from canprobe.cell.tasks.task import Phase
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.emcy import NO_ERROR_CODE, describe
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.lab.bridge.pipe import Received
from canprobe.lab.bridge.sample import ContactFrame, Diagnostic, Sample, TouchFrame
from canprobe.mechanics.touch.contact import pad_to_direction
from canprobe.mechanics.touch.stops import TOUCH_FORCE
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation

PERIOD_NS = 1_000_000_000
OK, WARN, ERROR, STALE = range(4)
"""Levels of `diagnostic_msgs/msg/DiagnosticStatus`."""
_PHASES = {float(phase): phase.name.lower() for phase in Phase}


class SampleSource:
    """Makes the samples of one run, with the scene's own calibration and geometry.

    Args:
        plan: plan of the run.
    """

    def __init__(self, plan: Plan) -> None:
        self._setup, self._health = plan.setup, Health(plan)
        touch = plan.setup.touch
        if isinstance(touch, Touch):
            touch = replace(touch, shape=None)  # contacts need no second moments
        self._sensing = None if touch is None else make_sensing(touch)
        # one reader: that of the contacts, or that of an array without them
        self._reader = self._sensing.reader if self._sensing is not None else make_patch_reader(plan.setup)

    def sample(self, received: Received) -> Sample:
        """The sample of one observation."""
        measurement, t_ns = received.measurement, received.t_ns
        diagnostics, carrier = self._health.step(t_ns, received), self._setup.carrier
        sample = Sample(t_ns, frames=received.frames, diagnostics=diagnostics, dropped=received.dropped)
        if measurement is None:
            return sample
        patch = received.patch
        if patch is not None and self._sensing is not None and all(patch.observed):  # before the contact, as the task
            self._sensing.set_kappa(np.array(patch.kappa))
        if received.depth is not None and self._sensing is not None:
            self._sensing.set_depth_at_1_n(received.depth * 1e-3)
        return replace(
            sample,
            cycle=measurement.cycle,
            phase=_PHASES.get(received.phase) if received.phase is not None else None,
            q=measurement.q if self._setup.arm is not None else None,
            touch=self._touch(measurement, t_ns - measurement.t_ns),
            patch=patch,
            ahead=None if received.ahead is None else 1e-3 * received.ahead,
            T_base_carrier=None if carrier is None else carrier.frame(measurement.carrier),
        )

    def _touch(self, m: Measurement, shift_ns: int) -> TouchFrame | None:
        """The array's frame; ``shift_ns`` converts the cycle's clock to that of the samples."""
        sensing, sample = self._sensing, m.tactile
        patch = sensing.step(m) if sensing is not None else None
        if sample is None or self._reader is None:
            return None
        if patch is None:
            patch = self._reader.read(sample)
        contact = sensing.contact(sample, patch) if sensing is not None and patch.force > TOUCH_FORCE / 2 else None
        placed = None
        if contact is not None:
            placed = ContactFrame(homogeneous(tangent_rotation(-contact.n_base), contact.p_base))
        force = np.zeros(3)
        if patch.force > 0.0:  # the object pushes the probe back along the direction of the contact
            force = -patch.force * pad_to_direction(patch.u, patch.v, self._setup.probe.radius)
        return TouchFrame(
            t_ns=sample.t_sample_ns + shift_ns,
            counts=sample.frame.taxels if sample.frame.features is None else None,
            force=force,
            contact=placed,
        )


class Health:
    """State of the nodes of a plan, about once a second: from heartbeats, emergencies and statuswords.

    Args:
        plan: plan of the nodes.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._watch = NodeWatch(plan.node_ids)
        self._due_ns: int | None = None

    def step(self, t_ns: int, received: Received) -> tuple[Diagnostic, ...]:
        """Take one observation; the states of all nodes where they are due, else none."""
        for frame in received.frames:
            self._watch.push(*frame)
        if received.measurement is None or (self._due_ns is not None and t_ns < self._due_ns):
            return ()
        self._due_ns = t_ns + PERIOD_NS
        nodes = tuple(self._node(node, received.measurement, t_ns) for node in self._plan.nodes)
        return (*nodes, _cell(received.measurement, received.dropped))

    def _node(self, node: NodeConfiguration, measurement: Measurement, t_ns: int) -> Diagnostic:
        node_id, watch = node.node_id, self._watch
        state = watch.states.get(node_id)
        drive = self._drive(node, measurement)
        event = watch.last_emcy.get(node_id)
        silent = t_ns - watch.heard_ns.get(node_id, 0) > HEARTBEAT_CONSUMED_MS * 1_000_000
        if silent:
            level, message = STALE, f"no heartbeat for more than {HEARTBEAT_CONSUMED_MS} ms"
        elif event is not None and event.emcy.code != NO_ERROR_CODE:
            level, message = ERROR, f"EMCY {event.emcy.code:04X}h, {describe(event.emcy.code)}"
        elif drive in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            level, message = ERROR, "drive fault"
        elif state is not NmtState.OPERATIONAL:
            level, message = WARN, state.name.lower() if state is not None else "no heartbeat yet"
        else:
            level, message = OK, "operational"
        values = [("nmt_state", state.name.lower() if state is not None else "unknown")]
        if drive is not None:
            values.append(("drive_state", drive.name.lower()))
        return Diagnostic(f"node {node_id} ({node.name})", level, message, tuple(values))

    def _drive(self, node: NodeConfiguration, measurement: Measurement) -> DriveState | None:
        arm = self._plan.setup.arm
        if arm is None or node.kind != "drive" or not measurement.statuswords:
            return None
        return known_state(measurement.statuswords[arm.node_ids.index(node.node_id)])


def _cell(m: Measurement, dropped: int) -> Diagnostic:
    """State of the cell as a whole, with the samples that this bridge lost."""
    oldest = max(m.q_age, default=0)
    values = [("cycle", str(m.cycle)), ("oldest_tpdo_cycles", str(oldest)), ("dropped_samples", str(dropped))]
    if m.tactile_age is not None:
        values.append(("tactile_age_cycles", str(m.tactile_age)))
    if dropped:
        return Diagnostic("cell", WARN, f"this bridge lost {dropped} samples", tuple(values))
    return Diagnostic("cell", OK, "running", tuple(values))
