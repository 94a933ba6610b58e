"""Stuff bits: after five equal bits, stuff bits included, the opposite one is sent.

A stuffing is one integer: stuff bits so far × 16 + state, the state being the last level and how often it was sent.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import cache
from struct import Struct

import numpy as np
from numpy.typing import NDArray

RUN = 5
_STATES = 10


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


COUNT_SHIFT = 6
Rows = tuple[Sequence[int], ...]
"""What some bits do, by what the bits before them did and by their value: stuff bits × 64 + state after them.

Sums of ten such numbers and more keep their stuff bits apart from the states. The first row is that of a state alone.
"""


def state_of(stuffing: int) -> int:
    """The row with which to go on after `feed`."""
    return stuffing & 15


@cache
def byte_rows() -> Rows:
    """Of 8 bits."""
    return _aliased([array("H", row.tolist()) for row in _bits(8)])


@cache
def word_rows() -> Rows:
    """Of 16 bits, highest first."""
    first = _bits(8)
    both = (first >> COUNT_SHIFT << COUNT_SHIFT)[:, :, None] + first[first & _STATE]
    return _aliased([array("H", row.tobytes()) for row in both])


@cache
def last_rows() -> Rows:
    """Of 15 bits that nothing follows: their stuff bits alone."""
    first = _bits(8)
    both = (first >> COUNT_SHIFT)[:, :, None] + (_bits(7) >> COUNT_SHIFT)[first & _STATE]
    return _aliased([row.astype(np.uint8).tobytes() for row in both])


_STATE = (1 << COUNT_SHIFT) - 1


def _bits(n: int) -> NDArray[np.uint16]:
    """By state and value."""
    fed = np.array([[feed(state, value, n) for value in range(1 << n)] for state in range(_STATES)], np.uint16)
    return (fed >> 4 << COUNT_SHIFT | fed & 15).astype(np.uint16)


def _aliased(rows: Sequence[Sequence[int]]) -> Rows:
    """Each row wherever its state is, whatever was counted before it."""
    most = 16 // (RUN - 1)
    return tuple(rows[min(at & _STATE, _STATES - 1)] for at in range((most << COUNT_SHIFT) + _STATES))


@cache
def cut_into_words(n_data: int) -> tuple[Callable[[bytes], tuple[int, ...]], tuple[Rows, ...]]:
    """How data is cut into words, an odd byte last, and the rows of each."""
    pairs, odd = divmod(n_data, 2)
    return Struct(f">{pairs}H{odd}B").unpack, (word_rows(),) * pairs + (byte_rows(),) * odd


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
