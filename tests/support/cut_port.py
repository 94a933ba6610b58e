"""A port whose interface is gone for a time."""

from __future__ import annotations

import math
from typing import Any

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.port import Port


class CutPort:
    """A port that fails from `lost_ns` on, until `back_ns`; all else is that of the port."""

    def __init__(self, port: Port, lost_ns: int, back_ns: float = math.inf) -> None:
        self._port, self._lost_ns, self._back_ns = port, lost_ns, back_ns

    def __getattr__(self, name: str) -> Any:
        if name in ("send_batch", "drain", "wait") and self._lost_ns <= self._port.clock.now_ns() < self._back_ns:
            raise InterfaceError(f"{self._port.channel}: it is gone")
        return getattr(self._port, name)
