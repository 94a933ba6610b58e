"""ROS 2 messages and their topics: sample → CDR, for every ROS sink.

The encoder is `rosbags`. Source: ROS 2 Jazzy's message definitions as rosbags carries them; can_msgs of ros_canopen and
ros2_socketcan_msgs, which it does not carry.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.geometry import T_flange_probe
from canprobe.cell.session.target import VIRTUAL
from canprobe.fieldbus.bus.port import TimedFrame
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, EFF_FLAG, RTR_FLAG
from canprobe.lab.bridge import description
from canprobe.lab.bridge.sample import BASE, CARRIER, CONTACT, FLANGE, PROBE, Sample, SurfacePatch, TouchFrame
from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.types import Floats

CAN_FRAME = "can_msgs/msg/Frame"
CAN_FD_FRAME = "ros2_socketcan_msgs/msg/FdFrame"
_CAN_FRAME_MSG = """\
std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""

_CAN_FD_FRAME_MSG = """\
std_msgs/Header header
uint32 id
bool is_extended
bool is_error
uint8 len
uint8[<=64] data
"""
_CAN_FRAME_CDR = struct.Struct("<4siIIB3xI???B8s")
"""Encapsulation, stamp, an empty frame_id, id, three flags, dlc, data: a cycle has twenty such frames."""
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def encode_can_frame(t_ns: int, can_id: int, data: bytes) -> bytes:
    """A `can_msgs/msg/Frame` as the encoder makes it, for a fiftieth of its time.

    Args:
        t_ns: time since the epoch.
        can_id: identifier with `EFF_FLAG` and `RTR_FLAG`.
        data: data, up to 8 bytes.
    """
    seconds, ns = divmod(t_ns, 1_000_000_000)
    identifier, extended = _identifier(can_id)
    remote = bool(can_id & RTR_FLAG)
    return _CAN_FRAME_CDR.pack(_LITTLE_ENDIAN, seconds, ns, 1, 0, identifier, remote, extended, False, len(data), data)


def _identifier(can_id: int) -> tuple[int, bool]:
    """The identifier without flags, and whether it has 29 bits."""
    extended = bool(can_id & EFF_FLAG)
    return can_id & (0x1FFFFFFF if extended else 0x7FF), extended


class Encoder:
    """ROS 2 messages → CDR, their definitions, and their RIHS01 hashes; one for each sink.

    Attributes:
        store: type store of rosbags; `types[name]` are the message classes.
    """

    def __init__(self) -> None:
        self.store: Any = get_typestore(Stores.ROS2_JAZZY)
        self.store.register(get_types_from_msg(_CAN_FRAME_MSG, CAN_FRAME))
        self.store.register(get_types_from_msg(_CAN_FD_FRAME_MSG, CAN_FD_FRAME))

    def encode(self, type_name: str, message: object) -> bytes:
        """A message as CDR, little-endian, with its four bytes of encapsulation."""
        return bytes(self.store.serialize_cdr(message, type_name))

    def definition(self, type_name: str) -> str:
        """The definition for MCAP's `ros2msg` and Foxglove, with all types that it refers to."""
        text, _ = self.store.generate_msgdef(type_name, ros_version=2)
        return str(text)

    def type_hash(self, type_name: str) -> str:
        """The hash `RIHS01_…`, which ROS 2 compares before it connects (REP 2016)."""
        return str(self.store.hash_rihs01(type_name))


@dataclass(frozen=True, slots=True)
class Topic:
    """One topic, with the quality of service that ROS expects of it.

    Attributes:
        name: name in ROS.
        type_name: name of the type in rosbags and ROS.
        depth: number of messages that are kept.
        transient: whether late readers get the last message (transient local).
        best_effort: whether a lost message is not sent again (sensor data); else reliable.
    """

    name: str
    type_name: str
    depth: int = 10
    transient: bool = False
    best_effort: bool = False


JOINT_STATES = Topic("/joint_states", "sensor_msgs/msg/JointState")
WRENCH = Topic("/wrench", "geometry_msgs/msg/WrenchStamped")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", depth=100)
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", depth=1, transient=True)
TAXELS = Topic("/taxels/image", "sensor_msgs/msg/Image", depth=5, best_effort=True)
PATCH = Topic("/surface_patch", "sensor_msgs/msg/PointCloud2", depth=5)
CURVATURE = Topic("/curvature", "geometry_msgs/msg/Vector3Stamped")
CAN_FD_FRAMES = Topic("/can_fd_frames", CAN_FD_FRAME, depth=500)
CAN_FRAMES = Topic("/can_frames", CAN_FRAME, depth=500)
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
ROBOT_DESCRIPTION = Topic("/robot_description", "std_msgs/msg/String", depth=1, transient=True)
CLOCK = Topic("/clock", "rosgraph_msgs/msg/Clock", depth=1)
"""Clock of a run in virtual time, for nodes with `use_sim_time`; in a recording each message has its time."""
TOPICS = (
    *(JOINT_STATES, WRENCH, TF, TF_STATIC, TAXELS, PATCH, CURVATURE, CAN_FRAMES, CAN_FD_FRAMES, DIAGNOSTICS),
    *(ROBOT_DESCRIPTION, CLOCK),
)
Message = tuple[Topic, int, bytes]
"""Topic, time in ns since the epoch, CDR."""
_FLOAT32, _PATCH_FIELDS = 7, ("x", "y", "z", "sigma")


class Messages:
    """Makes the messages of one run.

    Args:
        plan: plan of the run.
        encoder: the one encoder.
        wanted: whether a topic has a reader; messages of other topics are not made.
        static_every_ns: period at which the fixed frames are sent again; by default they are sent once.
    """

    def __init__(
        self,
        plan: Plan,
        encoder: Encoder,
        wanted: Callable[[Topic], bool] = lambda _: True,
        static_every_ns: int = 1 << 62,
    ) -> None:
        self.encoder = encoder
        self.epoch_ns = 0
        self._types: Any = encoder.store.types
        arm, probe = plan.setup.arm, plan.scene.probe
        self._chain = arm.model.chain if arm is not None else None
        self._object_frame = BASE if plan.setup.carrier is None else CARRIER
        self._T_flange_probe = T_flange_probe(probe) if arm is not None and probe is not None else None
        self._description = description.robot_description(plan)
        self._is_virtual = plan.scene.bus.interface in VIRTUAL
        self._wanted = wanted
        self._static_every_ns = static_every_ns
        self._static_due_ns = -(1 << 62)
        self._fields = [
            self._make("sensor_msgs/msg/PointField", name=name, offset=4 * i, datatype=_FLOAT32, count=1)
            for i, name in enumerate(_PATCH_FIELDS)
        ]

    def of(self, sample: Sample) -> Iterator[Message]:
        """Every wanted message of a sample, with its time."""
        yield from self._can_frames(sample.frames)
        for topic, t_ns, make in self._parts(sample):
            if self._wanted(topic):
                yield topic, self._epoch_time(t_ns), self.encoder.encode(topic.type_name, make())

    def _can_frames(self, frames: Sequence[TimedFrame]) -> Iterator[Message]:
        """One message for each frame: up to 8 bytes, or a longer one of CAN FD."""
        classic, fd = self._wanted(CAN_FRAMES), self._wanted(CAN_FD_FRAMES)
        for can_id, data, at_ns in frames:
            t_ns = self._epoch_time(at_ns)
            if len(data) <= CLASSIC_BYTES:
                if classic:
                    yield CAN_FRAMES, t_ns, encode_can_frame(t_ns, can_id, data)
            elif fd:
                identifier, extended = _identifier(can_id)
                fields = {"id": identifier, "is_extended": extended, "is_error": False, "len": len(data)}
                message = self._stamped(CAN_FD_FRAMES, at_ns, "", **fields, data=np.frombuffer(data, np.uint8))
                yield CAN_FD_FRAMES, t_ns, self.encoder.encode(CAN_FD_FRAMES.type_name, message)

    def _parts(self, sample: Sample) -> Iterator[tuple[Topic, int, Callable[[], Any]]]:
        """Parts of a sample: topic, time, and function that makes the message."""
        t_ns, q, touch, patch = sample.t_ns, sample.q, sample.touch, sample.patch
        if self._chain is not None and t_ns >= self._static_due_ns:
            self._static_due_ns = t_ns + self._static_every_ns
            yield TF_STATIC, t_ns, lambda: self._static(t_ns)
            yield ROBOT_DESCRIPTION, t_ns, lambda: self._make("std_msgs/msg/String", data=self._description)
        if self._is_virtual and sample.cycle is not None:
            yield CLOCK, t_ns, lambda: self._make(CLOCK.type_name, clock=self._time(t_ns))
        if q is not None and (chain := self._chain) is not None:
            yield JOINT_STATES, t_ns, lambda: self._joint_state(t_ns, chain, q)
            yield TF, t_ns, lambda: self._tf(t_ns, description.link_transforms(chain, q))
        if (carrier := sample.T_base_carrier) is not None:
            yield TF, t_ns, lambda: self._tf(t_ns, [(BASE, CARRIER, carrier)])
        if touch is not None:
            if (counts := touch.counts) is not None:
                yield TAXELS, touch.t_ns, lambda: self._image(touch.t_ns, counts)
            yield WRENCH, touch.t_ns, lambda: self._wrench(touch)
            if (contact := touch.contact) is not None:
                placed = [(self._object_frame, CONTACT, contact.T_base_contact)]
                yield TF, touch.t_ns, lambda: self._tf(touch.t_ns, placed)
        if patch is not None:
            yield PATCH, patch.t_ns, lambda: self._cloud(patch)
            yield CURVATURE, patch.t_ns, lambda: self._curvature(patch)
        if sample.diagnostics:
            yield DIAGNOSTICS, t_ns, lambda: self._diagnostics(sample)

    # one function a message

    def _joint_state(self, t_ns: int, chain: Chain, q: Floats) -> Any:
        unknown = np.zeros(0)  # rates and torques in SI units are not measured: left empty, as the message allows
        return self._stamped(
            JOINT_STATES, t_ns, BASE, name=list(chain.joints), position=q, velocity=unknown, effort=unknown
        )

    def _static(self, t_ns: int) -> Any:
        assert self._chain is not None
        fixed = [description.flange_transform(self._chain)]
        if self._T_flange_probe is not None:
            fixed.append((FLANGE, PROBE, self._T_flange_probe))
        return self._tf(t_ns, [*fixed, *description.axis_transforms(self._chain)])

    def _wrench(self, touch: TouchFrame) -> Any:
        force, torque = self._vector(touch.force), self._vector(np.zeros(3))
        body = self._make("geometry_msgs/msg/Wrench", force=force, torque=torque)
        return self._stamped(WRENCH, touch.t_ns, PROBE, wrench=body)

    def _image(self, t_ns: int, counts: NDArray[np.uint8]) -> Any:
        rows, columns = counts.shape
        size, data = {"height": rows, "width": columns, "step": columns}, counts.ravel()
        return self._stamped(TAXELS, t_ns, PROBE, **size, encoding="mono8", is_bigendian=0, data=data)

    def _cloud(self, patch: SurfacePatch) -> Any:
        points, sigma = patch.grid()
        rows = np.column_stack([points, sigma]).astype("<f4")
        size = {"height": 1, "width": len(rows), "point_step": 4 * len(_PATCH_FIELDS), "row_step": rows.nbytes}
        content = {"data": np.frombuffer(rows.tobytes(), np.uint8), "is_dense": bool(np.isfinite(rows).all())}
        form = {"fields": self._fields, "is_bigendian": False}
        return self._stamped(PATCH, patch.t_ns, self._object_frame, **size, **form, **content)

    def _curvature(self, patch: SurfacePatch) -> Any:
        """Principal curvatures κ1, κ2 as x and y, 1/m, for plots; z is their mean."""
        first, second = patch.kappa
        vector = self._vector(np.array([first, second, 0.5 * (first + second)]))
        return self._stamped(CURVATURE, patch.t_ns, CONTACT, vector=vector)

    def _diagnostics(self, sample: Sample) -> Any:
        status = []
        for d in sample.diagnostics:
            values = [self._make("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in d.values]
            words = {"name": d.name, "message": d.message, "hardware_id": "canprobe"}
            status.append(self._make("diagnostic_msgs/msg/DiagnosticStatus", level=d.level, values=values, **words))
        return self._stamped(DIAGNOSTICS, sample.t_ns, "", status=status)

    # parts of messages

    def _epoch_time(self, t_ns: int) -> int:
        return max(self.epoch_ns + t_ns, 0)  # a sample may be a moment older than the bus

    def _make(self, type_name: str, **fields: Any) -> Any:
        return self._types[type_name](**fields)

    def _stamped(self, topic: Topic, t_ns: int, frame_id: str, **fields: Any) -> Any:
        """A message of a topic's type that begins with a header."""
        return self._make(topic.type_name, header=self._header(t_ns, frame_id), **fields)

    def _header(self, t_ns: int, frame_id: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(t_ns), frame_id=frame_id)

    def _time(self, t_ns: int) -> Any:
        seconds, ns = divmod(self._epoch_time(t_ns), 1_000_000_000)
        return self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=ns)

    def _vector(self, v: Floats) -> Any:
        x, y, z = v.tolist()
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)

    def _tf(self, t_ns: int, transforms: list[tuple[str, str, Floats]]) -> Any:
        stamped = []
        for parent, child, T in transforms:
            x, y, z, w = description.quaternion_of(T[:3, :3])
            rotation = self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
            transform = self._make("geometry_msgs/msg/Transform", translation=self._vector(T[:3, 3]), rotation=rotation)
            header, name = self._header(t_ns, parent), "geometry_msgs/msg/TransformStamped"
            stamped.append(self._make(name, header=header, child_frame_id=child, transform=transform))
        return self._make("tf2_msgs/msg/TFMessage", transforms=stamped)
