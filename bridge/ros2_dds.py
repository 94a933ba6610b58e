"""Live ROS 2 topics without ROS: Cyclone DDS with ROS's names, types, hashes and quality of service; commands back.

Topics carry the bytes of the one encoder. Commands are taken only where `[bridge] ros2_commands` says so:
`/canprobe/start` and `/canprobe/stop` (std_msgs/Empty), `/canprobe/target_force` in N and `/canprobe/speed` in m/s
(std_msgs/Float64), and the trajectory of a free arm where ros2_control's controller takes it. Each is answered on
`/canprobe/status`; one that the scene's own limits forbid is refused there. A sample without valid data, as
DDS delivers it when the last writer of a topic leaves or dies, is no command.

Source: ROS 2's mapping to DDS names (`rt/` before a topic), REP 2016 (`typehash=…;` in USER_DATA), rmw_cyclonedds.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import types as python_types
from dataclasses import replace
from typing import Any

import numpy as np
from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration
from numpy.typing import NDArray

from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks import Trajectory
from canprobe.errors import UsageError
from canprobe.lab.bridge.messages import TOPICS, Encoder, Messages, Topic
from canprobe.lab.bridge.sample import Context, Sample

Array = NDArray[np.float64]

# Whether a command from outside may reach the cell: by the same checks that the scene itself has to pass.


def refuse(plan: Plan, kind: str, value: float | None) -> str | None:
    """Why a command is refused, or None.

    A target force or a speed is put into the scene, which is then checked and planned as if it had been written so:
    ranges, `limits.force_max_n`, the speeds of the joints.

    Args:
        plan: of the run.
        kind: start, stop, target_force_n or speed_m_s.
        value: N or m/s; None for start and stop.
    """
    if kind in ("start", "stop"):
        return None
    needs = ("scan", "press") if kind == "target_force_n" else ("scan",)
    task = plan.scene.task
    if task.kind not in needs:
        return f'task.kind = "{task.kind}" has none'
    if value is None or not math.isfinite(value):
        return f"expected a number, got {value}"
    changed = replace(task, force_n=value) if kind == "target_force_n" else replace(task, speed_mm_s=value * 1e3)
    try:
        make_plan(resolve(parse_scene(dump_scene(replace(plan.scene, task=changed)))))
    except UsageError as error:
        return str(error).splitlines()[0].removeprefix("scene: ")
    return None


def trajectory_of(plan: Plan, message: Any, q: Array | None) -> dict[str, Any]:
    """The way that a `trajectory_msgs/msg/JointTrajectory` asks for, checked from where the arm stands.

    Args:
        plan: of the run.
        message: with names, points, and positions in each; velocities in all of them or in none.
        q: (n,) joint positions now, rad or m; None as long as they are not known.

    Returns:
        `points` and `velocities` of a `canprobe.cell.tasks.Trajectory`.

    Raises:
        UsageError: the cell cannot or must not follow it.
    """
    arm = plan.setup.arm
    if arm is None or plan.scene.task.kind != "free":
        raise UsageError(f'task.kind = "{plan.scene.task.kind}" follows none: task.kind = "free" does')
    if q is None:
        raise UsageError("the joints have not reported yet")
    names, known = list(message.joint_names), list(arm.model.chain.joints)
    if sorted(names) != sorted(known):
        raise UsageError(f"expected the joints {', '.join(known)}, got {', '.join(names) or 'none'}")
    order = [names.index(name) for name in known]

    def ordered(values: Any) -> list[float]:
        if len(values) != len(names):
            raise UsageError(f"expected {len(names)} numbers for {len(names)} joints, got {len(values)}")
        return [float(values[i]) for i in order]

    times = [point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec for point in message.points]
    points = [(t, ordered(point.positions)) for t, point in zip(times, message.points, strict=True)]
    moving = [point.velocities for point in message.points if len(point.velocities)]
    velocities = [ordered(one) for one in moving] if moving else None
    if reason := Trajectory(plan, points, velocities).inspect(q):
        raise UsageError(reason)
    return {"points": points, "velocities": velocities}


# ROS 2 message types as Cyclone DDS knows types, made from rosbags' definitions: one type store for all sinks.
#
# A type made here carries messages that are CDR already, byte for byte. Built field by field it is serialised by
# Cyclone itself, which the tests hold against rosbags.
#
# Source: ROS 2's mapping to DDS: `pkg/msg/Name` is `pkg::msg::dds_::Name_`, final, plain CDR (XCDR1).

_BASE: dict[str, Any] = {
    "bool": bool,
    "byte": idl.uint8,
    "char": idl.uint8,
    "string": str,
    **{f"{kind}{bits}": getattr(idl, f"{kind}{bits}") for kind in ("int", "uint") for bits in (8, 16, 32, 64)},
    "float32": idl.float32,
    "float64": idl.float64,
}
_NODE_BASE, _NODE_NAME, _NODE_ARRAY = 1, 2, 3


def _serialize(self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None) -> bytes:
    """What goes onto the wire, encapsulation included: the bytes that a message carries, or its fields."""
    carried = self.__dict__.get("carried")
    if carried is not None:
        return bytes(carried)
    data: bytes = IdlStruct.serialize(self, buffer, endianness, use_version_2)
    return data


class DdsTypes:
    """The DDS types of one type store, each made when it is first asked for.

    Args:
        encoder: with the store.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._made: dict[str, Any] = {}

    def of(self, type_name: str) -> Any:
        """The class of a ROS type, such as `sensor_msgs/msg/JointState`."""
        if type_name not in self._made:
            _, fields = self._encoder.store.fielddefs[type_name]
            self._made[type_name] = self._make(type_name, {name: self._field(node) for name, node in fields})
        return self._made[type_name]

    def carry(self, type_name: str, cdr: bytes) -> Any:
        """A message of a type that will be sent as the bytes that it is."""
        cls = self.of(type_name)
        message = cls.__new__(cls)
        message.__dict__["carried"] = cdr
        return message

    def _make(self, type_name: str, fields: dict[str, Any]) -> Any:
        name = dds_name(type_name)

        def body(namespace: dict[str, Any]) -> None:
            namespace["__annotations__"].update(fields)
            namespace["__module__"] = __name__
            namespace["serialize"] = _serialize

        typename = {"typename": name.replace("::", ".")}
        cls = python_types.new_class(name.rpartition(":")[2], (IdlStruct,), typename, body)
        return annotate.final(dataclasses.dataclass(cls))

    def _field(self, node: tuple[Any, Any]) -> Any:
        kind, of = int(node[0]), node[1]
        if kind == _NODE_BASE:
            return _BASE[of[0]]
        if kind == _NODE_NAME:
            return self.of(of)
        inner, length = self._field(of[0]), of[1]
        if kind == _NODE_ARRAY:
            return idl.array[inner, length]  # type: ignore[misc]
        return idl.sequence[(inner, length) if length else inner]  # type: ignore[misc]


def dds_name(type_name: str) -> str:
    """`sensor_msgs/msg/JointState` → `sensor_msgs::msg::dds_::JointState_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


# The sink.

EMPTY, FLOAT64, STRING = "std_msgs/msg/Empty", "std_msgs/msg/Float64", "std_msgs/msg/String"
START, STOP = Topic("/canprobe/start", EMPTY), Topic("/canprobe/stop", EMPTY)
FORCE, SPEED = Topic("/canprobe/target_force", FLOAT64), Topic("/canprobe/speed", FLOAT64)
TRAJECTORY = Topic("/joint_trajectory_controller/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", depth=1)
STATUS = Topic("/canprobe/status", STRING, depth=10, transient=True)
COMMANDS = {START: "start", STOP: "stop", FORCE: "target_force_n", SPEED: "speed_m_s"}
POLL_SAMPLES = 8
"""Commands are looked for every so many samples."""
LOOPBACK = """\
<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer Address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""One machine, without multicast: as ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST."""


class Ros2Node:
    """A participant with writers and readers that ROS 2 takes for its own.

    Args:
        domain: ROS_DOMAIN_ID.
        loopback: stay on this machine; otherwise as Cyclone is configured (`CYCLONEDDS_URI`).
        encoder: the one encoder.
    """

    def __init__(self, domain: int, loopback: bool, encoder: Encoder) -> None:
        self.types = DdsTypes(encoder)
        self._encoder = encoder
        self._domain = Domain(domain, LOOPBACK) if loopback else None
        self.participant = DomainParticipant(domain)
        self._publisher = Publisher(self.participant)
        self._subscriber = Subscriber(self.participant)

    def writer(self, topic: Topic) -> Any:
        """A writer of `rt/…` with the topic's quality of service."""
        return DataWriter(self._publisher, self._dds_topic(topic), qos=self._qos(topic, _AUTODISPOSE))

    def reader(self, topic: Topic) -> Any:
        """A reader of `rt/…` with the topic's quality of service."""
        return DataReader(self._subscriber, self._dds_topic(topic), qos=self._qos(topic))

    def _dds_topic(self, topic: Topic) -> Any:
        return DdsTopic(self.participant, f"rt{topic.name}", self.types.of(topic.type_name))

    def _qos(self, topic: Topic, *more: Any) -> Any:
        reliable = Policy.Reliability.Reliable(max_blocking_time=duration(milliseconds=100))
        return Qos(
            Policy.Reliability.BestEffort if topic.best_effort else reliable,
            Policy.Durability.TransientLocal if topic.transient else Policy.Durability.Volatile,
            Policy.History.KeepLast(topic.depth),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash={self._encoder.type_hash(topic.type_name)};".encode()),
            *more,
        )


_AUTODISPOSE = Policy.WriterDataLifecycle(autodispose=False)


class Ros2Sink:
    """Publishes one run, and takes commands where the scene allows them.

    Args:
        context: of the run.
    """

    def __init__(self, context: Context) -> None:
        settings, encoder = context.settings, Encoder()
        self._plan = context.plan
        self._send = context.send
        self._encoder = encoder
        domain = domain_of(settings.ros2_domain)
        self._node = Ros2Node(domain, settings.ros2_loopback, encoder)
        self._writers = {topic.name: self._node.writer(topic) for topic in TOPICS}
        self._messages = Messages(context.plan, encoder, self._is_read)
        topics = (*COMMANDS, TRAJECTORY) if settings.ros2_commands else ()
        self._readers = {topic: self._node.reader(topic) for topic in topics}
        self._q: Array | None = None
        self._status = self._node.writer(STATUS) if settings.ros2_commands else None
        self._poll_in = 0
        self.where = f"domain {domain}{', this machine only' if settings.ros2_loopback else ''}"

    def start(self, epoch_ns: int) -> None:
        """Take the epoch."""
        self._messages.epoch_ns = epoch_ns

    def write(self, sample: Sample) -> None:
        """Publish a sample's messages; now and then look for commands."""
        for topic, t_ns, data in self._messages.of(sample):
            self._writers[topic.name].write(self._node.types.carry(topic.type_name, data), t_ns)
        self._q = sample.q if sample.q is not None else self._q
        self._poll_in -= 1
        if self._poll_in <= 0 and self._readers:
            self._poll_in = POLL_SAMPLES
            for topic, reader in self._readers.items():
                kind = self._node.types.of(topic.type_name)
                for message in reader.take(N=10):
                    if isinstance(message, kind):  # the last writer's exit or death comes as a sample without data
                        self._take(topic, message)

    def close(self, summary: str | None) -> None:
        """Let the last messages arrive; the domain is left with the last reference, that is with this process."""
        for topic in TOPICS:
            if not topic.best_effort:
                with contextlib.suppress(DDSException, AttributeError):  # the latter is its time-out in 11.0.1
                    self._writers[topic.name].wait_for_acks(duration(milliseconds=100))
        self._writers.clear()
        self._readers.clear()

    def _is_read(self, topic: Topic) -> bool:
        """Nothing is made for a topic without a reader, unless one that comes later is to have it."""
        return topic.transient or bool(self._writers[topic.name].get_matched_subscriptions())

    def _take(self, topic: Topic, message: Any) -> None:
        """A command; it is a message of the topic's type."""
        if topic is TRAJECTORY:
            self._follow(message)
        else:
            self._command(topic, message.data if topic.type_name == FLOAT64 else None)

    def _command(self, topic: Topic, value: float | None) -> None:
        kind = COMMANDS[topic]
        why = refuse(self._plan, kind, value)
        if why is None:
            self._send({"request": {"kind": kind, "value": value}})
        shown = kind if value is None else f"{kind} {value:g}"
        self._say(f"{shown}: taken" if why is None else f"{shown}: refused: {why}")

    def _follow(self, message: Any) -> None:
        """A trajectory; one without points stops the arm, as ros2_control has it."""
        if not message.points:
            self._command(STOP, None)
            return
        shown = f"trajectory of {len(message.points)} points"
        try:
            asked = trajectory_of(self._plan, message, self._q)
        except UsageError as error:
            self._say(f"{shown}: refused: {str(error).removeprefix('trajectory: ')}")
        else:
            self._send({"request": {"kind": "trajectory", "value": asked}})
            self._say(f"{shown}: taken")

    def _say(self, text: str) -> None:
        assert self._status is not None
        cdr = self._encoder.encode(STRING, self._encoder.store.types[STRING](data=text))
        self._status.write(self._node.types.carry(STRING, cdr))


def domain_of(wanted: int | None) -> int:
    """The scene's domain, else that of ROS_DOMAIN_ID, else 0."""
    if wanted is not None:
        return wanted
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > 232:
        raise UsageError(f"ROS_DOMAIN_ID={text}: expected 0 to 232")
    return int(text)


open_sink = Ros2Sink
