"""Bit errors on the wire of a timed bus, and what its controllers make of them.

A model of errors is asked once for each transmission; one seed gives the same bits. The error counters of each
controller say which nodes have to wait, which are bus off, and when they come back.

Source: ISO 11898-1:2015, fault confinement: rules for the transmit and the receive error counter.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass

from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.bus.virtual.lockstep import Attachment, LockstepPort
from canprobe.fieldbus.protocol.frame_bits import INTERMISSION_BITS, SUSPEND_BITS

MIN_PASSIVE_COUNT = 128
MIN_WARNING_COUNT = 96
MIN_BUS_OFF_COUNT = 256
RECOVERY_SEQUENCES = 128
"""Sequences of eleven recessive bits that a controller has to hear while it is bus off."""
_RECOVERY_BITS = 11
_AFTER_ACK_BITS = 8
"""Recessive bits at the end of a frame (ACK delimiter, end of frame) and of an error frame (delimiter)."""
WireErrors = Callable[[int, bytes, int], int | None]
"""Called with (can_id, data, bits) of a frame that starts; returns the bit that is hit, counted from 0, or None."""


class BitErrors:
    """Errors of bits that fail independently of each other, each with the same probability.

    Args:
        rate: bit error rate, 0..1; 1e-7 in an industrial hall, 3e-5 next to a welder (Ferreira et al. 2004).
        seed: seed of the sequence.
    """

    def __init__(self, rate: float, seed: int) -> None:
        if not 0 <= rate < 1:
            raise ValueError(f"a bit error rate lies in 0..1, not {rate}")
        self._log = math.log1p(-rate)
        self._random = random.Random(seed)
        self._left = self._gap()

    def __call__(self, can_id: int, data: bytes, bits: int) -> int | None:
        """Number of the first bit of this frame that is hit, or None."""
        if self._left >= bits:
            self._left -= bits
            return None
        hit, self._left = int(self._left), self._gap()
        return hit

    def _gap(self) -> float:
        """Number of good bits before the next bad one."""
        # geometric: a draw for each bad bit in place of one for each bit; 1 - u, as u may be 0
        return math.floor(math.log(1.0 - self._random.random()) / self._log) if self._log else math.inf


@dataclass(slots=True)
class ErrorCounters:
    """Counters of one controller.

    Attributes:
        transmit: transmit error counter (TEC).
        receive: receive error counter (REC).
        bus_offs: number of times that the controller went bus off.
        outstanding: number of sequences of eleven recessive bits until it comes back; 0 where it is not bus off.
    """

    transmit: int = 0
    receive: int = 0
    bus_offs: int = 0
    outstanding: int = 0

    @property
    def state(self) -> ControllerState:
        """Error state of the controller by its counters."""
        if self.outstanding:
            return ControllerState.BUS_OFF
        worst = max(self.transmit, self.receive)
        if worst >= MIN_PASSIVE_COUNT:
            return ControllerState.PASSIVE
        return ControllerState.WARNING if worst >= MIN_WARNING_COUNT else ControllerState.ACTIVE

    def transmit_error(self, *, acknowledge: bool = False) -> None:
        """Count an error flag that the controller sent as the transmitter.

        Args:
            acknowledge: whether the acknowledgement was missing and no other node sent an error flag. An error-passive
                node does not count that, so that a node alone on its bus never goes bus off.
        """
        if acknowledge and self.state is ControllerState.PASSIVE:
            return
        self.transmit += 8
        if self.transmit >= MIN_BUS_OFF_COUNT:
            self.bus_offs += 1
            self.outstanding = RECOVERY_SEQUENCES

    def receive_error(self) -> None:
        """Count an error that the controller saw as a receiver."""
        if not self.outstanding:
            self.receive += 1

    def transmitted(self) -> None:
        """Count a frame that was sent without an error."""
        self.transmit = max(0, self.transmit - 1)

    def received(self) -> None:
        """Count a frame that was received without an error."""
        if self.receive >= MIN_PASSIVE_COUNT:
            self.receive = MIN_PASSIVE_COUNT - 1  # the standard allows 119 to 127
        elif self.receive:
            self.receive -= 1

    def heard_recessive(self, sequences: int) -> bool:
        """Count sequences of eleven recessive bits; return whether the controller came back, with both counters 0."""
        if not self.outstanding:
            return False
        self.outstanding = max(0, self.outstanding - sequences)
        if self.outstanding:
            return False
        self.transmit = self.receive = 0
        return True


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
        # a list: of a generator the first node that comes back would keep those behind it from counting
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
