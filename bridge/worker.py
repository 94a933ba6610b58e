"""The process of one bridge: records from the cell on stdin, made into samples, lines of JSON back on stdout.

Back go `{"ready": where}`, then requests of the other tool, then `{"done": {"received": n, "where": …}}`, or `{"error":
text}` at any time. The end of stdin without a last record means that the cell is gone: the sink is closed all the same.
A file is done when it is closed. A live view is done before that: a viewer that does not read holds its close up.
"""

from __future__ import annotations

import importlib
import json
import marshal
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.array import patch_of
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.supervision import TOUCH_FORCE
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, Plan, PlannedNode
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import BridgeSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Setup, Touch
from canprobe.cell.tasks.probing import Phase
from canprobe.cell.tasks.sensing import ContactSensing
from canprobe.errors import CanprobeError, ResultsError
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.frames import NO_ERROR, NmtState, describe
from canprobe.lab.bridge.process import END, Received, read_records, unpack_observation
from canprobe.lab.bridge.sample import (
    ContactFrame,
    Context,
    Diagnostic,
    Sample,
    Sink,
    SurfacePatch,
    TouchFrame,
)
from canprobe.mechanics.touch.contact import ContactSample, pad_to_direction
from canprobe.mechanics.touch.linear_algebra import homogeneous, tangent_rotation
from canprobe.mechanics.touch.patch.image_model import make_patch_calibration

# The state of the nodes, about once a second: from heartbeats, emergencies and statuswords.

PERIOD_NS = 1_000_000_000
WELL, LOOK, FAILED, SILENT = range(4)
_SUPERVISED = (0x080, 0x700)


class Health:
    """Follows the nodes of a plan.

    Args:
        plan: whose nodes.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._watch = NodeWatch(plan.node_ids)
        self._heard: dict[int, int] = {}
        self._due_ns: int | None = None

    def step(self, t_ns: int, received: Received) -> tuple[Diagnostic, ...]:
        """Take what one observation says; the state of all where it is time for it, else nothing."""
        for frame in received.frames:
            self._push(frame)
        if received.measurement is None or (self._due_ns is not None and t_ns < self._due_ns):
            return ()
        self._due_ns = t_ns + PERIOD_NS
        nodes = tuple(self._node(node, received.measurement, t_ns) for node in self._plan.nodes)
        return (*nodes, _cell(received))

    def _push(self, frame: TimedFrame) -> None:
        can_id, data, t_ns = frame
        node_id = can_id & 0x7F
        if can_id > 0x7FF or can_id & 0x780 not in _SUPERVISED or node_id not in self._watch.boot_ups:
            return
        self._watch.push(can_id, data, t_ns)
        if can_id & 0x780 == 0x700:
            self._heard[node_id] = t_ns

    def _node(self, node: PlannedNode, measurement: Measurement, t_ns: int) -> Diagnostic:
        node_id, watch = node.node_id, self._watch
        state = watch.states.get(node_id)
        drive = self._drive(node, measurement)
        event = watch.last_emcy.get(node_id)
        silent = t_ns - self._heard.get(node_id, 0) > HEARTBEAT_CONSUMED_MS * 1_000_000
        if silent:
            level, message = SILENT, f"no heartbeat for more than {HEARTBEAT_CONSUMED_MS} ms"
        elif event is not None and event.emcy.code != NO_ERROR:
            level, message = FAILED, f"EMCY {event.emcy.code:04X}h, {describe(event.emcy.code)}"
        elif drive in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            level, message = FAILED, "drive fault"
        elif state is not NmtState.OPERATIONAL:
            level, message = LOOK, state.name.lower() if state is not None else "no heartbeat yet"
        else:
            level, message = WELL, "operational"
        values = [("nmt_state", state.name.lower() if state is not None else "unknown")]
        if drive is not None:
            values.append(("drive_state", drive.name.lower()))
        return Diagnostic(f"node {node_id} ({node.role})", level, message, tuple(values))

    def _drive(self, node: PlannedNode, measurement: Measurement) -> DriveState | None:
        arm = self._plan.setup.arm
        if arm is None or node.kind != "drive" or not measurement.statuswords:
            return None
        return known_state(measurement.statuswords[arm.node_ids.index(node.node_id)])


def _cell(received: Received) -> Diagnostic:
    """The cell as a whole, and what was lost on the way to this bridge."""
    m = received.measurement
    assert m is not None
    oldest = max(m.q_age, default=0)
    values = [("cycle", str(m.cycle)), ("oldest_tpdo_cycles", str(oldest)), ("dropped_samples", str(received.dropped))]
    if m.tactile_age is not None:
        values.append(("tactile_age_cycles", str(m.tactile_age)))
    if received.dropped:
        return Diagnostic("cell", LOOK, f"{received.dropped} samples were lost on the way here", tuple(values))
    return Diagnostic("cell", WELL, "running", tuple(values))


# Observations → neutral samples, in the bridge's process: patch, contact, frames and the state of the nodes.

Array = NDArray[np.float64]
_PHASES = {float(phase): phase.name.lower() for phase in Phase}


class SampleSource:
    """Makes the samples of one run, with the scene's own calibration and geometry.

    Args:
        plan: of the run.
    """

    def __init__(self, plan: Plan) -> None:
        arm, array, probe = plan.setup.arm, plan.setup.array, plan.setup.probe
        self._health = Health(plan)
        self._sensing = _sensing(plan.setup)
        self._has_arm = arm is not None
        self._radius = probe.radius
        self._calibration = make_patch_calibration(array.calibration, array.pad) if array is not None else None

    def sample(self, received: Received) -> Sample:
        """The sample of one observation."""
        measurement, t_ns = received.measurement, received.t_ns
        diagnostics = self._health.step(t_ns, received)
        sample = Sample(t_ns, frames=received.frames, diagnostics=diagnostics, dropped=received.dropped)
        if measurement is None:
            return sample
        self._place_on(received.patch)  # before the contact, as the task does
        if received.depth is not None and self._sensing is not None:
            self._sensing.set_depth_at_1_n(received.depth * 1e-3)
        return replace(
            sample,
            cycle=measurement.cycle,
            phase=_PHASES.get(received.phase) if received.phase is not None else None,
            q=measurement.q if self._has_arm else None,
            touch=self._touch(measurement, t_ns - measurement.t_ns),
            patch=received.patch,
        )

    def _touch(self, m: Measurement, shift_ns: int) -> TouchFrame | None:
        """What the array measured; ``shift_ns`` takes the cycle's clock to that of the samples."""
        sensing, sample = self._sensing, m.tactile
        patch = sensing.step(m) if sensing is not None else None
        if sample is None or self._calibration is None:
            return None
        if patch is None:
            patch = patch_of(sample, self._calibration)
        contact = sensing.contact(sample, patch) if sensing is not None and patch.force > TOUCH_FORCE / 2 else None
        force = np.zeros(3)
        if patch.force > 0.0:  # the object pushes the probe back along the direction of the contact
            force = -patch.force * pad_to_direction(patch.u, patch.v, self._radius)
        return TouchFrame(
            t_ns=sample.t_sample_ns + shift_ns,
            counts=sample.frame.taxels if sample.frame.features is None else None,
            force=force,
            contact=_contact(contact) if contact is not None else None,
        )

    def _place_on(self, patch: SurfacePatch | None) -> None:
        """Contacts are placed on the estimated curvature from now on."""
        if patch is not None and self._sensing is not None and all(patch.observed):
            low, high = np.linalg.eigvalsh(patch.K).tolist()
            self._sensing.set_kappa(np.array([high, low]))


def _sensing(setup: Setup) -> ContactSensing | None:
    """Contacts, where there is an arm to place them; second moments are the estimator's business."""
    from canprobe.cell.tasks.from_plan import make_sensing

    touch = setup.touch
    if touch is None:
        return None
    return make_sensing(replace(touch, shape=None) if isinstance(touch, Touch) else touch)


def _contact(contact: ContactSample) -> ContactFrame:
    return ContactFrame(homogeneous(tangent_rotation(-contact.n_base), contact.p_base))


# The process.

NICE = 10
"""Whatever a bridge computes, the cell and its nodes come first."""


def run(name: str, records: Iterator[bytes], fd: int) -> int:
    """Serve one bridge to the end of its records.

    Args:
        name: of the bridge.
        records: the first is the configuration, the others are observations, the last may be the end.
        fd: where lines are written back.

    Returns:
        The exit status: 0, or 1 after an error, which was written back.
    """

    def send(document: dict[str, object]) -> None:
        os.write(fd, (json.dumps(document) + "\n").encode())

    try:
        context = _context(marshal.loads(next(records)), send)
        sink: Sink = importlib.import_module(f"canprobe.lab.bridge.{BRIDGES[name].module}").open_sink(context)
        send({"ready": sink.where})
        received, summary = _serve(sink, SampleSource(context.plan), records)
        done: dict[str, object] = {"done": {"received": received, "where": sink.where}}
        if BRIDGES[name].live:
            send(done)
        sink.close(summary)
        if not BRIDGES[name].live:
            send(done)
    except BrokenPipeError:
        return 1  # the cell is gone, and the sink is closed
    except (CanprobeError, OSError) as error:
        send({"error": str(error), "unwritten": isinstance(error, ResultsError)})
        return 1
    except Exception as error:  # a line for the cell, the whole for whoever looks for it
        traceback.print_exc()
        send({"error": repr(error)})
        return 1
    return 0


def _context(config: dict[str, Any], send: Callable[[dict[str, object]], None]) -> Context:
    plan = make_plan(resolve(load_scene(config["scene"])))
    out = Path(config["out"]) if config["out"] is not None else None
    return Context(plan, plan.scene.bridge or BridgeSettings(), out, send)


def _serve(sink: Sink, source: SampleSource, records: Iterator[bytes]) -> tuple[int, str | None]:
    """Give the sink every sample; how many there were, and the summary."""
    received = 0
    for record in records:
        body = record[1:]
        if record[:1] == END:
            return received, body.decode() or None
        if not received:
            sink.start(int.from_bytes(body[:8], "little"))
        sink.write(source.sample(unpack_observation(body[8:])))
        received += 1
    return received, None


def main() -> int:
    """The process: Ctrl-C is for the cell, which ends this one by the end of its records."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICE)
    fd = os.dup(1)
    os.dup2(2, 1)  # what a library prints does not mix with the lines back
    return run(sys.argv[1], read_records(sys.stdin.buffer), fd)


if __name__ == "__main__":
    sys.exit(main())
