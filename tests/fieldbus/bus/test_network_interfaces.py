"""A bus over the network, through what python-can has: udp_multicast and socketcand, on this machine only."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import threading

import pytest
from network_buses import bare, group  # noqa: F401
from patience import patience_s

from canprobe.errors import InterfaceError, UsageError
from canprobe.fieldbus import MonotonicClock, open_port
from canprobe.fieldbus.bus.real.adapters import configured_bus
from canprobe.fieldbus.bus.real.python_can import Echoes

SECOND = 1_000_000_000


def frames_of(port, count, clock):
    found, until = [], clock.now_ns() + 10 * SECOND
    while len(found) < count and clock.now_ns() < until:
        port.wait(until)
        found += port.drain()
    return [frame[:2] for frame in found]


@pytest.mark.realtime
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


@pytest.mark.realtime
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


def test_without_a_configuration_there_is_none(bare):
    assert configured_bus() is None


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
            assert far.heard.wait(patience_s(20)), (tmp_path / "said").read_text()
        finally:
            bridge.send_signal(signal.SIGINT)
            bridge.wait(patience_s(20))
            for server in (near, far):
                server.listener.close()
                server.join(10)
    assert [words for words in far.said if words[0] == "send"] == [["send", "701", "1", "5"]]
    assert not near.heard.is_set()


def test_a_driver_whose_library_is_missing_is_an_interface_error(monkeypatch):
    def trip(**_):
        raise NameError("name 'canGetNumberOfChannels' is not defined")  # as kvaser does without canlib

    monkeypatch.setattr("can.Bus", trip)
    with pytest.raises(InterfaceError, match=r"0: kvaser cannot be opened: CANlib of kvaser.com is not installed"):
        open_port("kvaser", "0", 1_000_000, MonotonicClock())
