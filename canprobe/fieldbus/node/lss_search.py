"""Search for an LSS slave among others: by its whole address, by bounds, or bit by bit.

Source: CiA 305, switch state selective, identify remote slave, fastscan.
"""

from __future__ import annotations

from canprobe.fieldbus.protocol.lss import PRESENCE_CHECK, LssAddress, LssCommand

SELECT_COMMANDS = range(LssCommand.SELECT_VENDOR, LssCommand.SELECT_SERIAL + 1)
IDENTIFY_COMMANDS = range(LssCommand.IDENTIFY_VENDOR, LssCommand.IDENTIFY_SERIAL_HIGH + 1)
_NUMBER_MASK = 0xFFFFFFFF


class LssSearch:
    """Questions that one slave has heard so far."""

    def __init__(self) -> None:
        self._heard: list[tuple[int, int]] = []  # command and number, of the sequence under way
        self._position = 0

    def forget(self) -> None:
        """Forget all questions."""
        self._heard.clear()
        self._position = 0

    def selects(self, data: bytes, mine: LssAddress) -> bool:
        """Switch state selective: the four numbers come one after another, and the last one decides."""
        return tuple(self._complete(data, SELECT_COMMANDS)) == mine.numbers

    def identifies(self, data: bytes, mine: LssAddress) -> bool:
        """Identify remote slave: vendor and product, and a lowest and a highest revision and serial number."""
        numbers = self._complete(data, IDENTIFY_COMMANDS)
        if not numbers:
            return False
        vendor, product, revision_low, revision_high, serial_low, serial_high = numbers
        return (
            (vendor, product) == (mine.vendor_id, mine.product_code)
            and revision_low <= mine.revision_number <= revision_high
            and serial_low <= mine.serial_number <= serial_high
        )

    def fastscan(self, data: bytes, mine: LssAddress) -> tuple[bool, bool]:
        """Whether the asked bits of one number are mine, and whether the whole address is found."""
        bit, position, following = data[5:]
        if not (bit < 32 or bit == PRESENCE_CHECK) or position > 3 or following > 3:
            return False, False
        if bit == PRESENCE_CHECK:
            self._position = 0
            return True, False
        asked = _NUMBER_MASK << bit & _NUMBER_MASK
        if position != self._position or (_number_in(data) ^ mine.numbers[position]) & asked:
            return False, False
        self._position = following
        return True, bit == 0 and following < position

    def _complete(self, data: bytes, sequence: range) -> list[int]:
        """Take one number of a sequence; return all of them after the last one, if none was left out, else nothing."""
        if data[0] != sequence[0] and (not self._heard or self._heard[-1][0] != data[0] - 1):
            self._heard.clear()
            return []
        if data[0] == sequence[0]:
            self._heard.clear()
        self._heard.append((data[0], _number_in(data)))
        return [number for _, number in self._heard] if data[0] == sequence[-1] else []


def _number_in(data: bytes) -> int:
    """Number in the 32 bits behind the command specifier."""
    return int.from_bytes(data[1:5], "little")
