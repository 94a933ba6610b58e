"""The tables of docs/conform.md: our points, and the cases of CiA's test tool beside them."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from canprobe.fieldbus.tools.conform.permits import WORDS
from canprobe.fieldbus.tools.conform.registry import LEFT_OUT, POINTS

CASES = Path(__file__).with_name("cia_cases.toml")
_MARKED = re.compile(r"(<!-- generated (\w+) -->).*?(<!-- /generated -->)", re.DOTALL)


_SAID = {"P": "passed", "F": "failed", "S": "skipped", "W": "warned"}
_WORST = ("NOT APPLICABLE", "PASS", "ERROR", "FAIL")


def _points(_verdicts: Mapping[str, str]) -> Iterator[str]:
    yield "| group | point | clause | accepted | needs |"
    yield "| --- | --- | --- | --- | --- |"
    for point in POINTS:
        needs = ", ".join(sorted(point.needs))
        yield f"| {point.group} | {point.title} | {point.clause} | {point.expected} | {needs} |"


def _left_out(_verdicts: Mapping[str, str]) -> Iterator[str]:
    yield from (f"- {what}: {why}" for what, why in LEFT_OUT)


def _words(_verdicts: Mapping[str, str]) -> Iterator[str]:
    yield from (f"- `{word}`: {what}" for word, what in WORDS.items())


def _cases(verdicts: Mapping[str, str]) -> Iterator[str]:
    document = tomllib.loads(CASES.read_text(encoding="utf-8"))
    known = {point.number for point in POINTS} | {point.title for point in POINTS}
    yield "| case | what | our points | CiA's tool | conform |"
    yield "| --- | --- | --- | --- | --- |"
    for group, cases in document["cases"].items():
        for number, what, reason, points, said in cases:
            if unknown := set(points) - known:
                raise ValueError(f"{CASES}: {group} {number} names point {unknown}, which is none")
            texts = [", ".join(map(str, points))] if points else []
            texts += [document["never"][reason]] if reason else []
            found = [verdicts[str(point)] for point in points if str(point) in verdicts]
            verdict = max(found, key=_WORST.index) if found else "–"
            yield f"| {group} {number} | {what} | {'; '.join(texts)} | {_SAID[said]} | {verdict} |"


_BLOCKS = {"points": _points, "left_out": _left_out, "words": _words, "cases": _cases}


def conform_page(page: str, measured: Mapping[str, Any]) -> str:
    """The page with its tables between their marks; the verdicts on CANopenNode's demo device are measured."""
    verdicts = measured.get("canopen_node", {}).get("verdicts", {})
    return _MARKED.sub(lambda m: f"{m[1]}\n\n{chr(10).join(_BLOCKS[m[2]](verdicts))}\n\n{m[3]}", page)
