"""The state of a cell, from listening to its bus alone: nodes, joints, touch, load and jitter of SYNC. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.array import make_patch_reader, make_tactile
from canprobe.cell.master.drives import drive_axes, feedback_frames
from canprobe.cell.master.notes import nodes_text
from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import MASTER_NODE_ID, Plan
from canprobe.cell.planning.wire_time import unstuffed_frame_bits
from canprobe.errors import ProtocolError
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.cia402 import DriveState, describe_state
from canprobe.fieldbus.protocol.emcy import Emcy, describe, is_no_error
from canprobe.fieldbus.protocol.frames import (
    CLASSIC_BYTES,
    EMCY_BASE,
    HEARTBEAT_BASE,
    NMT_ID,
    SYNC_ID,
    NmtCommand,
    NmtState,
    unpack_heartbeat,
)
from canprobe.mechanics.robot.model import units_to_joints
from canprobe.mechanics.touch import CalibrationCheck

SECOND_NS = 1_000_000_000
LATE_HEARTBEAT_S = 0.25
"""A heartbeat older than that is late."""
EVENTS_KEPT = 16
TOGETHER_NS = 50_000_000
"""Time in which the same event of several nodes is one."""
_ENABLED = DriveState.OPERATION_ENABLED.name


@dataclass(slots=True)
class NodeEvent:
    """Something that happened to nodes.

    Attributes:
        t_ns: time of the first of them.
        what: what happened.
        nodes: the nodes; 0 stands for all.
    """

    t_ns: int
    what: str
    nodes: set[int]

    def text(self, first_ns: int) -> str:
        """The event in words, with its time since the first frame."""
        who = "all nodes" if 0 in self.nodes else nodes_text(self.nodes)
        return f"{(self.t_ns - first_ns) * 1e-9:8.1f} s   {who}: {self.what}"


@dataclass(slots=True)
class NodeView:
    """The state of a node, as its frames show it.

    Attributes:
        node_id, role: node id and role of the node.
        state: NMT state of its last heartbeat; None before the first.
        heard_s: time since that heartbeat, s; None before the first.
        drive: CiA 402 state of its last statusword; None of a sensor or before the first.
        emcy: its last emergency in words; None without one or after its end.
    """

    node_id: int
    role: str
    state: str | None = None
    heard_s: float | None = None
    drive: str | None = None
    emcy: str | None = None


@dataclass(slots=True, eq=False)
class CellView:
    """The cell at one instant; what was not received is None.

    Attributes:
        channel: channel of the bus, or channels of the buses.
        t_s: time since the first frame, s.
        nodes: ascending node ids, the master's heartbeat last.
        q: joint positions (n,), deg or mm.
        units: unit of each of them.
        force_n: force in the last whole tactile frame, N.
        taxels: (rows, columns) counts of that frame.
        frames_per_s: frames in the last second, on all buses.
        load: bus load in the last second, by channel; without stuff bits, as a share of the bit rate.
        sync_hz: SYNCs in the last second.
        sync_jitter_us: 99th percentile and largest distance of a SYNC interval from the planned one, µs.
        torn_frames: tactile frames that were not whole.
        events: last changes of nodes and drives, and commands to them, each with its time.
        array: how the array is not as its calibration says, by its images alone; None where it is.
    """

    channel: str
    t_s: float = 0.0
    nodes: list[NodeView] = field(default_factory=list)
    q: list[float] | None = None
    units: tuple[str, ...] = ()
    force_n: float | None = None
    taxels: NDArray[np.uint8] | None = None
    frames_per_s: float = 0.0
    load: dict[str, float] = field(default_factory=dict)
    sync_hz: float = 0.0
    sync_jitter_us: tuple[float, float] | None = None
    torn_frames: int = 0
    events: list[str] = field(default_factory=list)
    array: str | None = None

    def as_document(self) -> dict[str, Any]:
        """The state as `--json` prints it."""
        document = asdict(self)
        document["taxels"] = self.taxels.tolist() if self.taxels is not None else None
        return document


class Monitor:
    """Listens to the frames of a plan's nodes.

    Args:
        plan: plan of the cell on the bus.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        channels = [bus.channel for bus in plan.buses]
        self._view = CellView("+".join(channels))
        roles = {node.node_id: node.name for node in plan.nodes} | {MASTER_NODE_ID: "master"}
        self._nodes = {node_id: NodeView(node_id, role) for node_id, role in roles.items()}
        axes = drive_axes(plan)
        self._model = plan.setup.needed_arm().model if axes else None
        self._feedback = {one.layout.cob_id: (axes[one.axis].node_id, one) for one in feedback_frames(axes)}
        self._counts: list[int | None] = [None] * len(axes)
        self._tactile = make_tactile(plan)
        self._reader = make_patch_reader(plan.setup)
        array = plan.setup.array
        self._check: CalibrationCheck | None = None
        if array is not None:
            self._check = CalibrationCheck.of(array.calibration, array.pad, images=array.mode != "features")
        self._heard: dict[int, int] = {}
        self._first_ns: int | None = None
        self._recent: dict[str, deque[tuple[int, int]]] = {channel: deque() for channel in channels}
        self._syncs: deque[int] = deque()
        self._events: deque[NodeEvent] = deque(maxlen=EVENTS_KEPT)
        self._silent: set[int] = set()

    def push(self, frames: Iterable[TimedFrame], channel: str | None = None) -> None:
        """Take the frames of a bus, by default of the first. The SYNC is timed on the first bus; all buses have it."""
        first = next(iter(self._recent))
        recent = self._recent[first if channel is None else channel]
        timed = recent is self._recent[first]
        for can_id, data, t_ns in frames:
            if self._first_ns is None:
                self._first_ns = t_ns
            recent.append((t_ns, unstuffed_frame_bits(len(data), self._plan.setup.bus)))
            if can_id != SYNC_ID:
                self._take(can_id, data, t_ns)
            elif timed:
                self._syncs.append(t_ns)

    def _take(self, can_id: int, data: bytes, t_ns: int) -> None:
        node = self._nodes.get(can_id & 0x7F)
        if can_id in self._feedback:
            self._take_feedback(can_id, data, t_ns)
        elif self._tactile is not None and can_id in self._tactile.cob_ids:
            self._take_taxels(can_id, data, t_ns)
        elif node is not None and can_id == HEARTBEAT_BASE + node.node_id:
            self._take_heartbeat(node, data, t_ns)
        elif can_id == NMT_ID and len(data) == 2 and data[0] in set(NmtCommand):
            self._note(t_ns, data[1], f"NMT command {NmtCommand(data[0]).name.replace('_', ' ').lower()}")
        elif node is not None and can_id == EMCY_BASE + node.node_id and len(data) == CLASSIC_BYTES:
            emcy = Emcy.unpack(data)
            node.emcy = None if is_no_error(emcy.code) else f"{emcy.code:04X}h, {describe(emcy.code)}"
            if node.emcy is not None:
                self._note(t_ns, node.node_id, f"EMCY {node.emcy}")

    def _note(self, t_ns: int, node_id: int, what: str) -> None:
        """Note an event; what several nodes do together is one."""
        for event in reversed(self._events):
            if event.what == what and t_ns - event.t_ns < TOGETHER_NS:
                event.nodes.add(node_id)
                return
        self._events.append(NodeEvent(t_ns, what, {node_id}))

    def _take_feedback(self, can_id: int, data: bytes, t_ns: int) -> None:
        node_id, frame = self._feedback[can_id]
        try:
            values = frame.unpack(data)
        except ProtocolError:
            return
        if frame.word is not None:
            before, state = self._nodes[node_id].drive, describe_state(values[frame.word])
            self._nodes[node_id].drive = state
            if state != before and _ENABLED in (before, state):
                self._note(t_ns, node_id, "enabled" if state == _ENABLED else f"no longer enabled: {state}")
        if frame.counts is not None:
            self._counts[frame.axis] = values[frame.counts]

    def _take_taxels(self, can_id: int, data: bytes, t_ns: int) -> None:
        assert self._tactile is not None
        frame = self._tactile.assemble(can_id, data, t_ns)
        if frame is not None:
            self._view.taxels = frame.taxels
            patch = self._reader.read(TactileSample(frame, t_ns, 0)) if self._reader is not None else None
            self._view.force_n = patch.force if patch is not None else None
            if patch is not None and self._check is not None:
                self._check.see(t_ns * 1e-9, frame.taxels, frame.window, patch)
                if self._check.work():
                    self._view.array = self._check.finding

    def _take_heartbeat(self, node: NodeView, data: bytes, t_ns: int) -> None:
        try:
            state = unpack_heartbeat(data)
        except ProtocolError:
            return
        if state is NmtState.INITIALISING:
            self._note(t_ns, node.node_id, "booted")
        elif node.state != state.name:
            self._note(t_ns, node.node_id, f"is {state.name}")
        node.state = state.name
        self._silent.discard(node.node_id)
        self._heard[node.node_id] = t_ns

    def view(self, now_ns: int) -> CellView:
        """The view of the cell at an instant."""
        view = self._view
        view.t_s = (now_ns - self._first_ns) * 1e-9 if self._first_ns is not None else 0.0
        for node_id, node in self._nodes.items():
            node.heard_s = (now_ns - self._heard[node_id]) * 1e-9 if node_id in self._heard else None
            if node.heard_s is not None and node.heard_s > LATE_HEARTBEAT_S and node_id not in self._silent:
                self._silent.add(node_id)
                self._note(now_ns, node_id, "is silent")
        view.events = [event.text(self._first_ns or 0) for event in self._events]
        view.nodes = list(self._nodes.values())
        counts = [c for c in self._counts if c is not None]
        if self._model is not None and len(counts) == len(self._counts):
            q, joints = units_to_joints(self._model, np.array(counts, dtype=float)).tolist(), self._model.joints
            view.q = [joint.shown(value) for joint, value in zip(joints, q, strict=True)]
            view.units = tuple(joint.unit for joint in joints)
        self._measure_bus(view, now_ns)
        return view

    def _measure_bus(self, view: CellView, now_ns: int) -> None:
        for recent in self._recent.values():
            while recent and recent[0][0] < now_ns - SECOND_NS:
                recent.popleft()
        while self._syncs and self._syncs[0] < now_ns - SECOND_NS:
            self._syncs.popleft()
        span_s = min(1.0, max(view.t_s, 1e-3))
        view.frames_per_s = sum(map(len, self._recent.values())) / span_s
        whole = self._plan.setup.bus.bitrate * span_s
        view.load = {channel: sum(bits for _, bits in recent) / whole for channel, recent in self._recent.items()}
        view.sync_hz = len(self._syncs) / span_s
        if len(self._syncs) > 2:
            errors = np.abs(np.diff(np.array(self._syncs)) - self._plan.sync.period_ns) * 1e-3
            view.sync_jitter_us = (float(np.percentile(errors, 99)), float(errors.max()))
        if self._tactile is not None:
            view.torn_frames = self._tactile.torn


HOME, CLEAR_LINE, CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
SHADES = " ·░▒▓█"


def screen(view: CellView) -> str:
    """The view in the place of the one before, on a terminal."""
    return HOME + "".join(f"{line}{CLEAR_LINE}\r\n" for line in lines(view)) + CLEAR_BELOW


def lines(view: CellView) -> Iterator[str]:
    """The view, line by line."""
    jitter = "–"
    if view.sync_jitter_us is not None:
        jitter = "p99 {:.0f} µs, max {:.0f} µs".format(*view.sync_jitter_us)
    names = len(view.load) > 1
    load = ", ".join(f"{name + ' ' if names else ''}{100 * share:4.1f} %" for name, share in view.load.items())
    yield f"{view.channel}  {view.t_s:8.1f} s   load {load}   {view.frames_per_s:6.0f} frames/s"
    yield f"SYNC {view.sync_hz:6.1f} Hz   jitter {jitter}"
    yield ""
    for node in view.nodes:
        yield _node_line(node)
    if view.events:
        yield ""
        yield from view.events
    if view.q is not None:
        yield ""
        yield "joints  " + "  ".join(f"{q:8.2f} {unit}" for q, unit in zip(view.q, view.units, strict=True))
    if view.taxels is not None:
        force = "–" if view.force_n is None else f"{view.force_n:.2f} N"
        yield ""
        yield f"force   {force}   torn frames {view.torn_frames}"
        if view.array is not None:
            yield f"array   {view.array}"
        yield from image_lines(view.taxels)


def _node_line(node: NodeView) -> str:
    late = "" if node.heard_s is None or node.heard_s <= LATE_HEARTBEAT_S else f"  SILENT for {node.heard_s:.1f} s"
    drive = node.drive or ""
    emcy = f"  EMCY {node.emcy}" if node.emcy else ""
    return f"node {node.node_id:3d}  {node.role:<14} {node.state or 'not heard':<16} {drive:<20}{late}{emcy}".rstrip()


def image_lines(taxels: NDArray[np.uint8]) -> Iterator[str]:
    """A taxel image, two characters a taxel, the highest count in the darkest shade."""
    top = max(int(taxels.max()), 1)
    steps = np.ceil(taxels.astype(float) * (len(SHADES) - 1) / top).astype(int)
    for row in steps:
        yield "  " + "".join(SHADES[step] * 2 for step in row)
