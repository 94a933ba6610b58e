"""An external arm whose program listens at a socket: JSON lines, docs/external-arm.md.

The program says first `{"canprobe_arm": 1, "stop_after_ms": 100}`, then `{"t_ns": …, "T": [16 numbers]}` in each of its
periods. It gets `{"T": [16 numbers]}` in each cycle, and `{"stop": true}`. T is T_base_flange in rows, m.
"""

from __future__ import annotations

import json
import socket
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from canprobe.cell.scene.setup import External
from canprobe.errors import ArmError
from canprobe.mechanics.types import Floats

Taken = TypeVar("Taken")
VERSION = 1
GREETING = f'{{"canprobe_arm": {VERSION}, "stop_after_ms": …}}'
CONNECT_S = 2.0
"""Longest time to the connection, to the greeting and to the first pose, each, s."""
SEND_S = 0.05
"""Longest time for which a program may leave what it is sent unread, s."""
MAX_BYTES = 1 << 16
"""Longest line."""
MAX_READS = 16
"""Most reads in a cycle: a program that sends without an end does not hold the cycle up."""


class SocketArm:
    """An external arm at an address; see `ExternalArm`.

    Args:
        external: the arm as its cell file describes it.

    Raises:
        ArmError: nothing listens there, or it is no program of an arm; or the arm goes on for longer than stated.
    """

    def __init__(self, external: External) -> None:
        assert external.address is not None
        host, _, port = external.address.rpartition(":")
        self._address, self._rest = external.address, b""
        try:
            self._socket = socket.create_connection((host, int(port)), CONNECT_S)
        except (OSError, OverflowError) as error:
            raise ArmError(f"{self._address}: {error}; start the program of the arm, or see arm.address") from error
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            hello, *poses = self._lines(CONNECT_S)
            self._greet(hello, external)
            self._pose = self._pose_of((poses or self._lines(CONNECT_S))[-1])
        except BaseException:
            self._socket.close()
            raise

    def close(self) -> None:
        """Close the connection, at which the program stops the arm."""
        self._socket.close()

    def read(self) -> tuple[Floats, int]:
        if lines := self._lines(0.0):
            self._pose = self._pose_of(lines[-1])
        return self._pose

    def command(self, T_base_flange: Floats) -> None:
        self._send({"T": T_base_flange.ravel().tolist()})

    def stop(self) -> None:
        self._send({"stop": True})

    def _greet(self, line: bytes, external: External) -> None:
        stated_ms = 1e3 * external.stop_after_s
        form = f"{GREETING}, of at most arm.stop_after_ms = {stated_ms:g}"
        version, stops_ms = self._parsed(line, form, lambda m: (m["canprobe_arm"], float(m["stop_after_ms"])))
        if version != VERSION or not 0.0 < stops_ms <= stated_ms:
            raise ArmError(f"{self._address}: expected {form}, got {line[:80]!r}")

    def _lines(self, wait_s: float) -> list[bytes]:
        """The whole lines that are in; with a time to wait, at least one."""
        lines: list[bytes] = []
        self._socket.settimeout(wait_s)
        try:
            for _ in range(MAX_READS):
                data = self._socket.recv(MAX_BYTES)
                *more, self._rest = (self._rest + data).split(b"\n")
                lines += more
                if not data or len(self._rest) > MAX_BYTES:
                    raise ArmError(f"{self._address}: " + ("sends no lines" if data else "closed the connection"))
                if lines:
                    self._socket.settimeout(0.0)
        except (BlockingIOError, TimeoutError):
            if wait_s and not lines:
                raise ArmError(f"{self._address}: expected a line within {wait_s:g} s, got none") from None
        except OSError as error:
            raise ArmError(f"{self._address}: {error}") from error
        return lines

    def _pose_of(self, line: bytes) -> tuple[Floats, int]:
        def pose(message: Any) -> tuple[Floats, int]:
            return np.array(message["T"], dtype=np.float64).reshape(4, 4), int(message["t_ns"])

        return self._parsed(line, '{"t_ns": …, "T": [16 numbers]}', pose)

    def _parsed(self, line: bytes, form: str, take: Callable[[Any], Taken]) -> Taken:
        try:
            return take(json.loads(line))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ArmError(f"{self._address}: expected {form}, got {line[:80]!r}") from error

    def _send(self, message: dict[str, Any]) -> None:
        """Send a line whole: a part of one would end in the next."""
        self._socket.settimeout(SEND_S)
        try:
            self._socket.sendall(json.dumps(message).encode() + b"\n")
        except OSError as error:
            self._socket.close()
            raise ArmError(f"{self._address}: {error}") from error
