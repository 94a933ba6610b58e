"""Live ROS 2 topics without ROS: Cyclone DDS with ROS's names, types, hashes and quality of service; commands back.

Topics carry the bytes of the one encoder. Commands are taken only where `[bridge] ros2_commands` says so:
`/canprobe/start`, `/canprobe/stop` and `/canprobe/resume` (std_msgs/Empty), `/canprobe/target_force` in N and
`/canprobe/speed` in m/s (std_msgs/Float64), and the trajectory of a free arm where ros2_control's controller takes it.
Each is answered on `/canprobe/status`; one that does not pass the checks of the scene itself is refused there. A sample
without valid data, as DDS delivers it when the last writer of a topic leaves or dies, is no command.

Source: ROS 2's mapping to DDS names (`rt/` before a topic), REP 2016 (`typehash=…;` in USER_DATA), rmw_cyclonedds.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
from typing import Any

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter, Publisher
from cyclonedds.sub import DataReader, Subscriber
from cyclonedds.topic import Topic as DdsTopic
from cyclonedds.util import duration

from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.tasks import Trajectory
from canprobe.errors import UsageError
from canprobe.lab.bridge.dds_types import DdsTypes
from canprobe.lab.bridge.messages import TOPICS, Encoder, Messages, Topic
from canprobe.lab.bridge.sample import Context, Sample
from canprobe.mechanics.types import Floats

EMPTY, FLOAT64, STRING = "std_msgs/msg/Empty", "std_msgs/msg/Float64", "std_msgs/msg/String"
START, STOP = Topic("/canprobe/start", EMPTY), Topic("/canprobe/stop", EMPTY)
RESUME = Topic("/canprobe/resume", EMPTY)
FORCE, SPEED = Topic("/canprobe/target_force", FLOAT64), Topic("/canprobe/speed", FLOAT64)
TRAJECTORY = Topic("/joint_trajectory_controller/joint_trajectory", "trajectory_msgs/msg/JointTrajectory", depth=1)
STATUS = Topic("/canprobe/status", STRING, depth=10, transient=True)
COMMANDS = {START: "start", STOP: "stop", RESUME: "resume", FORCE: "target_force_n", SPEED: "speed_m_s"}
POLL_SAMPLES = 8
"""Number of samples between two looks for commands."""
LOOPBACK = """\
<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer Address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""
"""Configuration for one machine, without multicast, like ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST."""


class Ros2Node:
    """A participant whose writers and readers ROS 2 accepts as its own.

    Args:
        domain: domain, as in ROS_DOMAIN_ID.
        loopback: whether to stay on this machine; else Cyclone's configuration decides (`CYCLONEDDS_URI`).
        encoder: the one encoder.

    Raises:
        UsageError: the system does not let the sockets stay on this machine.
    """

    def __init__(self, domain: int, loopback: bool, encoder: Encoder) -> None:
        self.types = DdsTypes(encoder)
        self._encoder = encoder
        self._domain = Domain(domain, LOOPBACK) if loopback else None
        self.participant = DomainParticipant(domain)
        if loopback:
            _bind_to_loopback(domain)  # before there is a reader that could take a command
        self._publisher = Publisher(self.participant)
        self._subscriber = Subscriber(self.participant)

    def writer(self, topic: Topic) -> Any:
        """A writer of `rt/…` with the topic's quality of service."""
        kept = Policy.WriterDataLifecycle(autodispose=False)
        return DataWriter(self._publisher, self._dds_topic(topic), qos=self._qos(topic, kept))

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


class Ros2Sink:
    """Publishes one run, and takes commands where the scene allows them.

    Args:
        context: plan and settings of the run.
    """

    def __init__(self, context: Context) -> None:
        settings, encoder = context.settings, Encoder()
        self._plan, self._send, self._encoder = context.plan, context.send, encoder
        domain = domain_of(settings.ros2_domain)
        self._node = Ros2Node(domain, settings.ros2_loopback, encoder)
        self._writers = {topic.name: self._node.writer(topic) for topic in TOPICS}
        self._messages = Messages(context.plan, encoder, self._is_read)
        topics = (*COMMANDS, TRAJECTORY) if settings.ros2_commands else ()
        self._readers = {topic: self._node.reader(topic) for topic in topics}
        self._q: Floats | None = None
        self._status = self._node.writer(STATUS) if settings.ros2_commands else None
        self._poll_in = 0
        self.where = f"domain {domain}{', this machine only' if settings.ros2_loopback else ''}"

    def start(self, epoch_ns: int) -> None:
        """Take the epoch."""
        self._messages.epoch_ns = epoch_ns

    def write(self, sample: Sample) -> None:
        """Publish a sample's messages, and from time to time look for commands."""
        for topic, t_ns, data in self._messages.of(sample):
            self._writers[topic.name].write(self._node.types.carry(topic.type_name, data), t_ns)
        self._q = sample.q if sample.q is not None else self._q
        self._poll_in -= 1
        if self._poll_in <= 0 and self._readers:
            self._poll_in = POLL_SAMPLES
            for topic, reader in self._readers.items():
                kind = self._node.types.of(topic.type_name)
                for message in reader.take(N=10):
                    if not isinstance(message, kind):  # the last writer's exit or death: a sample without data
                        continue
                    if topic is TRAJECTORY:
                        self._follow(message)
                    else:
                        self._command(topic, message.data if topic.type_name == FLOAT64 else None)

    def close(self, summary: str | None) -> None:
        """Let the last messages arrive; the domain is left when this process ends."""
        for topic in TOPICS:
            if not topic.best_effort:
                with contextlib.suppress(DDSException, AttributeError):  # the latter is its time-out in 11.0.1
                    self._writers[topic.name].wait_for_acks(duration(milliseconds=100))
        self._writers.clear()
        self._readers.clear()

    def _is_read(self, topic: Topic) -> bool:
        """Whether a topic has a reader, or keeps its last message for a later one."""
        return topic.transient or bool(self._writers[topic.name].get_matched_subscriptions())

    def _command(self, topic: Topic, value: float | None) -> None:
        kind = COMMANDS[topic]
        why = refuse(self._plan, kind, value)
        if why is None:
            self._send({"request": {"kind": kind, "value": value}})
        shown = kind if value is None else f"{kind} {value:g}"
        self._say(f"{shown}: taken" if why is None else f"{shown}: refused: {why}")

    def _follow(self, message: Any) -> None:
        """Take a trajectory; one without points stops the arm, as in ros2_control."""
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


def _bind_to_loopback(domain: int) -> None:
    """Let the sockets of a domain receive from the loopback interface only.

    Whatever its configuration, Cyclone binds those that receive to 0.0.0.0, where every machine on the network reaches
    them. They are its own: they are found among this process's by the ports of the domain.

    Source: DDSI-RTPS 9.6.2.3, ports 7400 + 250 domain + 0 … 249.
    """
    first = 7400 + 250 * domain
    for descriptor in map(int, os.listdir("/proc/self/fd")):
        try:
            found = socket.socket(fileno=descriptor)
        except OSError:  # it is no socket
            continue
        try:
            if found.type is socket.SOCK_DGRAM and found.family is socket.AF_INET:
                address, port = found.getsockname()
                if first <= port < first + 250 and not address.startswith("127."):
                    found.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
        except OSError as error:
            raise UsageError(
                f"bridge.ros2_loopback: the sockets of domain {domain} cannot be kept on this machine:"
                f" {error.strerror}; Linux 5.7 and later can, earlier ones as root"
            ) from error
        finally:
            found.detach()  # it stays Cyclone's


def domain_of(wanted: int | None) -> int:
    """The domain of the scene, else of ROS_DOMAIN_ID, else 0."""
    if wanted is not None:
        return wanted
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > 232:
        raise UsageError(f"ROS_DOMAIN_ID={text}: expected 0 to 232")
    return int(text)


open_sink = Ros2Sink


def refuse(plan: Plan, kind: str, value: float | None) -> str | None:
    """Why a command is refused, or None.

    A target force or a speed is put into the scene, which is then checked and planned as if its file had it:
    ranges, `limits.force_max_n`, the speeds of the joints.

    Args:
        plan: plan of the run.
        kind: kind of the command: start, stop, resume, target_force_n or speed_m_s.
        value: value in N or m/s; None for start, stop and resume.
    """
    if kind in ("start", "stop", "resume"):
        return None
    needs = ("scan", "press") if kind == "target_force_n" else ("scan",)
    task = plan.scene.task
    if task.kind not in needs:
        return f'task.kind = "{task.kind}" has none'
    if value is None or not math.isfinite(value):
        return f"expected a number, got {value}"
    changed = {"task.force_n": value} if kind == "target_force_n" else {"task.speed_mm_s": value * 1e3}
    try:
        make_plan(resolve(load_scene(plan.scene, changed)))
    except UsageError as error:
        return str(error).splitlines()[0].removeprefix(f"{plan.scene.name} as changed: ")
    return None


def trajectory_of(plan: Plan, message: Any, q: Floats | None) -> dict[str, Any]:
    """The trajectory of a `trajectory_msgs/msg/JointTrajectory`, checked from the present position of the arm.

    Args:
        plan: plan of the run.
        message: trajectory with joint names and points; positions in each point, velocities in all of them or in none.
        q: present joint positions (n,), rad or m; None as long as they are not known.

    Returns:
        `points` and `velocities` of a `canprobe.cell.tasks.Trajectory`.

    Raises:
        UsageError: when the cell cannot or must not follow it.
    """
    arm = plan.setup.arm
    if arm is None or plan.scene.task.kind != "free":
        raise UsageError(f'task.kind = "{plan.scene.task.kind}" follows no trajectory: task.kind = "free" does')
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
