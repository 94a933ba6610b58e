"""CAN adapters and the interfaces of python-can that reach them: what each needs, how its channels are written, and
which are here.

`adapters.toml` is the one table of that. Errors of a port that cannot be opened take their lines to type from it, and
`canprobe adapters` prints it. Interfaces of python-can that are not in it work all the same; what they lack is what
python-can says.

On Linux most adapters (PEAK, Kvaser, candleLight, 8devices, Microchip) have a driver in the kernel, and are `socketcan`
interfaces then: the libraries of their makers are for other systems, or for functions that the kernel's driver lacks.
"""

from __future__ import annotations

import ctypes.util
import importlib
import importlib.util
import ipaddress
import json
import logging
import re
import sys
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from canprobe.errors import UsageError, did_you_mean, package_line
from canprobe.fieldbus.bus.real.link import missing_ip, read_link, setting_line, sudo
from canprobe.fieldbus.bus.real.socketcan import NO_SOCKETCAN, has_socketcan, how_to_make

SOCKETCAN = "socketcan"
_FD_CLOCK_HZ = 80_000_000
"""Clock of the controller of CAN FD adapters."""
_WHERE_SHOWN = "`canprobe adapters` shows what works here"
_ARPHRD_CAN = "280"
_NET_FOLDER, _DEVICE_FOLDER = Path("/sys/class/net"), Path("/dev")
_USB_SERIAL = ("ttyACM*", "ttyUSB*", "cu.usb*")  # the last one is that of macOS


@dataclass(frozen=True, slots=True)
class Backend:
    """One interface of python-can; `adapters.toml` says what its fields are."""

    hardware: str
    channel: str
    example: str
    package: str | None = None
    extra: str | None = None
    driver: str | None = None
    library: str | None = None
    windows_only: bool = False
    indexed: bool = False
    module: str | None = None
    has: str = ""
    bitrates_kbit: Sequence[float] = ()

    @property
    def missing(self) -> tuple[str, ...]:
        """What it lacks here, each with the line to type or the place to get it."""
        lacks = []
        if self.windows_only and sys.platform != "win32":
            lacks.append(f"{self.driver} is for Windows only")
        if self.package is not None and importlib.util.find_spec(self.package) is None:
            lacks.append(
                f"the package {self.package} is not installed; type: {package_line(f'python-can[{self.extra}]')}"
            )
        if self.library is not None and ctypes.util.find_library(self.library) is None:
            lacks.append(f"{self.driver} is not installed")
        if lacks and self.module is not None and sys.platform == "linux":
            lacks.append(f"the kernel's own driver {self.module} makes it an interface of --bus {SOCKETCAN}")
        return tuple(lacks)

    @property
    def features(self) -> frozenset[str]:
        """The words of `has`."""
        return frozenset(self.has.split())


def _read_backends() -> dict[str, Backend]:
    text = Path(__file__).with_name("adapters.toml").read_text(encoding="utf-8")
    found = {}
    for name, row in tomllib.loads(text.replace("{sudo}", sudo())).items():
        on_windows = row.pop("on_windows", {})
        found[name] = Backend(**row | on_windows if sys.platform == "win32" else row)
    return found


BACKENDS: Mapping[str, Backend] = _read_backends()
"""Interface of python-can → what reaches it, the usual ones first."""
LOCAL_GROUP = BACKENDS["udp_multicast"].example
"""A multicast group of interface-local scope, which no packet leaves or enters. Source: RFC 4291, 2.7."""


@dataclass(frozen=True, slots=True)
class Adapter:
    """One channel that was found here.

    Attributes:
        interface: interface of python-can.
        channel: its channel.
        state: its state, for people.
        is_up: whether it can be opened as it is.
        type_next: line to type next.
    """

    interface: str
    channel: str
    state: str
    is_up: bool
    type_next: str


def interface_names() -> list[str]:
    """The interfaces that python-can knows, those of other packages included."""
    import can  # here, as python-can is loaded only where a bus is opened

    return sorted(can.VALID_INTERFACES)


def check_interface_name(name: str, own: Iterable[str] = ()) -> None:
    """Return if python-can has an interface of this name.

    Args:
        name: name of the interface.
        own: buses of the caller that are none of python-can's.

    Raises:
        UsageError: it has none; the message has what was probably meant, and all names.
    """
    if name in BACKENDS or name in (own := tuple(own)):
        return
    if name in (known := interface_names()):
        return
    if re.fullmatch(r"(v|sl)?can\d+", name):
        raise UsageError(f"no interface {name!r}: a channel of socketcan; name both: --bus socketcan --channel {name}")
    mine = f"canprobe has {' and '.join(own)} (for `run`), and " if own else ""
    raise UsageError(
        f"no interface {name!r}{did_you_mean(name, [*own, *known], 0.6)}; {mine}python-can has: {', '.join(known)};"
        f" {_WHERE_SHOWN}"
    )


def bus_open_to_others(interface: str, channel: str) -> Iterator[str]:
    """A warning where other machines reach a bus.

    Args:
        interface: interface of python-can.
        channel: its channel.
    """
    if interface == "udp_multicast" and not _is_interface_local(channel):
        yield (
            f"bus.channel = {channel}: every machine on this network segment hears this bus and can command its"
            f" nodes; --channel {LOCAL_GROUP} keeps it on this machine"
        )


def _is_interface_local(channel: str) -> bool:
    try:
        group = ipaddress.ip_address(channel)
    except ValueError:
        return False
    return group.version == 6 and group.is_multicast and int(group) >> 112 & 0xF == 1


def backend_channel(interface: str, channel: str) -> str | int:
    """A channel as its interface takes it.

    Raises:
        UsageError: the interface numbers its channels, and this is no number.
    """
    backend = BACKENDS.get(interface)
    if backend is None or not backend.indexed:
        return channel
    if not channel.isdecimal():
        raise UsageError(
            f"{interface}: its channels are numbers: expected --channel {backend.example}, for example, got {channel}"
            + "".join(f"; {lacking}" for lacking in (*backend.missing, _WHERE_SHOWN))
        )
    return int(channel)


def bus_options(interface: str, channel: str, bitrate: int, data_bitrate: int | None) -> dict[str, Any]:
    """Arguments of `can.Bus` for an interface.

    Raises:
        UsageError: the interface does not exist, does not take this channel or bit rate, or has no CAN FD.
    """
    check_interface_name(interface)
    options: dict[str, Any] = {
        "interface": interface,
        "channel": backend_channel(interface, channel),
        "bitrate": bitrate,
    }
    backend = BACKENDS.get(interface, Backend("", "", "", has="fd"))
    if backend.bitrates_kbit and bitrate / 1000 not in backend.bitrates_kbit:
        known = ", ".join(f"{rate:g}" for rate in backend.bitrates_kbit)
        raise UsageError(f"{channel}: {interface} has no bit rate of {bitrate / 1000:g} kbit/s, only {known}")
    if data_bitrate is None:
        return options
    if not backend.features & {"fd", "fd-timing"}:
        raise UsageError(f"{channel}: {interface} has no CAN FD in python-can; leave the data bit rate out")
    if "fd" in backend.features:
        return options | {"fd": True, "data_bitrate": data_bitrate}
    from can import BitTimingFd

    rates = {"nom_bitrate": bitrate, "data_bitrate": data_bitrate, "f_clock": _FD_CLOCK_HZ}
    return options | {"timing": BitTimingFd.from_sample_point(**rates, nom_sample_point=80.0, data_sample_point=80.0)}


def interface_of(bus: object) -> str:
    """Interface of a bus of python-can; empty where it is of a class that python-can does not know."""
    from can.interfaces import BACKENDS as CLASSES

    names = {kind: name for name, (_, kind) in CLASSES.items()}
    return next((names[kind.__name__] for kind in type(bus).__mro__ if kind.__name__ in names), "")


def open_failure(interface: str, channel: str, error: Exception) -> str:
    """Why an interface cannot be opened: what it lacks here, else how its channels are written, else python-can's word.

    Args:
        interface: interface of python-can.
        channel: channel that was asked for.
        error: what python-can raised; where the library of a driver is missing, that is anything.
    """
    backend = BACKENDS.get(interface)
    if backend is not None and (missing := backend.missing):
        return f"{'; '.join(missing)}; {_WHERE_SHOWN}"
    said = f"python-can says {type(error).__name__}: {error}"
    if backend is None:
        return f"is its driver installed? {said}"
    return f"--channel takes a {backend.channel}, such as {backend.example}; {said}"


def find_adapters() -> list[Adapter]:
    """The channels that this machine has, those of the kernel first."""
    return [*_kernel_interfaces(), *_detected(), *_serial_ports()]


def _kernel_interfaces() -> list[Adapter]:
    if not has_socketcan() or not _NET_FOLDER.is_dir():
        return []
    types = {path.parent.name: path.read_text().strip() for path in sorted(_NET_FOLDER.glob("*/type"))}
    return [_kernel_interface(name) for name, number in types.items() if number == _ARPHRD_CAN]


def _kernel_interface(name: str) -> Adapter:
    link = read_link(name)
    if link is None:  # no `ip`
        return Adapter(SOCKETCAN, name, "state unknown", False, missing_ip() or setting_line(name, 1_000_000))
    if not link.is_up:
        return Adapter(SOCKETCAN, name, "down", False, setting_line(name, link.bitrate or 1_000_000))
    parts = ["up", f"{link.bitrate} bit/s" if link.bitrate else link.kind, link.state]
    return Adapter(SOCKETCAN, name, ", ".join(filter(None, parts)), True, _scan_line(SOCKETCAN, name))


def _detected() -> list[Adapter]:
    """Channels of makers' drivers, as python-can finds them."""
    import can

    logging.getLogger("can").setLevel(logging.CRITICAL)
    asked = [name for name, one in BACKENDS.items() if one.driver is not None and not one.missing]
    found: list[Any] = list(can.detect_available_configs(interfaces=asked)) if asked else []
    rows = [(str(one["interface"]), str(one["channel"])) for one in found]
    if "gs_usb" in asked:
        rows += [("gs_usb", str(number)) for number in range(_gs_usb_devices())]
    return [Adapter(*row, "found", True, _scan_line(*row)) for row in rows]


def _gs_usb_devices() -> int:
    try:
        return len(importlib.import_module("gs_usb.gs_usb").GsUsb.scan())
    except Exception:  # whatever libusb says: then there is none that can be opened
        return 0


def _serial_ports() -> list[Adapter]:
    """Serial ports by USB, each of which may be an slcan adapter."""
    ports = sorted(str(path) for pattern in _USB_SERIAL for path in _DEVICE_FOLDER.glob(pattern))
    lacks = BACKENDS["slcan"].missing
    if sys.platform == "win32" and not lacks:
        ports = [one.device for one in importlib.import_module("serial.tools.list_ports").comports()]
    state = "a serial port; whether an adapter is behind it only opening it shows"
    return [
        Adapter("slcan", port, state, not lacks, lacks[0] if lacks else _scan_line("slcan", port)) for port in ports
    ]


def _scan_line(interface: str, channel: str) -> str:
    return f"canprobe scan --bus {interface} --channel {channel}"


def missing_here(interface: str) -> tuple[str, ...]:
    """What an interface of the table lacks on this machine, each with what to type."""
    if interface != SOCKETCAN:
        return BACKENDS[interface].missing
    if not has_socketcan():
        return (NO_SOCKETCAN,)
    if not _kernel_interfaces():
        return (f"no interface; a virtual one: {how_to_make('vcan0').removeprefix('type: ')}",)
    return ()


@dataclass(frozen=True, slots=True)
class ConfiguredBus:
    """Bus of the configuration; None where it states nothing."""

    interface: str
    channel: str | None
    bitrate: int | None


def configured_bus() -> ConfiguredBus | None:
    """Read python-can's configuration; None where no interface is configured.

    Raises:
        UsageError: the configuration cannot be read, or names an interface that python-can does not know.
    """
    import can.util  # here, as python-can is loaded only where a bus is opened

    named: dict[str, Any] = {}
    try:
        named = {**can.util.load_file_config(), **can.util.load_environment_config(), **can.rc}
        if not (named.get("interface") or named.get("bustype")):
            return None
        found = can.util.load_config()
        channel, bitrate = found.get("channel"), found.get("bitrate")
        return ConfiguredBus(
            interface=str(found["interface"]),
            channel=None if channel is None else str(channel),
            bitrate=None if bitrate is None else int(bitrate),
        )
    except can.CanInterfaceNotImplementedError as error:
        names = ", ".join(sorted(can.VALID_INTERFACES))
        raise UsageError(f"python-can's configuration: {error}; python-can has: {names}") from error
    except json.JSONDecodeError as error:
        raise UsageError(f"CAN_CONFIG is no JSON: {error}") from error
    except (ValueError, TypeError) as error:
        raise UsageError(f"python-can's configuration: {error}") from error
