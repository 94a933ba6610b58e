"""A viewer for the study of bridges: it takes every topic and does nothing with it, until it is killed."""

from __future__ import annotations

import importlib
import json
import sys


def watch_foxglove(address: str) -> None:
    """Subscribe to every channel of a Foxglove server."""
    client = importlib.import_module("websockets.sync.client").connect(
        address, subprotocols=["foxglove.sdk.v1"], max_size=None
    )
    print("there", flush=True)
    for message in client:
        if isinstance(message, str) and (document := json.loads(message)).get("op") == "advertise":
            wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in document["channels"]]
            client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def watch_ros2(domain: str) -> None:
    """Read every topic of a ROS 2 domain on this machine."""
    dds = importlib.import_module("canprobe.lab.bridge.ros2_dds")
    node = dds.Ros2Node(int(domain), True, dds.Encoder())
    readers = [node.reader(topic) for topic in dds.TOPICS]
    print("there", flush=True)
    waiting = importlib.import_module("cyclonedds.core")
    waitset = waiting.WaitSet(node.participant)
    conditions = [waiting.ReadCondition(reader, waiting.ViewState.Any | waiting.SampleState.Any) for reader in readers]
    for condition in conditions:
        waitset.attach(condition)
    while True:
        waitset.wait(100_000_000)
        for reader in readers:
            reader.take(N=1000)


if __name__ == "__main__":
    {"foxglove": watch_foxglove, "ros2": watch_ros2}[sys.argv[1]](sys.argv[2])
