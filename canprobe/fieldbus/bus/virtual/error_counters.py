"""Error counters of one controller: error active, error passive, bus off, and the way back.

Source: ISO 11898-1:2015, fault confinement: rules for the transmit and the receive error counter.
"""

from __future__ import annotations

from dataclasses import dataclass

from canprobe.fieldbus.bus.port import ControllerState

MIN_PASSIVE_COUNT = 128
MIN_WARNING_COUNT = 96
MIN_BUS_OFF_COUNT = 256
RECOVERY_SEQUENCES = 128
"""Sequences of eleven recessive bits that a controller has to hear while it is bus off."""


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
