"""A CAN controller without hardware: the kernel's slcan driver on a pseudo terminal, whose other end the test holds.

It has what a vcan has not: a bit rate, a transmit queue that fills while nobody acknowledges, states and error frames.

Source: Linux drivers/net/can/slcan/slcan-core.c; Documentation/networking/can.rst (error message frames).
"""

from __future__ import annotations

import errno
import fcntl
import os
import pty
import select
import struct
import subprocess
import threading
import tty

_TIOCSETD, _N_SLCAN, _SIOCGIFNAME = 0x5423, 17, 0x8910
_LOOK_S = 0.01


class SerialAdapter:
    """One adapter with its interface; a context manager.

    Args:
        bitrate: that it is set to, bit/s.
        queue: its txqueuelen.

    Attributes:
        name: of the interface.
        frames: identifiers of the frames that the bus has taken.

    Raises:
        OSError: this kernel has no slcan, or the rights are missing.
    """

    def __init__(self, bitrate: int = 1_000_000, queue: int = 1000) -> None:
        self.frames: list[int] = []
        self._acknowledges, self._ends = threading.Event(), threading.Event()
        self._acknowledges.set()
        self._bus, self._terminal = pty.openpty()
        for end in (self._bus, self._terminal):
            tty.setraw(end)
        try:
            fcntl.ioctl(self._terminal, _TIOCSETD, struct.pack("i", _N_SLCAN))
            self.name = fcntl.ioctl(self._terminal, _SIOCGIFNAME, bytes(16)).rstrip(b"\0").decode()
        except OSError:
            self._close_ends()
            raise
        self._thread = threading.Thread(target=self._take_frames, daemon=True)
        self._thread.start()
        self.set("type", "can", "bitrate", str(bitrate))
        self.set("txqueuelen", str(queue), "up")

    def set(self, *words: str) -> None:
        """Type `ip link set NAME ...`."""
        done = subprocess.run(["ip", "link", "set", self.name, *words], capture_output=True, text=True, check=False)
        if done.returncode:
            raise OSError(errno.EPERM, done.stderr.strip())

    def acknowledge(self, does: bool) -> None:
        """Somebody on the bus acknowledges from now on, or nobody."""
        (self._acknowledges.set if does else self._acknowledges.clear)()

    def tell_state(self, state: str, transmit: int, receive: int) -> None:
        """The controller changes its state: one of `awpb` (active, warning, passive, bus-off), and its counters."""
        os.write(self._bus, f"s{state}{receive:03}{transmit:03}\r".encode())

    def _take_frames(self) -> None:
        rest = b""
        while not self._ends.is_set():
            if not self._acknowledges.wait(_LOOK_S) or not select.select([self._bus], [], [], _LOOK_S)[0]:
                continue
            *lines, rest = (rest + os.read(self._bus, 4096)).split(b"\r")
            self.frames += [int(line[1:4], 16) for line in lines if line[:1] == b"t"]

    def _close_ends(self) -> None:
        os.close(self._terminal)
        os.close(self._bus)

    def __enter__(self) -> SerialAdapter:
        return self

    def __exit__(self, *_: object) -> None:
        self.acknowledge(True)
        self.set("down")
        self._ends.set()
        self._thread.join()
        self._close_ends()
