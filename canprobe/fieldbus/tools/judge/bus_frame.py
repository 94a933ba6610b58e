"""A frame that was seen on a bus, and the place of an object."""

from __future__ import annotations

from dataclasses import dataclass

from canprobe.fieldbus.protocol.frames import EFF_FLAG, EFF_MASK, RTR_FLAG

Place = tuple[int, int]
"""Index and sub-index of an object."""


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


def place_text(place: Place) -> str:
    """The place of an object in words, such as 1600h:01."""
    return f"{place[0]:04X}h:{place[1]:02X}"
