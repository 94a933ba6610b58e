"""A frame that was seen on a bus."""

from __future__ import annotations

from dataclasses import dataclass

from canprobe.fieldbus.protocol.frames import EFF_FLAG, EFF_MASK, RTR_FLAG


@dataclass(frozen=True, slots=True)
class BusFrame:
    """A frame that was seen.

    Attributes:
        t_ns: time on the clock of the bus or its log.
        can_id: identifier with the flags of `protocol.frames`.
        data: data bytes.
        from_node: whether a node that is served here has sent it; None in a log, which does not have it.
    """

    t_ns: int
    can_id: int
    data: bytes
    from_node: bool | None = None

    def __str__(self) -> str:
        name = f"{self.can_id & EFF_MASK:08X}" if self.can_id & EFF_FLAG else f"{self.can_id & 0x7FF:03X}"
        return f"({self.t_ns * 1e-9:.6f}) {name}#{'R' if self.can_id & RTR_FLAG else self.data.hex().upper()}"
