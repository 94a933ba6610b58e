"""The `canprobe` command lines in a shell script, a help text or a page, and whether each would be understood."""

from __future__ import annotations

import argparse
import re
import shlex

from canprobe.cli import parser_of


def command_lines(script: str) -> list[list[str]]:
    """The arguments of every call of canprobe, those within `canprobe vcan -- …` too, without comments."""
    found: list[list[str]] = []
    for line in script.splitlines():
        for command in re.split(r" && | \| ", line):
            try:
                words = shlex.split(command.removesuffix(" &"), comments=True)
            except ValueError:  # prose with an apostrophe
                continue
            _collect(words, found)
    return found


def _collect(words: list[str], found: list[list[str]]) -> None:
    while words and re.fullmatch(r"[A-Z_]+=.*", words[0]):
        words = words[1:]
    if words[:1] == ["canprobe"]:
        found.append(words[1:])
        if "--" in words:
            _collect(words[words.index("--") + 1 :], found)


def parse(arguments: list[str]) -> argparse.Namespace:
    """What the command would be called with; an unknown command or option fails the test."""
    try:
        return parser_of(arguments).parse_args(arguments)
    except SystemExit as leaving:
        raise AssertionError(f"canprobe {shlex.join(arguments)}: not understood") from leaving
