"""LSS requests: find nodes without an id one after another, and give each an id.

Source: CiA 305, "LSS services".
"""

from __future__ import annotations

from canprobe.errors import BusError
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol import lss
from canprobe.fieldbus.protocol.lss import LssAddress, LssCommand, LssError, LssState

SETTLING_S = 0.005
"""Time that is waited after the first answer, as several nodes may answer one question one after another."""
ANSWER_TIMEOUT_S = 0.5
SEARCH_TIMEOUT_S = 0.05
"""Time without an answer after which the answer to a question of fastscan is no."""


class LssAnswerError(BusError):
    """An LSS slave gives no answer, an error code, or answers that do not agree."""


class Lss:
    """The LSS master on a network. All slaves answer with one identifier, so it asks one question at a time."""

    def __init__(self, network: PumpedNetwork) -> None:
        self._network = network

    def release(self) -> None:
        """Put all nodes into the waiting state; a node that got an id boots with it."""
        self._send(lss.pack_lss(LssCommand.SWITCH_GLOBAL, bytes((LssState.WAITING,))))

    def select(self, address: LssAddress) -> bool:
        """Put the node of this address into configuration; return whether it answered."""
        *first, last = [
            lss.pack_number(LssCommand(LssCommand.SELECT_VENDOR + i), number)
            for i, number in enumerate(address.numbers)
        ]
        for message in first:
            self._send(message)
        return bool(self._ask(last, ANSWER_TIMEOUT_S, LssCommand.SELECTED))

    def inquire_node_ids(self) -> list[int]:
        """Node ids of all nodes in configuration: one, unless several devices have one address."""
        command = LssCommand.INQUIRE_NODE_ID
        return [answer[1] for answer in self._ask(lss.pack_lss(command), ANSWER_TIMEOUT_S, command)]

    def configure_node_id(self, node_id: int) -> None:
        """Give the node in configuration its id.

        Raises:
            LssAnswerError: the node does not answer, or refuses.
        """
        if code := self._configure(LssCommand.CONFIGURE_NODE_ID, node_id):
            raise LssAnswerError(f"LSS error {code}")

    def store(self) -> bool:
        """Let the node in configuration store its id over a power cycle; return False where it does not support that.

        Raises:
            LssAnswerError: the node does not answer, or could not store its id.
        """
        if (code := self._configure(LssCommand.STORE)) > LssError.REFUSED:
            raise LssAnswerError(f"it could not store it: LSS error {code}")
        return code == LssError.NONE

    def fast_scan(self) -> LssAddress | None:
        """Find the unconfigured node with the lowest address; it is in configuration afterwards.

        Returns:
            Its address; None where no node answers.

        Raises:
            LssAnswerError: nodes answer, but no address is found: answers were lost or came late.
        """
        for timeout_s in (SEARCH_TIMEOUT_S, 5 * SEARCH_TIMEOUT_S):
            if not self._identified(0, lss.PRESENCE_CHECK, 0, 0, ANSWER_TIMEOUT_S):
                return None
            if (address := self._search(timeout_s)) is not None:
                return address
        raise LssAnswerError(
            f"{self._network.port.channel}: nodes without an id answer, but not to the end of a search; connect them"
            " one at a time"
        )

    def _search(self, timeout_s: float) -> LssAddress | None:
        found: list[int] = []
        for position in range(4):
            number = 0
            for bit in range(31, -1, -1):
                if not self._identified(number, bit, position, position, timeout_s):
                    number |= 1 << bit
            if not self._identified(number, 0, position, (position + 1) % 4, ANSWER_TIMEOUT_S):
                return None
            found.append(number)
        return LssAddress(*found)

    def _identified(self, number: int, bit: int, position: int, following: int, timeout_s: float) -> bool:
        return bool(self._ask(lss.pack_fastscan(number, bit, position, following), timeout_s, LssCommand.IDENTIFIED))

    def _configure(self, command: LssCommand, value: int = 0) -> int:
        answers = self._ask(lss.pack_lss(command, bytes((value,))), ANSWER_TIMEOUT_S, command)
        if not answers:
            raise LssAnswerError(f"no answer to {command.name.lower().replace('_', ' ')}")
        return answers[0][1]

    def _send(self, message: bytes) -> None:
        self._network.send_message(lss.LSS_REQUEST_ID, message)

    def _ask(self, message: bytes, timeout_s: float, command: LssCommand) -> list[bytes]:
        """Send a question; return the answers with this command."""
        network = self._network
        answers: list[bytes] = []

        def take(_id: int, data: bytes, _t_ns: int) -> None:
            if len(data) == lss.LSS_BYTES:
                answers.append(data)

        network.pump_until(lambda: True, 0.0)  # late answers to earlier questions
        network.subscribe(lss.LSS_ANSWER_ID, take)
        try:
            self._send(message)
            if network.pump_until(lambda: bool(answers), timeout_s):
                network.pump_until(lambda: False, SETTLING_S)
        finally:
            network.unsubscribe(lss.LSS_ANSWER_ID, take)
        return [answer for answer in answers if answer[0] == command]
