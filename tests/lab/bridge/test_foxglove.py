"""The Foxglove server, spoken to by a plain WebSocket client that knows only the published protocol.

Source: Foxglove WebSocket protocol, `foxglove.sdk.v1`: JSON text for control, binary with opcode 1 for message data.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import socket
import struct
from importlib import resources

import numpy as np
import pytest
from mcap.records import Schema
from mcap_ros2.decoder import DecoderFactory
from patience import patience_s
from websockets.exceptions import InvalidHandshake
from websockets.sync.client import connect

import canprobe
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.lab.bridge.messages import TOPICS
from canprobe.lab.bridge.process import END_TIMEOUT_S

PROTOCOL = "foxglove.sdk.v1"


def plan_with(scene, section):
    return canprobe.plan(parse_scene(dump_scene(scene) + f"\n[bridge]\n{section}\n"))


@pytest.fixture
def bridge(recorded, bridge_of):
    """A server that is given every sample, and its address."""
    text = dump_scene(recorded.result.plan.scene).replace("foxglove_port = 8765", "foxglove_port = 0")
    one = bridge_of("foxglove", canprobe.plan(parse_scene(text)))
    return one, re.match(r"ws://127\.0\.0\.1:\d+", one.await_ready())[0]


def advertised(client):
    """Server info and channels, as they come on connecting."""
    info = json.loads(client.recv(timeout=patience_s(10)))
    channels = {}
    while len(channels) < len(TOPICS):
        document = json.loads(client.recv(timeout=patience_s(10)))
        if document["op"] == "advertise":
            channels |= {c["topic"]: c for c in document["channels"]}
    return info, channels


def messages(client, feed, wanted):
    """Feed the run until every subscription in `wanted` has had a message: {subscription: (time, payload)}."""
    got = {}
    for part in feed:
        part()
        with contextlib.suppress(TimeoutError):
            while data := client.recv(timeout=0.0):
                if isinstance(data, bytes) and data[0] == 1:
                    subscription, t_ns = struct.unpack_from("<IQ", data, 1)
                    got.setdefault(subscription, (t_ns, data[13:]))
        if wanted <= got.keys():
            break
    return got


def fed(recorded, bridge):
    """The run, again and again, in parts that a bridge is given when they are called."""
    for _ in range(50):
        for first in range(0, len(recorded.observations), 8):
            yield lambda: [bridge.observe(o) for o in recorded.observations[first : first + 8]]  # noqa: B023


def decode(channel, payload):
    schema = Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode())
    return DecoderFactory().decoder_for("cdr", schema)(payload)


def test_a_plain_client_negotiates_lists_and_receives(recorded, bridge):
    one, address = bridge
    with connect(address, subprotocols=[PROTOCOL], max_queue=None) as client:  # it reads on, and so hears the close
        assert client.subprotocol == PROTOCOL
        info, channels = advertised(client)
        assert (info["op"], info["name"]) == ("serverInfo", "canprobe cylinder")
        assert {(c["topic"], c["schemaName"], c["encoding"], c["schemaEncoding"]) for c in channels.values()} == {
            (topic.name, topic.type_name, "cdr", "ros2msg") for topic in TOPICS
        }
        asked = {
            "/joint_states": 7,
            "/surface_patch": 8,
            "/tf_static": 9,
            "/taxels/image": 10,
            "/robot_description": 11,
        }
        subscriptions = [{"id": i, "channelId": channels[topic]["id"]} for topic, i in asked.items()]
        client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        got = messages(client, fed(recorded, one), set(asked.values()))
    assert got.keys() == set(asked.values())  # and nothing that was not subscribed
    _, payload = got[7]
    q = recorded.log("q_rad")
    position = decode(channels["/joint_states"], payload).position
    assert np.abs(q[np.isfinite(q).all(axis=1)] - position).max(axis=1).min() == 0.0  # a logged row, bit by bit
    assert [t.child_frame_id for t in decode(channels["/tf_static"], got[9][1]).transforms[:2]] == ["flange", "probe"]
    assert decode(channels["/robot_description"], got[11][1]).data.startswith('<robot name="cylinder">')
    status = one.end("{}")
    assert status["error"] is None


@pytest.mark.slow(reason="6 MB through a server")
def test_a_client_that_does_not_read_holds_up_no_end(recorded, bridge):
    """It subscribes to everything and takes nothing: neither the server's queue nor the connection's ever empties."""
    one, address = bridge
    with socket.socket() as narrow:
        narrow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        narrow.connect(("127.0.0.1", int(address.rpartition(":")[2])))
        client = connect(address, sock=narrow, subprotocols=[PROTOCOL], max_queue=1, ping_interval=None)
        _, channels = advertised(client)
        subscriptions = [{"id": i, "channelId": channel["id"]} for i, channel in enumerate(channels.values())]
        client.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        feed = fed(recorded, one)
        while not messages(client, itertools.islice(feed, 1), set()):
            pass  # and from here on nothing is read
        for part in itertools.islice(feed, 300):  # some 6 MB
            part()
        clock = MonotonicClock()
        started_ns = clock.now_ns()
        status = one.end("{}")
        assert clock.now_ns() - started_ns < 0.5e9 * END_TIMEOUT_S
        assert (status["error"], status["dropped"]) == (None, 0)


def test_a_client_without_the_protocol_is_refused(bridge):
    with pytest.raises(InvalidHandshake), connect(bridge[1], subprotocols=["something.else"]):
        pass


@pytest.mark.slow(reason="a second server")
def test_a_port_that_is_taken_is_named_with_the_way_out(bridge, bridge_of):
    port = bridge[1].rpartition(":")[2]
    plan = plan_with(canprobe.load_scene("free"), f"foxglove_port = {port}")
    second = bridge_of("foxglove", plan, virtual=False)
    with pytest.raises(UsageError, match=rf"bridge foxglove: 127\.0\.0\.1:{port}: .*bridge\.foxglove_port"):
        second.await_ready()


def test_the_layout_shows_topics_that_there_are():
    """Every panel stands in the layout once, and every topic and field that a panel names exists."""
    text = (resources.files("canprobe") / "lab" / "bridge" / "foxglove_layout.json").read_text(encoding="utf-8")
    layout = json.loads(text)
    placed = re.findall(r'"(?:first|second)": "([^"]+)"', text)
    assert sorted(placed) == sorted(layout["configById"])
    named = set(re.findall(r'"(/[a-z_/]+)', text))
    assert named and named <= {topic.name for topic in TOPICS}
