"""A line of progress, on stderr."""

from __future__ import annotations

import sys


def say(line: str) -> None:
    """Report one line, on stderr."""
    print(line, file=sys.stderr, flush=True)
