"""The state of the nodes, about once a second: from heartbeats, emergencies and statuswords."""

from __future__ import annotations

from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, Plan, PlannedNode
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.emcy import NO_ERROR_CODE, describe
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.lab.bridge.codec import Received
from canprobe.lab.bridge.sample import Diagnostic

PERIOD_NS = 1_000_000_000
OK, WARN, ERROR, STALE = range(4)
"""Levels of `diagnostic_msgs/msg/DiagnosticStatus`."""
_SUPERVISED = (0x080, 0x700)


class Health:
    """Follows the nodes of a plan.

    Args:
        plan: plan of the nodes.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._watch = NodeWatch(plan.node_ids)
        self._heard: dict[int, int] = {}
        self._due_ns: int | None = None

    def step(self, t_ns: int, received: Received) -> tuple[Diagnostic, ...]:
        """Take one observation; the states of all nodes where they are due, else none."""
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
        return Diagnostic(f"node {node_id} ({node.role})", level, message, tuple(values))

    def _drive(self, node: PlannedNode, measurement: Measurement) -> DriveState | None:
        arm = self._plan.setup.arm
        if arm is None or node.kind != "drive" or not measurement.statuswords:
            return None
        return known_state(measurement.statuswords[arm.node_ids.index(node.node_id)])


def _cell(received: Received) -> Diagnostic:
    """State of the cell as a whole, with the samples that this bridge lost."""
    m = received.measurement
    assert m is not None
    oldest = max(m.q_age, default=0)
    values = [("cycle", str(m.cycle)), ("oldest_tpdo_cycles", str(oldest)), ("dropped_samples", str(received.dropped))]
    if m.tactile_age is not None:
        values.append(("tactile_age_cycles", str(m.tactile_age)))
    if received.dropped:
        return Diagnostic("cell", WARN, f"this bridge lost {received.dropped} samples", tuple(values))
    return Diagnostic("cell", OK, "running", tuple(values))
