"""CAN controllers on one timed bus: which have to wait, which are bus off, and when they come back."""

from __future__ import annotations

from collections.abc import Callable

from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.bus.virtual.error_counters import ErrorCounters
from canprobe.fieldbus.bus.virtual.lockstep import Attachment, LockstepPort
from canprobe.fieldbus.protocol.frame_bits import INTERMISSION_BITS, SUSPEND_BITS

_RECOVERY_BITS = 11
_AFTER_ACK_BITS = 8
"""Recessive bits at the end of a frame (ACK delimiter, end of frame) and of an error frame (delimiter)."""


class Controllers:
    """Error counters of every node, and their consequences. They matter only once a bit has failed.

    Args:
        bits_ns: function that gives the time of so many bits.

    Attributes:
        troubled: whether a counter is not 0.
        suspended: times before which error-passive nodes must not send again after a frame of their own.
    """

    def __init__(self, bits_ns: Callable[[int], int]) -> None:
        self.troubled = False
        self.suspended: dict[Attachment, int] = {}
        self._bits_ns = bits_ns
        self._counters: dict[Attachment, ErrorCounters] = {}
        self._quiet_ns = 0  # since when the wire has been recessive, less what was counted of it

    def add(self, node: Attachment) -> None:
        """Add a node."""
        self._counters[node] = ErrorCounters()

    def remove(self, node: Attachment) -> None:
        """Remove a node."""
        self.suspended.pop(node, None)
        del self._counters[node]

    def of(self, owner: object) -> ErrorCounters:
        """Error counters of a participant or a port.

        Raises:
            KeyError: the owner is not on the bus.
        """
        for node, counters in self._counters.items():
            if node.owner is owner:
                return counters
        raise KeyError(owner)

    def is_off(self, node: Attachment) -> bool:
        """Whether a node is bus off: it neither sends nor hears."""
        return self.troubled and bool(self._counters[node].outstanding)

    def off(self) -> list[Attachment]:
        """The nodes that are bus off."""
        return [node for node, counters in self._counters.items() if counters.outstanding]

    def fail(self, sender: Attachment, end_ns: int) -> None:
        """Count an error frame that ended at `end_ns`, which all controllers saw."""
        self.troubled = True
        self._quiet_ns = end_ns - self._bits_ns(_AFTER_ACK_BITS)
        for node, counters in self._counters.items():
            if node is sender:
                counters.transmit_error(acknowledge=len(self._counters) < 2)
            else:
                counters.receive_error()
            if isinstance(node.owner, LockstepPort):
                node.owner.counters.error_frames += 1
        self._suspend(sender, end_ns)
        self._show_states()

    def succeed(self, sender: Attachment, end_ns: int) -> None:
        """Count a frame that ended at `end_ns`; this is only needed while a counter is not 0."""
        self._quiet_ns = end_ns - self._bits_ns(_AFTER_ACK_BITS)
        for node, counters in self._counters.items():
            if node is sender:
                counters.transmitted()
            elif not counters.outstanding:
                counters.received()
        self._suspend(sender, end_ns)
        self._show_states()
        self.troubled = any(c.transmit or c.receive or c.outstanding for c in self._counters.values())

    def hear_silence(self, until_ns: int) -> None:
        """Let nodes that are bus off count sequences of eleven recessive bits; the wire was silent until now."""
        sequence = self._bits_ns(_RECOVERY_BITS)
        count = (until_ns - self._quiet_ns) // sequence
        self._quiet_ns += count * sequence
        if any([counters.heard_recessive(count) for counters in self._counters.values()]):
            self._show_states()

    def next_return_ns(self) -> int | None:
        """Time at which the next node that is bus off comes back, if the wire stays silent."""
        least = min((c.outstanding for c in self._counters.values() if c.outstanding), default=None)
        return None if least is None else self._quiet_ns + least * self._bits_ns(_RECOVERY_BITS)

    def _suspend(self, sender: Attachment, end_ns: int) -> None:
        """Let an error-passive node wait for eight more bits after its own frame."""
        if self._counters[sender].state is ControllerState.PASSIVE:
            self.suspended[sender] = end_ns + self._bits_ns(INTERMISSION_BITS + SUSPEND_BITS)
        else:
            self.suspended.pop(sender, None)

    def _show_states(self) -> None:
        """Give each port the state of its controller."""
        for node, counters in self._counters.items():
            if isinstance(node.owner, LockstepPort):
                node.owner.state = counters.state
