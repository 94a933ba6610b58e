"""Where python-can finds a bus: a multicast group that never leaves this machine, or nothing."""

import json
import os
import socket
import uuid

import pytest


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


@pytest.fixture
def bare(monkeypatch, tmp_path):
    """An environment in which nothing is configured."""
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in [name for name in os.environ if name.startswith("CAN_")]:
        monkeypatch.delenv(name)
