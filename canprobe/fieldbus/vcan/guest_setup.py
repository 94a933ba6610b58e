"""Runs inside the guest as root, as a script: load the CAN modules, bring vcan0 and vcan1 up, with nothing but Python.

Neither kmod nor iproute2 has to be installed: modules go in by finit_module(2), links by rtnetlink(7).
"""

from __future__ import annotations

import ctypes
import os
import socket
import struct
import sys
from pathlib import Path

_MODULES = ("can", "can-raw", "can-bcm", "can-gw", "can-dev", "vcan", "vxcan", "slcan")
_FINIT_MODULE = {"x86_64": 313, "i686": 350, "i586": 350, "i486": 350, "i386": 350}
_NEW_LINK = 16
_NLM_REQUEST_ACK_CREATE = 0x1 | 0x4 | 0x400
_IFLA_IFNAME, _IFLA_LINKINFO, _IFLA_INFO_KIND = 3, 18, 1
_IFF_UP = 1


def load_modules(folder: Path) -> None:
    """Load the CAN modules of the running kernel, in an order in which each finds what it needs."""
    kernel = os.uname()
    libc = ctypes.CDLL(None, use_errno=True)
    for name in _MODULES:
        for path in (folder / kernel.release).rglob(f"{name}.ko"):
            with path.open("rb") as module:
                if libc.syscall(_FINIT_MODULE[kernel.machine], module.fileno(), b"", 0):
                    print(f"{path}: {os.strerror(ctypes.get_errno())}", file=sys.stderr)


def make_link(name: str, kind: str) -> None:
    """Create a link of this kind; OSError if the kernel refuses."""
    info = _attribute(_IFLA_LINKINFO, _attribute(_IFLA_INFO_KIND, kind.encode()))
    _request(_NEW_LINK, struct.pack("=BxHiII", 0, 0, 0, 0, 0) + _attribute(_IFLA_IFNAME, name.encode() + b"\0") + info)


def set_link(name: str, up: bool) -> None:
    """Bring a link up or down; OSError if the kernel refuses."""
    _request(_NEW_LINK, struct.pack("=BxHiII", 0, 0, socket.if_nametoindex(name), _IFF_UP if up else 0, _IFF_UP))


def _attribute(kind: int, payload: bytes) -> bytes:
    length = 4 + len(payload)
    return struct.pack("=HH", length, kind) + payload + bytes(-length % 4)


def _request(kind: int, payload: bytes) -> None:
    """Send one rtnetlink request and read the kernel's verdict."""
    header = struct.pack("=IHHII", 16 + len(payload), kind, _NLM_REQUEST_ACK_CREATE, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0) as netlink:
        netlink.send(header + payload)
        (negative_errno,) = struct.unpack_from("=i", netlink.recv(4096), 16)
    if negative_errno:
        raise OSError(-negative_errno, os.strerror(-negative_errno))


if __name__ == "__main__":
    load_modules(Path(sys.argv[1]))
    for channel in ("vcan0", "vcan1"):
        make_link(channel, "vcan")
        set_link(channel, up=True)
    set_link("lo", up=True)
