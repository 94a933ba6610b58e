"""SDO requests spelled out in bytes, for benches that talk to one node."""

from __future__ import annotations

from collections.abc import Sequence

OFF = 0x80000000


class SdoWords:
    """Expedited transfers over a bench's own `ask`, which sends one request in hex and returns the answer in hex."""

    def ask(self, text: str) -> str:
        raise NotImplementedError

    def write(self, index: int, sub: int, value: int, size: int) -> int:
        """Expedited download; 0 or the abort code."""
        head = bytes(({1: 0x2F, 2: 0x2B, 4: 0x23}[size], index & 0xFF, index >> 8, sub)).hex()
        return abort_code(self.ask(head + (value & 0xFFFFFFFF).to_bytes(4, "little").hex()))

    def read(self, index: int, sub: int = 0) -> int:
        """Expedited upload of an unsigned number; asserts that it worked."""
        answer = bytes.fromhex(self._upload(index, sub))
        assert answer[0] & 0xF3 == 0x43, answer.hex()
        return int.from_bytes(answer[4 : 8 - (answer[0] >> 2 & 3)], "little")

    def refusal(self, index: int, sub: int = 0) -> int:
        """Abort code of an upload."""
        return abort_code(self._upload(index, sub))

    def configure(self, index: int, *, cob_id: int, words: Sequence[int], **parameters: int) -> None:
        """A PDO by the standard's sequence: off, mapping, parameters, on."""
        sizes = {"type": (2, 1), "inhibit": (3, 2), "event": (5, 2), "start": (6, 1)}
        orders = [(index, 1, OFF | cob_id, 4), (index + 0x200, 0, 0, 1)]
        orders += [(index + 0x200, sub, word, 4) for sub, word in enumerate(words, start=1)]
        orders += [(index + 0x200, 0, len(words), 1)]
        orders += [(index, sizes[name][0], value, sizes[name][1]) for name, value in parameters.items()]
        for order in [*orders, (index, 1, cob_id, 4)]:
            assert self.write(*order) == 0, order

    def _upload(self, index: int, sub: int) -> str:
        return self.ask(bytes((0x40, index & 0xFF, index >> 8, sub)).hex() + "00000000")


def abort_code(answer: str) -> int:
    """Abort code of an answer in hex; 0 where it is none."""
    data = bytes.fromhex(answer)
    return int.from_bytes(data[4:], "little") if data[0] == 0x80 else 0
