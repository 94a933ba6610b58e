"""canopen's LSS master, waiting by receiving: on the port's clock, whatever that is.

canopen's own waits for a thread that puts answers into a queue, sleeps 10 ms after each question of a search and 0.2 s
after each part of an address, and takes a second answer to one question for the answer to the next one.
"""

from __future__ import annotations

import queue
import struct
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from canopen.lss import LssError, LssMaster

from canprobe.protocol.lss import (
    LSS_LENGTH,
    LSS_REQUEST_ID,
    NOTHING_ASKED,
    LssCommand,
    pack_fastscan,
    pack_lss,
    pack_number,
)

if TYPE_CHECKING:
    from canprobe.bus.network import PumpedNetwork

SETTLE_S = 0.005
"""Several nodes may give the same answer to one question, one after another: so long the later ones are waited for."""


class _Arrivals(queue.Queue[bytes]):
    """Answers; whoever waits for one, receives."""

    def __init__(self, network: PumpedNetwork) -> None:
        super().__init__()
        self._network = network

    def get(self, block: bool = True, timeout: float | None = None) -> bytes:
        self._network.pump_until(lambda: self.qsize() > 0, timeout or 0.0)
        return super().get(block=False)


class PumpedLss(LssMaster):
    """LSS over a `PumpedNetwork`; RESPONSE_TIMEOUT (s) runs on the port's clock. Errors are canopen's `LssError`."""

    RESPONSE_TIMEOUT = 0.5
    SCAN_TIMEOUT = 0.05
    """How long nobody has to answer a question of fastscan before it is taken for a no."""

    def __init__(self, network: PumpedNetwork) -> None:
        self._pumped = network
        super().__init__()
        self.network = network

    @property
    def responses(self) -> queue.Queue[Any]:
        """Answers that have arrived. canopen forgets old ones by putting a new queue in their place."""
        return self._arrivals

    @responses.setter
    def responses(self, _: Any) -> None:
        self._arrivals = _Arrivals(self._pumped)

    def on_message_received(self, can_id: int, data: bytearray, timestamp: float) -> None:
        """Keep an answer; one of another length is none."""
        if len(data) != LSS_LENGTH:
            raise struct.error("an LSS message has 8 bytes")
        self.responses.put(bytes(data))

    def send_switch_state_selective(
        self, vendorId: int, productCode: int, revisionNumber: int, serialNumber: int
    ) -> bool:
        """Put the node of this address into configuration; whether it answered."""
        numbers = (vendorId, productCode, revisionNumber, serialNumber)
        *first, last = [pack_number(LssCommand(LssCommand.SELECT_VENDOR + i), n) for i, n in enumerate(numbers)]
        for message in first:
            self._pumped.send_message(LSS_REQUEST_ID, message)
        return self._ask(last, self.RESPONSE_TIMEOUT, LssCommand.SELECTED) > 0

    def inquire_node_ids(self) -> list[int]:
        """What all the nodes in configuration answer: one node id, unless several devices have one address."""
        self._ask(pack_lss(LssCommand.INQUIRE_NODE_ID), self.RESPONSE_TIMEOUT, LssCommand.INQUIRE_NODE_ID)
        return [answer[1] for answer in self._answers]

    def fast_scan(self) -> tuple[bool, list[int] | None]:
        """Find the unconfigured node with the lowest address; it is in configuration afterwards.

        Returns:
            (True, the four numbers of 1018h), or (False, None) where nobody answers.

        Raises:
            LssError: somebody answers, but to no address: answers were lost or came late.
        """
        for timeout_s in (self.SCAN_TIMEOUT, 5 * self.SCAN_TIMEOUT):
            if not self._identified(0, NOTHING_ASKED, 0, 0, self.RESPONSE_TIMEOUT):
                return False, None
            if (numbers := self._search(timeout_s)) is not None:
                return True, numbers
        raise LssError("nodes without an id answer, but not to the end of a search; connect them one at a time")

    def _search(self, timeout_s: float) -> list[int] | None:
        found: list[int] = []
        for position in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not self._identified(number, bit, position, position, timeout_s):
                    number |= 1 << bit
            if not self._identified(number, 0, position, (position + 1) % 4, self.RESPONSE_TIMEOUT):
                return None
            found.append(number)
        return found

    def _identified(self, number: int, bit: int, position: int, following: int, timeout_s: float) -> bool:
        return self._ask(pack_fastscan(number, bit, position, following), timeout_s, LssCommand.IDENTIFIED) > 0

    def _ask(self, message: bytes, timeout_s: float, answer: LssCommand) -> int:
        """Ask, and count the answers that come; `_answers` are they."""
        self._pumped.pump_until(lambda: True, 0.0)
        self.responses = None
        self._pumped.send_message(LSS_REQUEST_ID, message)
        self._answers: Sequence[bytes] = ()
        if self._pumped.pump_until(lambda: self.responses.qsize() > 0, timeout_s):
            self._pumped.pump_until(lambda: False, SETTLE_S)
            arrived = [self.responses.get_nowait() for _ in range(self.responses.qsize())]
            self._answers = [data for data in arrived if data[0] == answer]
        return len(self._answers)
