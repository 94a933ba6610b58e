"""Output of commands: JSON documents, tables and summaries on stdout, lines of progress on stderr."""

from __future__ import annotations

import argparse
import codecs
import itertools
import json
import re
import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence

from canprobe.cell.session.terminal import MARKED_WORDS, MIN_COLUMNS, columns, painted


def say(line: str) -> None:
    """Report one line, on stderr."""
    print(line, file=sys.stderr, flush=True)


def print_json(document: object) -> None:
    """Print one JSON document; NaN is refused.

    Where stdout is not UTF-8 the document is ASCII: JSON has its own escapes, not those of the stream.
    """
    encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
    ascii_only = codecs.lookup(encoding).name != "utf-8"
    print(json.dumps(document, indent=2, allow_nan=False, ensure_ascii=ascii_only))


def print_answer(args: argparse.Namespace, document: object, text: str | Callable[[], None], end: str = "\n") -> None:
    """Print the document where --json asks for it, else the text, or what a function prints in its place."""
    if args.json:
        print_json(document)
    elif callable(text):
        text()
    else:
        print(text, end=end)


def print_table(rows: Sequence[Sequence[str]]) -> None:
    """Print rows in columns; on a terminal that is too narrow the widest are broken."""
    if not rows:
        return
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    if (window := columns(sys.stdout)) is not None:
        while sum(widths) + 2 * (len(widths) - 1) > window and max(widths) > MIN_COLUMNS:
            widths[widths.index(max(widths))] -= 1
    for row in rows:
        broken = [
            [cell] if len(cell) <= width else textwrap.wrap(cell, width)
            for cell, width in zip(row, widths, strict=True)
        ]
        for number, line in enumerate(itertools.zip_longest(*broken, fillvalue="")):
            cells = [cell.ljust(width) for cell, width in zip(line, widths, strict=True)]
            cells[0] = painted(cells[0], "bold", sys.stdout) if number == 0 else cells[0]
            print("  ".join(cells).rstrip())


def print_summary(text: str) -> None:
    """Print a summary: a headline, and lines that begin with their subject; coloured on a terminal."""
    head, *lines = text.splitlines()
    print(painted(head, "green" if head.endswith(": done") else "red", sys.stdout))
    print_lines(lines)


def print_lines(lines: Iterable[str]) -> None:
    """Lines of a summary below its headline."""
    for line in lines:
        match = re.match(r"( +)(\S+)(.*)", line)
        colour = "yellow" if match and match[2] in MARKED_WORDS else "cyan"
        print(f"{match[1]}{painted(match[2], colour, sys.stdout)}{match[3]}" if match else line)
