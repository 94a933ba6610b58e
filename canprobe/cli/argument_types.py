"""Types of arguments: numbers, times, ids, channels and folders, each with a clear line for a wrong value."""

from __future__ import annotations

import argparse
import math
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any


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


def whole(low: int, high: int) -> Callable[[str], int]:
    """An argument type: integers from `low` to `high`."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"expected an integer from {low} to {high}, got {text!r}")
        return value

    return parse


seed = whole(0, 2**63 - 1)
"""An argument type: the seed of random numbers."""


def node_id(text: str) -> int:
    """An argument type: a node id, or 255 for none."""
    return 255 if text == "255" else whole(1, 127)(text)


def number_of_32_bits(text: str) -> int:
    """An argument type: a number of 1018h, decimal or hexadecimal with 0x."""
    try:
        value = int(text, 0)
    except ValueError:
        value = -1
    if not 0 <= value <= 0xFFFFFFFF:
        raise argparse.ArgumentTypeError(f"expected a number of 32 bits such as 4711 or 0x1267, got {text!r}")
    return value


def seconds(text: str) -> float:
    """An argument type: a duration."""
    return _above_zero(text, "seconds", math.inf)


def positive(text: str) -> float:
    """An argument type: a number above 0, below a million."""
    return _above_zero(text, "a number", 1e6)


def _above_zero(text: str, what: str, end: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < end:
        raise argparse.ArgumentTypeError(f"expected {what} above 0, got {text!r}")
    return value


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
