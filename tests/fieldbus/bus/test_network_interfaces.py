"""A bus over the network, through what python-can has: udp_multicast and socketcand, on this machine only."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import uuid

import pytest

from canprobe.cli import main
from canprobe.errors import InterfaceError, UsageError
from canprobe.fieldbus.bus.port import MonotonicClock
from canprobe.fieldbus.bus.real.python_can import Echoes, configured_bus, open_port

SECOND = 1_000_000_000


@pytest.fixture
def group(monkeypatch, tmp_path):
    """An IPv6 group that never leaves this machine, with a port of its own, as python-can's configuration has it."""
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as free:
        free.bind(("::1", 0))
        port = free.getsockname()[1]
    name = f"ff11::{uuid.uuid4().hex[:4]}"
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("CAN_INTERFACE", "udp_multicast")
    monkeypatch.setenv("CAN_CHANNEL", name)
    monkeypatch.setenv("CAN_CONFIG", json.dumps({"port": port, "hop_limit": 0}))
    return name


def frames_of(port, count, clock):
    found, until = [], clock.now_ns() + 10 * SECOND
    while len(found) < count and clock.now_ns() < until:
        port.wait(until)
        found += port.drain()
    return [frame[:2] for frame in found]


def test_multicast_ports_hear_each_other_and_never_themselves(group):
    clock = MonotonicClock()
    one, two = (open_port("udp_multicast", group, 1_000_000, clock) for _ in range(2))
    try:
        sent = [(0x181, b"\x01\x02"), (0x80, b"\x01"), (0x80, b"\x02")]
        one.send_batch(sent)
        assert frames_of(two, 3, clock) == sent
        two.send_batch([(0x80, b"\x01")])  # equal to one of the first port's: another master's SYNC is heard
        assert frames_of(one, 1, clock) == [(0x80, b"\x01")]
        assert two.drain() == []
    finally:
        one.close()
        two.close()


def test_an_echo_is_taken_once_and_not_for_ever():
    echoes = Echoes()
    echoes.sent((1, b"a"), 0)
    assert [echoes.is_one((1, b"a"), 5), echoes.is_one((1, b"a"), 6)] == [True, False]
    echoes.sent((1, b"a"), 0)
    assert not echoes.is_one((1, b"b"), 1)
    assert not echoes.is_one((1, b"a"), 2 * SECOND)


def test_nodes_of_a_bus_yml_are_scanned_over_multicast(group, tmp_path, capsys):
    """Emulator and scan both find their bus in python-can's environment."""
    assert main(["plan", "listen", "--export", "bus.yml", "--out", str(tmp_path)]) == 0
    emulator = subprocess.Popen(
        [sys.executable, "-m", "canprobe", "emulate", "--bus-yml", str(tmp_path / "bus.yml")],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert emulator.stderr is not None and f"serving nodes 16 on {group}" in emulator.stderr.readline()
        capsys.readouterr()
        assert main(["scan", "--json"]) == 0
        (node,) = json.loads(capsys.readouterr().out)
        assert (node["node_id"], node["vendor_id"], node["product_code"]) == (16, 0xCA5E, 0x1616)
    finally:
        emulator.send_signal(signal.SIGINT)
        assert emulator.wait(20) == 0
        emulator.stderr.close()


class Socketcand(threading.Thread):
    """As much of a socketcand server as one client needs: greets, opens, then answers each frame by one of id + 1."""

    def __init__(self):
        super().__init__(daemon=True)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.port = self.listener.getsockname()[1]
        self.said = []

    def run(self):
        connection, _ = self.listener.accept()
        with connection:
            connection.sendall(b"< hi >")
            text = b""
            while data := connection.recv(4096):
                text += data
                while match := re.search(rb"<([^>]*)>", text):
                    text = text[match.end() :]
                    self.answer(connection, match[1].decode().split())

    def answer(self, connection, words):
        self.said.append(words)
        if words[0] == "send":
            data = "".join(word.zfill(2) for word in words[3:])
            connection.sendall(f"< frame {int(words[1], 16) + 1:x} 12.5 {data} >".encode())
        else:
            connection.sendall(b"< ok >")


def test_socketcand_with_its_host_from_python_cans_file(monkeypatch, tmp_path):
    server = Socketcand()
    server.start()
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "can.conf").write_text(
        f"[default]\ninterface = socketcand\nchannel = can0\nhost = 127.0.0.1\nport = {server.port}\n"
    )
    found = configured_bus()
    assert (found.interface, found.channel, found.bitrate) == ("socketcand", "can0", None)
    clock = MonotonicClock()
    port = open_port(found.interface, found.channel, 1_000_000, clock)
    try:
        port.send_batch([(0x600, b"\x40\x00\x10")])
        assert frames_of(port, 1, clock) == [(0x601, b"\x40\x00\x10")]
    finally:
        port.close()
        server.listener.close()
        server.join(10)
    assert ["open", "can0"] in server.said


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """An environment in which nothing is configured."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)


def test_without_a_configuration_there_is_none(bare, capsys):
    assert configured_bus() is None
    assert main(["run", "free", "--bus", "config", "--duration", "0.01"]) == 2
    assert "names no interface; set CAN_INTERFACE" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "value", "complaint"),
    [
        ("CAN_INTERFACE", "socketcam", "python-can has: .*socketcan"),
        ("CAN_CONFIG", "{", "CAN_CONFIG is no JSON"),
        ("CAN_CONFIG", '{"interface": "virtual", "port": "x"}', "Port config"),
    ],
)
def test_a_wrong_configuration_is_said(bare, monkeypatch, name, value, complaint):
    monkeypatch.setenv(name, value)
    with pytest.raises(UsageError, match=complaint):
        configured_bus()


def test_the_command_line_and_the_scene_come_before_the_configuration(bare, monkeypatch):
    """A scene whose nodes are all emulated stays in lockstep; one with real nodes takes what is configured."""
    from argparse import Namespace
    from dataclasses import replace

    from canprobe.cell.scene.load import load_scene
    from canprobe.cell.session.target import Target
    from canprobe.cli.parser import target_of

    monkeypatch.setenv("CAN_INTERFACE", "pcan")
    monkeypatch.setenv("CAN_CHANNEL", "PCAN_USBBUS1")
    monkeypatch.setenv("CAN_BITRATE", "500000")
    silent = Namespace(bus=None, channel=None, bitrate=None)
    scene = load_scene("free")
    real = replace(scene, arm=replace(scene.arm, emulated=False))
    named = replace(real, bus=replace(real.bus, interface="kvaser"))
    configured = Target("pcan", "PCAN_USBBUS1", 500_000)
    assert target_of(silent, scene) == Target("lockstep", "can0", 1_000_000)
    assert target_of(silent, real) == configured
    assert target_of(silent, named) == Target("kvaser", "can0", 1_000_000)
    assert target_of(Namespace(bus="config", channel=None, bitrate=None), scene) == configured
    assert target_of(Namespace(bus="config", channel=[(None, "X")], bitrate=250_000), scene) == Target(
        "pcan", "X", 250_000
    )
    assert target_of(Namespace(bus="slcan", channel=None, bitrate=None), real) == Target("slcan", "can0", 1_000_000)


def test_channels_of_a_scene_with_two_buses(bare):
    from argparse import Namespace
    from dataclasses import replace

    from canprobe.cell.scene.load import load_scene
    from canprobe.cell.session.target import Target
    from canprobe.cli.parser import target_of

    scene = load_scene("press")
    scene = replace(scene, sensor=replace(scene.sensor, channel="can1"))

    def target(*channels):
        return target_of(Namespace(bus="socketcan", channel=list(channels), bitrate=None), scene)

    assert target() == Target("socketcan", "can0", 1_000_000)
    assert target((None, "vcan0")) == Target("socketcan", "vcan0", 1_000_000)
    both = target(("can0", "a"), ("can1", "b"))
    assert both == Target("socketcan", "a", 1_000_000, {"can1": "b"})
    joint = replace(next(iter(scene.joints.values())), channel="can1")
    placed = both.applied_to(replace(scene, joints={**scene.joints, "shoulder": joint}))
    assert (placed.channels, placed.joints["shoulder"].channel) == (("a", "b"), "b")
    with pytest.raises(UsageError, match="no channel can2, only can0, can1; did you mean can1"):
        target(("can2", "x"))
    with pytest.raises(UsageError, match="given 2 times, but the scene has the channels can0 and can1"):
        target(("can0", "x"), (None, "y"))


class Speaking(Socketcand):
    """Puts one frame on its bus when a client has opened it, and answers none."""

    def __init__(self, frame=""):
        super().__init__()
        self.frame = frame
        self.heard = threading.Event()

    def answer(self, connection, words):
        self.said.append(words)
        if words[0] == "send":
            self.heard.set()
            return
        connection.sendall(b"< ok >")
        if words[0] == "rawmode" and self.frame:
            connection.sendall(f"< frame {self.frame} >".encode())


def test_can_bridge_joins_two_buses_over_the_network(tmp_path):
    """python-can's own program, as the README has it; what it cannot do is join multicast, which hears itself."""
    near, far = Speaking("701 12.5 05"), Speaking()
    for server in (near, far):
        server.start()
    words = [sys.executable, "-m", "can.bridge"]
    for number, server in ((1, near), (2, far)):
        words += [f"--bus{number}-interface", "socketcand", f"--bus{number}-channel", "can0"]
        words += [f"--bus{number}-bus-kwargs", "host=127.0.0.1", f"port={server.port}"]
    with (tmp_path / "said").open("w+") as said:
        bridge = subprocess.Popen(words, stdout=said, stderr=said)
        try:
            assert far.heard.wait(20), (tmp_path / "said").read_text()
        finally:
            bridge.send_signal(signal.SIGINT)
            bridge.wait(20)
            for server in (near, far):
                server.listener.close()
                server.join(10)
    assert [words for words in far.said if words[0] == "send"] == [["send", "701", "1", "5"]]
    assert not near.heard.is_set()


def test_a_driver_whose_library_is_missing_is_an_interface_error(monkeypatch):
    def trip(**_):
        raise NameError("name 'canGetNumberOfChannels' is not defined")  # as kvaser does without canlib

    monkeypatch.setattr("can.Bus", trip)
    with pytest.raises(InterfaceError, match=r"0: kvaser cannot be opened; is its driver installed.*NameError"):
        open_port("kvaser", "0", 1_000_000, MonotonicClock())
