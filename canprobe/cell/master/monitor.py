"""The state of a cell, from listening to its bus alone: nodes, joints, touch, load and jitter of SYNC. Pure."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.array import make_patch_reader, make_tactile
from canprobe.cell.master.controller import TactileSample
from canprobe.cell.master.drives import drive_axes, feedback_frames
from canprobe.cell.planning.model import MASTER_NODE_ID, Plan
from canprobe.errors import ProtocolError
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.cia402 import describe_state
from canprobe.fieldbus.protocol.emcy import Emcy, describe, is_no_error
from canprobe.fieldbus.protocol.frame_bits import best_case_bits, best_case_fd_bits
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, EMCY_BASE, HEARTBEAT_BASE, SYNC_ID, unpack_heartbeat
from canprobe.mechanics.robot.model import units_to_joints
from canprobe.mechanics.touch.patch.calibration_check import CalibrationCheck

SECOND_NS = 1_000_000_000


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
        self._speed_up = plan.setup.bus.data_bitrate / plan.setup.bus.bitrate
        roles = {node.node_id: node.role for node in plan.nodes} | {MASTER_NODE_ID: "master"}
        self._nodes = {node_id: NodeView(node_id, role) for node_id, role in roles.items()}
        arm = plan.setup.arm
        self._model = arm.model if arm is not None else None
        axes = drive_axes(plan)
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
        self._recent: dict[str, deque[tuple[int, float]]] = {channel: deque() for channel in channels}
        self._syncs: deque[int] = deque()

    def push(self, frames: Iterable[TimedFrame], channel: str | None = None) -> None:
        """Take the frames of a bus, by default of the first. The SYNC is timed on the first bus; all buses have it."""
        first = next(iter(self._recent))
        recent = self._recent[first if channel is None else channel]
        timed = recent is self._recent[first]
        for can_id, data, t_ns in frames:
            if self._first_ns is None:
                self._first_ns = t_ns
            recent.append((t_ns, self._bits(len(data))))
            if can_id != SYNC_ID:
                self._take(can_id, data, t_ns)
            elif timed:
                self._syncs.append(t_ns)

    def _bits(self, length: int) -> float:
        """Length of a frame in bits of the nominal rate, its data phase converted to them."""
        if length <= CLASSIC_BYTES:
            return best_case_bits(length)
        bits = best_case_fd_bits(length)
        return bits.nominal + bits.data / self._speed_up

    def _take(self, can_id: int, data: bytes, t_ns: int) -> None:
        node = self._nodes.get(can_id & 0x7F)
        if can_id in self._feedback:
            self._take_feedback(can_id, data)
        elif self._tactile is not None and can_id in self._tactile.cob_ids:
            self._take_taxels(can_id, data, t_ns)
        elif node is not None and can_id == HEARTBEAT_BASE + node.node_id:
            self._take_heartbeat(node, data, t_ns)
        elif node is not None and can_id == EMCY_BASE + node.node_id and len(data) == CLASSIC_BYTES:
            emcy = Emcy.unpack(data)
            node.emcy = None if is_no_error(emcy.code) else f"{emcy.code:04X}h, {describe(emcy.code)}"

    def _take_feedback(self, can_id: int, data: bytes) -> None:
        node_id, frame = self._feedback[can_id]
        try:
            values = frame.unpack(data)
        except ProtocolError:
            return
        if frame.word is not None:
            self._nodes[node_id].drive = describe_state(values[frame.word])
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
            node.state = unpack_heartbeat(data).name
        except ProtocolError:
            return
        self._heard[node.node_id] = t_ns

    def view(self, now_ns: int) -> CellView:
        """The view of the cell at an instant."""
        view = self._view
        view.t_s = (now_ns - self._first_ns) * 1e-9 if self._first_ns is not None else 0.0
        for node_id, node in self._nodes.items():
            node.heard_s = (now_ns - self._heard[node_id]) * 1e-9 if node_id in self._heard else None
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
