"""A progress bar, for commands and for what runs long from Python."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TextIO

Progress = Callable[[float, float], None]
"""Called with what is done and the whole, in one unit."""


def progress_bar(stream: TextIO | None = None, width: int = 40, unit: str = ".1f s") -> Progress | None:
    """A progress bar on a terminal or in a notebook, None elsewhere.

    Args:
        stream: stderr by default.
        width: of the bar, in characters.
        unit: form of a number, and the unit's name.

    Returns:
        A function of (done, total), both in the same unit, that redraws only when the picture changes.
    """
    out = sys.stderr if stream is None else stream
    if not (out.isatty() or "ipykernel" in sys.modules):
        return None
    form, name = unit.split()
    shown = -1

    def show(done: float, total: float) -> None:
        nonlocal shown
        share = min(max(done / total, 0.0), 1.0) if total > 0 else 1.0
        if (percent := int(100 * share)) == shown:
            return
        shown = percent
        bar = "█" * round(width * share)
        out.write(f"\r{bar.ljust(width, '░')} {percent:3d} %  {done:{form}} of {total:{form}} {name}")
        out.write("\n" if percent == 100 else "")
        out.flush()

    return show
