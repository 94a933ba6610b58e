"""Types of arguments: numbers, times, ids, channels and folders, each with a clear line for a wrong value."""

from __future__ import annotations

import argparse
import contextlib
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

N = TypeVar("N", int, float)


def word(text: str) -> str:
    """An argument type: any text but an empty one, which a shell makes of a variable that is not set."""
    if not text:
        raise argparse.ArgumentTypeError("expected a name, got ''")
    return text


def folder_path(text: str) -> Path:
    """An argument type: a folder; an empty name is refused, as it would be the current one."""
    return Path(word(text))


def channel(text: str) -> tuple[str | None, str]:
    """Parse `CH` or `NAME=CH`."""
    name, equals, target = text.rpartition("=")
    if not target or (equals and not name):
        raise argparse.ArgumentTypeError(f"expected CH or NAME=CH, got {text!r}")
    return (name if equals else None), target


def number_type(parse: Callable[[str], N], fits: Callable[[N], bool], expected: str) -> Callable[[str], N]:
    """An argument type: numbers that fit.

    Args:
        parse: reads the text; a ValueError says that it is no number.
        fits: whether a number is allowed.
        expected: what is allowed, in the message.
    """

    def read(text: str) -> N:
        with contextlib.suppress(ValueError):
            if fits(value := parse(text)):
                return value
        raise argparse.ArgumentTypeError(f"expected {expected}, got {text!r}")

    return read


def whole(low: int, high: int) -> Callable[[str], int]:
    """An argument type: integers from `low` to `high`."""
    return number_type(int, lambda value: low <= value <= high, f"an integer from {low} to {high}")


seed = whole(0, 2**63 - 1)
"""An argument type: the seed of random numbers."""
seconds = number_type(float, lambda value: 0.0 < value < math.inf, "seconds above 0")
"""An argument type: a duration."""
positive = number_type(float, lambda value: 0.0 < value < 1e6, "a number above 0")
"""An argument type: a number above 0, below a million."""
can_id = number_type(lambda text: int(text, 0), lambda value: 0 <= value < 0x800, "an identifier such as 0x11")
"""An argument type: an 11-bit identifier, decimal or hexadecimal with 0x."""
number_of_32_bits = number_type(
    lambda text: int(text, 0), lambda value: 0 <= value < 1 << 32, "a number of 32 bits such as 4711 or 0x1267"
)
"""An argument type: a number of 1018h, decimal or hexadecimal with 0x."""


def node_id(text: str) -> int:
    """An argument type: a node id, or 255 for none."""
    return 255 if text == "255" else whole(1, 127)(text)


def setting(text: str) -> tuple[str, Any]:
    """An argument type: a key and its value as a scene file writes them; a word needs no quotes."""
    key, equals, value = text.partition("=")
    if not key.strip() or not equals:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE such as task.force_n=3, got {text!r}")
    try:
        return key.strip(), tomllib.loads(f"value = {value}")["value"]
    except ValueError:
        return key.strip(), value.strip()
    except RecursionError:
        raise argparse.ArgumentTypeError(f"expected KEY=VALUE, got one of too many brackets: {text[:40]}…") from None


def node_ids(text: str) -> tuple[int, ...]:
    """An argument type: node ids such as `1-6,16`, ascending and without repetitions."""
    found: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)(?:\s*-\s*(\d+))?\s*", part)
        first, last = (int(match[1]), int(match[2] or match[1])) if match else (0, 0)
        if not 1 <= first <= last <= 126:
            raise argparse.ArgumentTypeError(f"expected node ids from 1 to 126 such as 1-6,16, got {text!r}")
        found.update(range(first, last + 1))
    return tuple(sorted(found))
