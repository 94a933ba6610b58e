"""The Foxglove server, spoken to by a plain WebSocket client that knows only the published protocol.

Source: Foxglove WebSocket protocol, `foxglove.sdk.v1`: JSON text for control, binary with opcode 1 for message data.
"""

from __future__ import annotations

import contextlib
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
from canprobe.lab.bridge.messages import TOPICS

PROTOCOL = "foxglove.sdk.v1"


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
    for _ in feed:
        with contextlib.suppress(TimeoutError):
            while data := client.recv(timeout=0.0):
                if isinstance(data, bytes) and data[0] == 1:
                    subscription, t_ns = struct.unpack_from("<IQ", data, 1)
                    got.setdefault(subscription, (t_ns, data[13:]))
        if wanted <= got.keys():
            break
    return got


def fed(recorded, bridge):
    """The run, again and again, in parts that the bridge is given one after the other."""
    for _ in range(50):
        for first in range(0, len(recorded.observations), 8):
            for observation in recorded.observations[first : first + 8]:
                bridge.observe(observation)
            yield


def decode(channel, payload):
    schema = Schema(id=1, name=channel["schemaName"], encoding="ros2msg", data=channel["schema"].encode())
    return DecoderFactory().decoder_for("cdr", schema)(payload)


def test_a_plain_client_negotiates_lists_and_receives(recorded, bridge):
    one, address = bridge
    with pytest.raises(InvalidHandshake), connect(address, subprotocols=["something.else"]):
        pass
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


def test_a_port_that_is_taken_is_named_with_the_way_out(bridge_of):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        second = bridge_of("foxglove", canprobe.plan("free", {"bridge.foxglove_port": port}), virtual=False)
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
