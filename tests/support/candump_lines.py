"""Lines of a candump log, for tests that change a recorded run."""

from __future__ import annotations


def can_id_of(line: str) -> str:
    return line.split()[2].split("#", maxsplit=1)[0]


def stamp_us(line: str) -> int:
    seconds, us = line[1 : line.index(")")].split(".")
    return int(seconds) * 1_000_000 + int(us)


def restamped(line: str, us: int) -> str:
    return f"({us // 1_000_000:010d}.{us % 1_000_000:06d}){line[line.index(')') + 1 :]}"
