"""Stuff bits: after five equal bits, stuff bits included, the opposite one is sent.

A stuffing is one integer: stuff bits so far × 16 + state, the state being the last level and how often it was sent.
"""

from __future__ import annotations

from functools import cache
from typing import Any

RUN = 5


def _state(level: int, run: int) -> int:
    return level * 5 + run - 1  # run 1..5: after the fifth the stuff bit has been sent at once, so 5 never stays


def _step(state: int, bit: int) -> tuple[int, int]:
    """State after one more bit, and the stuff bits that it caused."""
    level, run = divmod(state, 5)
    run = run + 2 if bit == level else 1
    return (_state(bit, run), 0) if run < RUN else (_state(1 - bit, 1), 1)


START_OF_FRAME = _state(0, 1)
"""The stuffing after the first dominant bit."""


def feed(stuffing: int, value: int, n_bits: int) -> int:
    """The stuffing after the lowest `n_bits` of `value`, highest first."""
    state, count = stuffing & 15, stuffing >> 4
    for place in range(n_bits - 1, -1, -1):
        state, stuffed = _step(state, value >> place & 1)
        count += stuffed
    return count << 4 | state


Table = list[Any]
"""What a byte does in one state: at its value (the next state's table, stuff bits); at 256 the stuff bits of 7 bits."""


@cache
def tables() -> list[Table]:
    """By state; made when the first frame is measured."""
    found: list[Table] = [[None] * 257 for _ in range(10)]
    for state, table in enumerate(found):
        for value in range(256):
            after = feed(state, value, 8)
            table[value] = (found[after & 15], after >> 4)
        table[256] = tuple(feed(state, value, 7) >> 4 for value in range(128))
    return found


def most_stuff_bits(pattern: str) -> int:
    """The most stuff bits in a field that begins after a bit of the other level, over every choice of its free bits.

    Args:
        pattern: `0`, `1` and `x` for a free bit.
    """
    reached = {_state(1 - level, 1): 0 for level in (0, 1) if pattern[:1] in ("x", str(level))}
    for symbol in pattern:
        following: dict[int, int] = {}
        for state, count in reached.items():
            for bit in (0, 1) if symbol == "x" else (int(symbol),):
                new, stuffed = _step(state, bit)
                following[new] = max(following.get(new, 0), count + stuffed)
        reached = following
    return max(reached.values(), default=0)
