"""Settings of a SocketCAN interface, as `ip -details -statistics -json link show` shows them, and the lines to type
that set it.

Drivers and versions of iproute2 leave fields out, and write numbers as texts. A missing field is None.

Sample points: CiA 301 recommends 87.5 % of the bit (85 to 90 %). Above 500 kbit/s, where 75 to 80 % is usual, 80 %.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from typing import Any, TypeVar

from canprobe.fieldbus.bus.system import system

T = TypeVar("T", dict[str, Any], list[Any], str)
VIRTUAL_KINDS = ("vcan", "vxcan")
MAX_SLOW_BITRATE = 500_000
RESTART_MS, TX_QUEUE_FRAMES = 100, 1000
FD_MTU_BYTES = 72
_TIMEOUT_S = 5.0
_SYSTEM_FOLDERS = ("/usr/sbin", "/sbin")
"""Folders of `tc` on Debian that are not in the PATH of a user."""


@dataclass(frozen=True, slots=True)
class LinkState:
    """State of one interface.

    Attributes:
        name: name of the interface, such as `can0`.
        kind: `can` for hardware, `vcan` or `vxcan`; None where the driver does not report it.
        is_up: whether it exists and is switched on.
        tx_queue: number of frames that the kernel queues (txqueuelen).
        bitrate, data_bitrate: bit rates, bit/s; the second one is that of CAN FD.
        sample_point: share of the bit, 0 to 1.
        restart_ms: time after which the controller leaves bus off by itself; 0: never.
        state: state of the controller, such as `ERROR-ACTIVE`.
        tx_errors, rx_errors: the controller's error counters.
        modes: modes of the controller, such as `LISTEN-ONLY`, `FD`.
        bus_offs: number of times that it went bus off since the interface was made.
    """

    name: str
    kind: str | None = None
    is_up: bool = True
    tx_queue: int | None = None
    bitrate: int | None = None
    data_bitrate: int | None = None
    sample_point: float | None = None
    restart_ms: int | None = None
    state: str | None = None
    tx_errors: int | None = None
    rx_errors: int | None = None
    modes: tuple[str, ...] = ()
    bus_offs: int | None = None


def parse_link(text: str) -> LinkState:
    """Read the JSON of one link.

    Raises:
        ValueError: the text is not the JSON of one link.
    """
    links = json.loads(text)
    found = [link for link in links if isinstance(link, dict) and link.get("ifname")] if isinstance(links, list) else []
    if len(found) != 1:
        raise ValueError(f"expected the JSON of one link, got {len(found)}")
    link = found[0]
    info: dict[str, Any] = _of_form(link, "linkinfo", {})
    data, counted = (_of_form(info, key, {}) for key in ("info_data", "info_xstats"))
    nominal, fast, errors = (_of_form(data, key, {}) for key in ("bittiming", "data_bittiming", "berr_counter"))
    return LinkState(
        name=str(link["ifname"]),
        kind=_of_form(info, "info_kind", "") or None,
        is_up="UP" in _of_form(link, "flags", []),
        tx_queue=_whole(link, "txqlen"),
        bitrate=_whole(nominal, "bitrate") or _whole(data, "bittiming_bitrate") or None,
        data_bitrate=_whole(fast, "bitrate") or None,
        sample_point=_number(nominal, "sample_point") or None,
        restart_ms=_whole(data, "restart_ms"),
        state=_of_form(data, "state", "") or None,
        tx_errors=_whole(errors, "tx"),
        rx_errors=_whole(errors, "rx"),
        modes=tuple(str(mode) for mode in _of_form(data, "ctrlmode", [])),
        bus_offs=_whole(counted, "bus_off"),
    )


def read_link(name: str) -> LinkState | None:
    """Read the state of an interface by `ip`; None where there is no `ip`, or its output cannot be read."""
    command = ["ip", "-details", "-statistics", "-json", "link", "show", "dev", name]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if "does not exist" in done.stderr:
        return LinkState(name, is_up=False)
    try:
        return parse_link(done.stdout)
    except ValueError:
        return None


def sample_points(bitrate: int) -> tuple[float, float, float]:
    """The lowest, the recommended and the highest sample point at a bit rate, as shares of the bit."""
    return (0.85, 0.875, 0.90) if bitrate <= MAX_SLOW_BITRATE else (0.75, 0.80, 0.90)


def setting_line(name: str, bitrate: int, data_bitrate: int | None = None) -> str:
    """The line to type that sets an interface as a cell needs it and brings it up.

    Args:
        name: name of the interface; a virtual one, `vcan0` or `vxcan0`, has no bit rate.
        bitrate: bit rate, bit/s.
        data_bitrate: data bit rate of CAN FD, bit/s; None: classical frames only.
    """
    if name.startswith(VIRTUAL_KINDS):
        fd = (f"{name} down", f"{name} mtu {FD_MTU_BYTES} up")
        return ip_line(f"{name} up") if data_bitrate is None else ip_line(*fd)
    _, sample, _ = sample_points(bitrate)
    fast = "" if data_bitrate is None else f" dbitrate {data_bitrate} fd on"
    return ip_line(
        f"{name} down",
        f"{name} type can bitrate {bitrate} sample-point {sample:g}{fast} restart-ms {RESTART_MS}",
        f"{name} txqueuelen {TX_QUEUE_FRAMES} up",
    )


def emptying_line(name: str) -> str:
    """The line to type that drops the frames which wait in an interface, and restarts its controller."""
    return ip_line(f"{name} down", f"{name} up")


def drop_queued(name: str) -> bool:
    """Drop the frames in an interface's transmit queue; return False where the right to do so, or `tc`, is missing.

    A queue that is replaced drops its frames; then the default one comes back. The link stays up, and the controller
    keeps the frame that it holds.
    """
    program = shutil.which("tc", path=os.pathsep.join([os.environ.get("PATH", ""), *_SYSTEM_FOLDERS]))
    if program is None:
        return False
    queue = ["dev", name, "root"]
    steps = (["replace", *queue, "handle", "1:", "pfifo"], ["del", *queue])
    return not any(
        subprocess.run([program, "qdisc", *step], capture_output=True, check=False).returncode for step in steps
    )


def ip_line(*settings: str) -> str:
    """The line to type that makes settings of links one after the other, with `sudo` where it is needed."""
    return " && ".join(f"{sudo()}ip link set {setting}" for setting in settings)


def missing_ip() -> str | None:
    """Message that there is no `ip`, with the line to type; None where there is one."""
    if shutil.which("ip") is not None:
        return None
    return f"`ip` is not installed; type:  {sudo()}apt-get install -y iproute2"


def sudo() -> str:
    """Beginning of a line to type: `sudo` for users who are not root."""
    return "" if system.is_root() else "sudo "


def _of_form(parent: dict[str, Any], key: str, empty: T) -> T:
    """A value that has the type of an empty one; that one where it is missing or of another type."""
    value = parent.get(key)
    return value if isinstance(value, type(empty)) else empty


def _number(parent: dict[str, Any], key: str) -> float | None:
    try:
        return float(parent[key])
    except (KeyError, TypeError, ValueError):
        return None


def _whole(parent: dict[str, Any], key: str) -> int | None:
    number = _number(parent, key)
    return None if number is None else round(number)
