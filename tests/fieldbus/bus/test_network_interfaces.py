"""A bus over the network, through what python-can has: udp_multicast and socketcand, on this machine only."""

from __future__ import annotations

import re
import socket
import threading

import pytest
from network_buses import bare, group  # noqa: F401

from canprobe.errors import UsageError
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
