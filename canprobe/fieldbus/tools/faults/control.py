"""The local channel by which `canprobe inject` throws faults at nodes that another process serves.

A process that serves nodes listens on an abstract Unix socket (Linux, unix(7)), one for each channel of CAN: it has no
file, and ends with its process. A request is one JSON message, the answer another. The server never waits: it looks at
the socket once in each pass of its loop, so that a request costs the nodes less than their work for one frame. Only the
user who serves the nodes, and root, may throw faults: both ends ask the kernel who is on the line. Everybody on the
machine can connect, so a foreign connection is closed as soon as it is accepted, and the others are few and short.
"""

from __future__ import annotations

import json
import os
import re
import socket
import struct
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from canprobe.errors import CanprobeError, InterfaceError, UsageError
from canprobe.fieldbus.tools.faults.injection import FaultyNodes
from canprobe.fieldbus.tools.faults.text import node_of

_MAX_BYTES = 1 << 16
_MAX_LINES, _MAX_IDLE_NS = 8, 1_000_000_000
"""Largest number of open connections, and time for which one may be open without a request."""
_MAX_WAITING = 64
"""Largest number of connections that wait to be accepted: one look takes them all, so that a flood delays nobody."""
_PATIENCE_S = 5
"""Time that a request waits for the answer; a server that stands still for longer is not there."""
_CREDENTIALS = struct.Struct("3i")
_SOCKETS = Path("/proc/net/unix")
"""The kernel's list of Unix sockets; the last field of a line is the name, with @ for the 0 of an abstract one."""


def _name(channel: str) -> str:
    """Beginning of the names of the sockets of a channel; the number of the process follows."""
    return f"canprobe-inject-{re.sub(r'[^A-Za-z0-9._-]', '_', channel)}-"


def _names(channel: str) -> list[str]:
    """Names of the sockets of a channel."""
    if not _SOCKETS.exists():
        raise InterfaceError("faults reach another process by a socket of Linux only; here give them to it: --inject")
    listed = _SOCKETS.read_text(encoding="ascii", errors="replace")
    return sorted(set(re.findall(rf"\s@({re.escape(_name(channel))}[0-9]+)\s*$", listed, re.MULTILINE)))


def _user(line: socket.socket) -> int:
    """The user at the other end."""
    credentials = line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(credentials)[1])


class ControlServer(AbstractContextManager["ControlServer"]):
    """Takes faults for the nodes of this process. A context manager.

    Args:
        channel: channel of CAN on which the nodes are.
        nodes: the nodes.

    Raises:
        OSError: the system has no such sockets, or the name is taken.
    """

    def __init__(self, channel: str, nodes: FaultyNodes) -> None:
        self._nodes = nodes
        self._lines: dict[socket.socket, int] = {}
        if not _SOCKETS.exists():
            raise OSError("its sockets are Linux's; give faults with --inject")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._socket.bind(f"\0{_name(channel)}{os.getpid()}")
        self._socket.listen(_MAX_WAITING)

    def __exit__(self, *_: object) -> None:
        for line in [self._socket, *self._lines]:
            line.close()

    def poll(self, now_ns: int) -> None:
        """Answer what has come; never waits.

        Args:
            now_ns: present time on the clock of the bus, from which the times of faults count.
        """
        for _ in range(_MAX_WAITING):
            if len(self._lines) == _MAX_LINES:
                break
            try:
                line, _ = self._socket.accept()
            except OSError:  # nobody is there, or this process has no descriptor left: it may have one later
                break
            if _user(line) in (os.getuid(), 0):
                line.setblocking(False)
                self._lines[line] = now_ns
            else:
                line.close()
        for line, since_ns in [*self._lines.items()]:
            try:
                if message := line.recv(_MAX_BYTES):
                    line.send(json.dumps(self._answer(message, now_ns)).encode())
            except BlockingIOError:
                if now_ns - since_ns < _MAX_IDLE_NS:
                    continue
            except OSError:  # it has hung up, or takes no answer of that size
                pass
            del self._lines[line]
            line.close()

    def _answer(self, message: bytes, now_ns: int) -> dict[str, Any]:
        try:
            request = json.loads(message)
            texts, clear = request["faults"], request["clear"]
            ended = [fault.words(now_ns) for fault in self._nodes.clear()] if clear else []
            thrown = [self._nodes.inject(text, now_ns).words(now_ns) for text in texts]
            nodes = [node.node_id for node in self._nodes.nodes]
        except CanprobeError as error:
            return {"error": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            return {"error": "the request is none: canprobe has another version there"}
        return {"thrown": thrown, "ended": ended, "nodes": nodes}


def request_faults(channel: str, faults: Sequence[str], *, clear: bool = False) -> dict[str, list[str]]:
    """Throw faults at the nodes that processes of this user serve.

    Args:
        channel: channel of CAN on which they are.
        faults: faults, as `text.parse_fault` reads them; `at` counts from now.
        clear: whether the faults that hold there end first.

    Returns:
        `thrown` and `ended`: the faults in words, with times from now.

    Raises:
        InterfaceError: no process serves nodes on this channel, or one does not answer.
        UsageError: a fault is wrong; those before it are thrown.
    """
    nodes_of: dict[str, list[int]] = {}
    done: dict[str, list[str]] = {"thrown": [], "ended": []}
    for name in _names(channel):
        if (answer := _ask(name, [], clear)) is not None:
            nodes_of[name] = answer["nodes"]
            done["ended"] += answer["ended"]
    if not nodes_of:
        raise InterfaceError(
            f"{channel}: no process of this user serves nodes there; type: canprobe emulate SCENE --channel {channel}"
        )
    for text in faults:
        name = next((name for name, nodes in nodes_of.items() if node_of(text) in nodes), next(iter(nodes_of)))
        answer = _ask(name, [text], clear=False)
        done["thrown"] += answer["thrown"] if answer is not None else []
    return done


def _ask(name: str, faults: Sequence[str], clear: bool) -> dict[str, Any] | None:
    """The answer of one process; None where it has ended, or is that of another user."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        for limit in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):  # Python's own time-out waits for no place in a queue
            line.setsockopt(socket.SOL_SOCKET, limit, struct.pack("@ll", _PATIENCE_S, 0))
        try:
            line.connect(f"\0{name}")
            if os.getuid() and _user(line) != os.getuid():
                return None
            line.send(json.dumps({"faults": faults, "clear": clear}).encode())
            answer: dict[str, Any] = json.loads(line.recv(_MAX_BYTES) or b"{}")
        except ConnectionError:
            return None
        except BlockingIOError as error:
            raise InterfaceError(f"{name}: the process that serves the nodes does not answer") from error
    if "error" in answer:
        raise UsageError(answer["error"])
    return answer or None
