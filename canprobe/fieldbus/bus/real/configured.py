"""The bus that python-can's own configuration names: CAN_INTERFACE and its kin, CAN_CONFIG, can.conf, ~/.canrc.

Source: python-can manual, "Configuration".
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

from canprobe.errors import UsageError


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
