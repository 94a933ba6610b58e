"""ROS 2 without ROS: this process is a second DDS participant on loopback, and Cyclone's own serialiser the witness."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from collections import deque
from itertools import count

import numpy as np
import pytest
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import Policy
from waiting import wait_until

import canprobe
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.cell.tasks.requested import Request, RequestedTask
from canprobe.errors import UsageError
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG
from canprobe.lab.bridge import ros2_dds as ros2
from canprobe.lab.bridge.dds_types import DdsTypes, dds_name
from canprobe.lab.bridge.description import robot_description
from canprobe.lab.bridge.messages import (
    CLOCK,
    JOINT_STATES,
    ROBOT_DESCRIPTION,
    TAXELS,
    TF_STATIC,
    TOPICS,
    Encoder,
    Messages,
    encode_can_frame,
)
from canprobe.lab.bridge.sample import Context, Sample

DOMAIN = 90 + os.getpid() % 100  # of this test alone; 232 is the highest
SINK_DOMAIN = DOMAIN - 90
"""A process opens a domain once."""

JAZZY = {  # as `ros2 topic info --verbose` of ROS 2 Jazzy prints them
    "sensor_msgs/msg/JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}


@pytest.fixture(scope="module")
def encoder():
    return Encoder()


@pytest.fixture(scope="module")
def messages(recorded, samples, encoder):
    """Every message of the shared run: (topic, CDR)."""
    maker = Messages(recorded.result.plan, encoder)
    return [(topic, data) for sample in samples for topic, _, data in maker.of(sample)]


@pytest.fixture
def plan(recorded):
    text = dump_scene(recorded.result.plan.scene)
    text = text.replace("ros2_commands = false", f"ros2_domain = {DOMAIN}\nros2_commands = true")
    return canprobe.plan(parse_scene(text))


def test_cyclone_itself_makes_the_same_bytes(messages, encoder):
    """Decoded and encoded again by Cyclone's serialiser, which shares nothing with rosbags: every type of the run."""
    types = DdsTypes(encoder)
    seen = {}
    for topic, data in messages:
        if seen.setdefault(topic.name, 0) < 20:
            seen[topic.name] += 1
            message = types.of(topic.type_name).deserialize(data)
            assert bytes(message.serialize(use_version_2=False)).rstrip(b"\0") == data.rstrip(b"\0"), topic.name
            assert types.carry(topic.type_name, data).serialize(use_version_2=False) == data
    assert seen.keys() == {topic.name for topic in TOPICS} - {"/can_fd_frames"}


@pytest.mark.parametrize(
    ("t_ns", "can_id", "data"),
    [
        (0, 0x7FF, b""),
        (1_700_000_000_123_456_789, 0x1ABCDEF0 | EFF_FLAG, b"\x01\x02\x03"),
        (5, 0x181 | RTR_FLAG, b"12345678"),
    ],
)
def test_a_can_frame_is_encoded_as_the_encoder_would(t_ns, can_id, data, encoder):
    types = encoder.store.types
    stamp = types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    message = types["can_msgs/msg/Frame"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
        id=can_id & 0x1FFFFFFF,
        is_rtr=bool(can_id & RTR_FLAG),
        is_extended=bool(can_id & EFF_FLAG),
        is_error=False,
        dlc=len(data),
        data=np.frombuffer(data.ljust(8, b"\0"), np.uint8),
    )
    assert encode_can_frame(t_ns, can_id, data) == encoder.encode("can_msgs/msg/Frame", message)


@pytest.mark.parametrize("name", JAZZY)
def test_hashes_are_those_of_ros(name, encoder):
    assert encoder.type_hash(name) == JAZZY[name]


def until(condition, observations, bridge, most=4000):
    """Feed the bridge until a condition holds; it is asked once a slice."""
    for _, first in zip(range(most), itertools.cycle(range(0, len(observations), 16)), strict=False):
        for observation in observations[first : first + 16]:
            bridge.observe(observation)
        if (found := condition()) is not None:
            return found
    pytest.fail("it did not come")


def test_another_process_sees_ros_topics_and_commands_the_cell_within_its_limits(recorded, plan, bridge_of):
    bridge = bridge_of("ros2", plan)
    bridge.await_ready()
    encoder = Encoder()
    node = ros2.Ros2Node(DOMAIN, True, encoder)
    builtin = BuiltinDataReader(node.participant, BuiltinTopicDcpsPublication)
    joints, static, taxels = (node.reader(topic) for topic in (JOINT_STATES, TF_STATIC, TAXELS))
    feed = recorded.observations
    first = until(lambda: next(iter(joints.take(N=1)), None), feed, bridge)
    logged = recorded.log("q_rad")
    assert np.abs(logged[np.isfinite(logged).all(axis=1)] - np.array(first.position)).max(axis=1).min() == 0.0
    fixed = until(lambda: next(iter(static.take(N=1)), None), feed, bridge)  # sent before we were there
    assert [t.child_frame_id for t in fixed.transforms[:2]] == ["flange", "probe"]
    image = until(lambda: next(iter(taxels.take(N=1)), None), feed, bridge)
    assert len(image.data) == 256

    offered = {one.topic_name: one for one in builtin.take(N=200)}
    for topic in TOPICS:
        endpoint = offered[f"rt{topic.name}"]
        assert endpoint.type_name == dds_name(topic.type_name)
        assert endpoint.qos[Policy.Userdata].data == f"typehash={encoder.type_hash(topic.type_name)};".encode()
        assert (endpoint.qos[Policy.Reliability] == Policy.Reliability.BestEffort) == topic.best_effort
        assert (endpoint.qos[Policy.Durability] == Policy.Durability.TransientLocal) == topic.transient

    force, speed, stop = (node.writer(topic) for topic in (ros2.FORCE, ros2.SPEED, ros2.STOP))
    status = node.reader(ros2.STATUS)
    number, nothing = node.types.of(ros2.FLOAT64), node.types.of(ros2.EMPTY)
    said = []

    def answers(count):
        said.extend(message.data for message in status.take(N=10))
        return said if len(said) >= count else None

    until(lambda: True if all(w.get_matched_subscriptions() for w in (force, speed, stop)) else None, feed, bridge)
    force.write(number(data=3.0))
    until(lambda: answers(1), feed, bridge)
    force.write(number(data=50.0))
    until(lambda: answers(2), feed, bridge)
    speed.write(number(data=-0.01))
    until(lambda: answers(3), feed, bridge)
    stop.write(nothing(structure_needs_at_least_one_member=0))
    until(lambda: answers(4), feed, bridge)
    until(lambda: True if len(bridge.requests) >= 2 else None, feed, bridge)
    assert said[0] == "target_force_n 3: taken"
    assert said[1].startswith("target_force_n 50: refused: task.force_n: expected")
    assert said[2].startswith("speed_m_s -0.01: refused: task.speed_mm_s: expected")
    assert said[3] == "stop: taken"
    assert list(bridge.requests) == [Request("target_force_n", 3.0), Request("stop")]
    assert bridge.end("{}")["error"] is None


PUBLISHER = """
import sys
from canprobe.lab.bridge import ros2_dds as ros2
ros2.LOOPBACK = ros2.LOOPBACK.replace("<Discovery>", "<Discovery><LeaseDuration>300ms</LeaseDuration>")
node = ros2.Ros2Node(int(sys.argv[1]), True, ros2.Encoder())
of, topics = node.types.of, {name: getattr(ros2, name) for name in sys.argv[2:]}
writers = {name: node.writer(topic) for name, topic in topics.items()}
for line in sys.stdin:
    name, _, fields = line.partition(" ")
    writers[name].write(of(topics[name].type_name)(*eval(fields)))
"""
"""Writes a message for each line, a topic and its fields; leaves at their end. Killed, it is dead after 300 ms."""
NO_POINTS = "of('std_msgs/msg/Header')(of('builtin_interfaces/msg/Time')(0, 0), ''), [], []"


def test_a_writer_that_leaves_or_dies_commands_nothing(free):
    """DDS delivers a sample without data then: an exit must not start an arm that was stopped, nor end the bridge."""
    text = dump_scene(free[0]).replace(f"ros2_domain = {DOMAIN}", f"ros2_domain = {SINK_DOMAIN}")
    plan, got = canprobe.plan(parse_scene(text)), []
    context = Context(plan, plan.scene.bridge, None, lambda document: got.append(document["request"]["kind"]))
    sink = ros2.Ros2Sink(context)

    def until(done):
        looks = count()

        def looked():
            sink.write(Sample(0))
            return done()

        wait_until(looked, lambda: next(looks) < 2000, lambda: got)
        for _ in range(2 * ros2.POLL_SAMPLES):  # what came with it is taken, too
            sink.write(Sample(0))

    def open_publisher(*names):
        command = [sys.executable, "-c", PUBLISHER, str(SINK_DOMAIN), *names]
        return subprocess.Popen(command, stdin=subprocess.PIPE, text=True)

    def writers(*topics):
        return [bool(sink._readers[topic].get_matched_publications()) for topic in topics]

    with open_publisher("START", "TRAJECTORY") as leaves, open_publisher("STOP") as dies:
        try:
            until(lambda: all(writers(ros2.START, ros2.TRAJECTORY, ros2.STOP)))
            for publisher, line in ((leaves, "START 0,"), (leaves, f"TRAJECTORY {NO_POINTS}"), (dies, "STOP 0,")):
                print(line, file=publisher.stdin, flush=True)
                got.append(None)
                until(lambda: got[-1] is not None)
            assert list(filter(None, got)) == ["start", "stop", "stop"]
            leaves.stdin.close()
            until(lambda: not any(writers(ros2.START, ros2.TRAJECTORY)))
            dies.kill()
            until(lambda: not any(writers(ros2.STOP)))
        finally:
            leaves.kill()
            dies.kill()
    assert list(filter(None, got)) == ["start", "stop", "stop"]


KEPT_NODE = """
import json, os, socket, sys
from canprobe.lab.bridge import ros2_dds as ros2

node = ros2.Ros2Node(77, sys.argv[1] == "loopback", ros2.Encoder())
open_sockets = []
for descriptor in map(int, os.listdir("/proc/self/fd")):
    try:
        one = socket.socket(fileno=descriptor)
    except OSError:
        continue
    device = one.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16).rstrip(bytes(1)).decode()
    open_sockets.append((*one.getsockname(), device))
    one.detach()
print(json.dumps(open_sockets), flush=True)
sys.stdin.read()
"""
"""A participant in its own process, which prints address, port and device of each of its sockets, and waits."""


@pytest.mark.parametrize(("kept", "open_to_others"), [("loopback", False), ("network", True)])
def test_a_socket_of_a_domain_receives_from_elsewhere_only_where_it_is_asked_for(kept, open_to_others):
    with subprocess.Popen(
        [sys.executable, "-c", KEPT_NODE, kept], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        sockets = json.loads(process.stdout.readline())
        process.stdin.close()
    assert len(sockets) >= 2
    beyond = [one for one in sockets if not one[0].startswith("127.") and one[2] != "lo"]
    assert bool(beyond) is open_to_others, sockets


@pytest.mark.parametrize(
    ("kind", "value", "why"),
    [
        ("target_force_n", 3.0, None),
        ("target_force_n", 5.0, "less than limits.force_max_n = 5"),
        ("target_force_n", float("nan"), "expected a number"),
        ("speed_m_s", 0.3, "task.speed_mm_s"),
        ("start", None, None),
    ],
)
def test_limits_are_those_of_the_scene(recorded, kind, value, why):
    refused = ros2.refuse(recorded.result.plan, kind, value)
    assert refused is None if why is None else why in refused


def test_a_speed_that_the_joints_cannot_follow_is_refused_with_the_joint(recorded):
    """Within the range of the key, but not of the arm: the plan of the changed scene says so."""
    text = dump_scene(recorded.result.plan.scene).replace("joint_speed_share = 1.0", "joint_speed_share = 0.5")
    refused = ros2.refuse(canprobe.plan(parse_scene(text)), "speed_m_s", 0.19)
    assert refused is not None and "joint" in refused


# A free arm: what RViz needs to show it, and trajectories as ros2_control's controller takes them.


@pytest.fixture(scope="module")
def free():
    """The scene `free` that takes commands, and what a bridge sees of half a second of it."""
    text = dump_scene(canprobe.load_scene("free")) + f"[bridge]\nros2_domain = {DOMAIN}\nros2_commands = true\n"
    scene, seen = parse_scene(text), []
    canprobe.run(scene, files=False, duration_s=0.3, observers=(seen.append,))
    return scene, seen


def asked_for(node, names, points):
    """A JointTrajectory as rclpy would make it, encoded by Cyclone: points are (seconds, positions, velocities)."""
    of = node.types.of
    duration, stamp = of("builtin_interfaces/msg/Duration"), of("builtin_interfaces/msg/Time")
    return of(ros2.TRAJECTORY.type_name)(
        header=of("std_msgs/msg/Header")(stamp=stamp(sec=0, nanosec=0), frame_id=""),
        joint_names=list(names),
        points=[
            of("trajectory_msgs/msg/JointTrajectoryPoint")(
                positions=list(q),
                velocities=list(qd),
                accelerations=[],
                effort=[],
                time_from_start=duration(sec=int(t), nanosec=round(t % 1 * 1e9)),
            )
            for t, q, qd in points
        ],
    )


def test_a_free_arm_is_described_and_follows_a_trajectory_within_its_limits(free, bridge_of):
    scene, feed = free
    plan = canprobe.plan(scene)
    bridge = bridge_of("ros2", plan)
    bridge.await_ready()
    node = ros2.Ros2Node(DOMAIN, True, Encoder())
    description, clock, status = (node.reader(topic) for topic in (ROBOT_DESCRIPTION, CLOCK, ros2.STATUS))
    said = until(lambda: next(iter(description.take(N=1)), None), feed, bridge)  # sent before we were there
    assert said.data == robot_description(plan)
    now = until(lambda: next(iter(clock.take(N=1)), None), feed, bridge).clock
    assert now.sec * 10**9 + now.nanosec in {o.t_ns for o in feed}

    names, q0 = plan.setup.arm.model.chain.joints, plan.setup.arm.q_start
    writer = node.writer(ros2.TRAJECTORY)
    until(lambda: True if writer.get_matched_subscriptions() else None, feed, bridge)

    def answer_to(message):
        writer.write(message)
        return until(lambda: next(iter(status.take(N=1)), None), feed, bridge).data

    goal, still = q0 + 0.1, [()] * 2
    turned = [(t, q[::-1], qd) for t, q, qd in zip((1.0, 2.0), (q0 + 0.05, goal), still, strict=True)]
    assert answer_to(asked_for(node, names[::-1], turned)) == "trajectory of 2 points: taken"  # in any order
    assert "refused: point 1: joint 1 at" in answer_to(asked_for(node, names, [(1.0, q0 + 9.0, ())]))
    assert "limit" in answer_to(asked_for(node, names, [(0.01, goal, ())]))
    assert "expected the joints" in answer_to(asked_for(node, names[:3], [(1.0, goal[:3], ())]))
    assert "expected 6 numbers" in answer_to(asked_for(node, names, [(1.0, goal[:3], ())]))
    assert "velocities" in answer_to(asked_for(node, names, [(1.0, goal, ()), (2.0, goal, np.zeros(6))]))
    assert answer_to(asked_for(node, names, [])) == "stop: taken"
    until(lambda: True if len(bridge.requests) >= 2 else None, feed, bridge)
    followed, stopped = bridge.requests
    assert stopped == Request("stop")
    assert bridge.end("{}")["error"] is None
    with canprobe.open_cell(scene, bus="direct") as cell:
        result = cell.run(RequestedTask(None, None, (deque([followed]),), 2.5e-3, cell.plan))
    np.testing.assert_allclose(result.log["q_rad"][-1], goal, atol=1e-3)


def test_a_press_follows_no_trajectory(press_plan):
    with pytest.raises(UsageError, match=r'task\.kind = "press"'):
        ros2.trajectory_of(press_plan, None, None)


def test_the_domain_is_that_of_the_environment_unless_the_scene_has_one(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    assert (ros2.domain_of(None), ros2.domain_of(7)) == (42, 7)
    monkeypatch.delenv("ROS_DOMAIN_ID")
    assert ros2.domain_of(None) == 0
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(UsageError, match="ROS_DOMAIN_ID=many: expected 0 to 232"):
        ros2.domain_of(None)
