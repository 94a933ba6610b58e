"""The local channel by which `canprobe inject` throws faults at nodes that another process serves.

A process that serves nodes listens on a Unix socket in a folder of its user, one for each channel of CAN. A request is
one JSON message, the answer another. The server never waits: it looks at the socket once in each pass of
its loop, so that a request costs the nodes less than their work for one frame. Only the user who serves the nodes, and
root, may throw faults: the folder is closed to others (0700), and the server asks the kernel who is on the line.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import stat
import struct
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from canprobe.errors import CanprobeError, InterfaceError, UsageError
from canprobe.fieldbus.tools.faults.injection import FaultyNodes

_MAX_BYTES = 1 << 16
_PATIENCE_S = 5.0
"""Time that a request waits for the answer; a server that stands still for longer is not there."""
_CREDENTIALS = struct.Struct("3i")


def control_folder() -> Path:
    """Folder of the sockets, which belongs to this user alone.

    Raises:
        UsageError: the folder is open to others or belongs to somebody else.
    """
    base = os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()
    folder = Path(base) / f"canprobe-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise UsageError(f"{folder}: expected a folder of this user with mode 700; remove it and start again")
    return folder


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):  # another process has its socket there
        folder.rmdir()


def _name(channel: str) -> str:
    """Beginning of the names of the sockets of a channel; the number of the process follows."""
    return f"inject-{re.sub(r'[^A-Za-z0-9._-]', '_', channel)}-"


class ControlServer:
    """Takes faults for the nodes of this process. A context manager.

    Args:
        channel: channel of CAN on which the nodes are.
        nodes: the nodes.

    Raises:
        UsageError: the folder of the socket belongs to somebody else.
    """

    def __init__(self, channel: str, nodes: FaultyNodes) -> None:
        self._nodes, self._path = nodes, control_folder() / f"{_name(channel)}{os.getpid()}.sock"
        self._lines: list[socket.socket] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self._path.unlink(missing_ok=True)  # of a process that was killed
        self._socket.bind(str(self._path))
        self._path.chmod(0o600)
        self._socket.listen(4)

    def __enter__(self) -> ControlServer:
        return self

    def __exit__(self, *_: object) -> None:
        for line in [self._socket, *self._lines]:
            line.close()
        self._path.unlink(missing_ok=True)
        _remove_empty(self._path.parent)

    def poll(self, now_ns: int) -> None:
        """Answer what has come; never waits.

        Args:
            now_ns: present time on the clock of the bus, from which the times of faults count.
        """
        try:
            line, _ = self._socket.accept()
        except BlockingIOError:
            if not self._lines:
                return
        else:
            line.setblocking(False)
            self._lines.append(line)
        for line in self._lines[:]:
            with contextlib.suppress(BlockingIOError):
                with contextlib.suppress(ConnectionError):
                    if message := line.recv(_MAX_BYTES):
                        line.send(json.dumps(self._answer(line, message, now_ns)).encode())
                self._lines.remove(line)
                line.close()

    def _answer(self, line: socket.socket, message: bytes, now_ns: int) -> dict[str, Any]:
        credentials = line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        if _CREDENTIALS.unpack(credentials)[1] not in (os.getuid(), 0):
            return {"error": "only the user who serves the nodes may throw faults"}
        try:
            request = json.loads(message)
            texts, clear = request["faults"], request["clear"]
            ended = [fault.words(now_ns) for fault in self._nodes.clear()] if clear else []
            thrown = [self._nodes.inject(text, now_ns).words(now_ns) for text in texts]
            nodes = [node.node_id for node in self._nodes.nodes]
        except CanprobeError as error:
            return {"error": str(error)}
        except (ValueError, KeyError, TypeError, AttributeError):
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
    nodes_of: dict[Path, list[int]] = {}
    done: dict[str, list[str]] = {"thrown": [], "ended": []}
    for path in sorted(control_folder().glob(f"{_name(channel)}*.sock")):
        if (answer := _ask(path, [], clear)) is not None:
            nodes_of[path] = answer["nodes"]
            done["ended"] += answer["ended"]
    if not nodes_of:
        _remove_empty(control_folder())
        raise InterfaceError(
            f"{channel}: no process of this user serves nodes there; type: canprobe emulate SCENE --channel {channel}"
        )
    for text in faults:
        match = re.match(r"\s*node\s+(\d+)", text)
        node_id = int(match[1]) if match else 0
        path = next((path for path, nodes in nodes_of.items() if node_id in nodes), next(iter(nodes_of)))
        answer = _ask(path, [text], clear=False)
        done["thrown"] += answer["thrown"] if answer is not None else []
    return done


def _ask(path: Path, faults: Sequence[str], clear: bool) -> dict[str, Any] | None:
    """The answer of one process; None where it has ended without removing its socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as line:
        line.settimeout(_PATIENCE_S)
        try:
            line.connect(str(path))
            line.send(json.dumps({"faults": faults, "clear": clear}).encode())
            answer: dict[str, Any] = json.loads(line.recv(_MAX_BYTES) or b"{}")
        except (FileNotFoundError, ConnectionError):
            return None
        except TimeoutError as error:
            raise InterfaceError(f"{path.name}: the process that serves the nodes does not answer") from error
    if "error" in answer:
        raise UsageError(answer["error"])
    return answer or None
