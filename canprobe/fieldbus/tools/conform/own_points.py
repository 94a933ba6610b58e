"""Points of the user, from a TOML file: a list of steps each, under the same gate and put back like all others.

    [[point]]
    name = "temperature"
    clause = "manual, 4.2"
    needs = ["nmt"]
    steps = [
        { read = "2100h:01", low = 15, high = 80 },
        { write = "2101h", value = 7, abort = "06010002h" },
        { nmt = "start" },
        { expect = "185", data = "0100", within_ms = 50 },
        { silent = "385", for_ms = 100 },
        { send = "080#", emcy = "8240h", within_ms = 20 },
        { wait_ms = 100 },
        { ask = "Switch the device off and on" },
    ]

A step has one of the words of `STEPS`; what else it may have stands there, too. Numbers of objects, codes and
identifiers are hexadecimal, values are numbers of TOML.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from canprobe.errors import UsageError, did_you_mean, regular_file
from canprobe.fieldbus.protocol.frames import NmtCommand
from canprobe.fieldbus.protocol.sdo import Place, place_text
from canprobe.fieldbus.tools.conform.accepted import abort_text
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.point import Point
from canprobe.fieldbus.tools.conform.sdo_client import SdoRefused

FIRST_NUMBER = 201
"""Number of the first point of a file."""
_KEYS = ("name", "clause", "expected", "hint", "needs", "steps")
_NEEDS = ("eds", "nmt", "sync", "alone", "drive", "motion")
_NMT = {command.name.lower().replace("_", "-"): command for command in NmtCommand}
_MAX_BYTES = 1 << 20
_DEFAULT_MS = 100.0
_PLACE = re.compile(r"([0-9A-Fa-f]{4})h?(?::([0-9A-Fa-f]{1,2})h?)?")
_FRAME = re.compile(r"([0-9A-Fa-f]{3})#((?:[0-9A-Fa-f]{2}){0,8})")
Step = Callable[[Bench], None]


def read_points(path: Path) -> tuple[Point, ...]:
    """Read the points of a file.

    Raises:
        UsageError: the file cannot be read, or something in it is wrong; the message says where, and what is expected.
    """
    try:
        document = tomllib.loads(regular_file(path, _MAX_BYTES).read_text(encoding="utf-8"))
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UsageError(f"{path}: expected TOML: {error}") from error
    rows = document.get("point")
    if set(document) != {"point"} or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise UsageError(f"{path}: expected tables [[point]] and nothing else")
    points = []
    for number, row in enumerate(rows, start=FIRST_NUMBER):
        where = f"{path}: point {number - FIRST_NUMBER + 1}"
        _check_keys(where, row, _KEYS)
        name, steps, needs = row.get("name"), row.get("steps"), row.get("needs", [])
        if not isinstance(name, str) or not name or not isinstance(steps, list) or not steps:
            raise UsageError(f"{where}: expected a name and a list of steps")
        if not isinstance(needs, list) or not set(needs) <= set(_NEEDS):
            raise UsageError(f"{where}: needs: expected some of {', '.join(_NEEDS)}, got {needs!r}")
        acts = [_parse_step(f"{where}, step {at}", step) for at, step in enumerate(steps, start=1)]
        texts = [str(row.get(key, "")) for key in ("clause", "expected", "hint")]
        points.append(Point(number, "own", name, texts[0], texts[1], partial(_run, acts), frozenset(needs), texts[2]))
    return tuple(points)


def _run(acts: list[Step], bench: Bench) -> None:
    for act in acts:
        act(bench)


def _check_keys(where: str, table: Mapping[str, Any], known: tuple[str, ...]) -> None:
    for key in table:
        if key not in known:
            raise UsageError(f"{where}: unknown key {key!r}{did_you_mean(key, known)}; known are {', '.join(known)}")


def _parse_step(where: str, step: object) -> Step:
    """One step as a function of the bench."""
    words = [word for word in STEPS if isinstance(step, dict) and word in step]
    if not isinstance(step, dict) or not words:
        raise UsageError(f"{where}: expected a table with one of {', '.join(STEPS)}, got {step!r}")
    word = words[0]
    parse, keys = STEPS[word]
    _check_keys(where, step, (word, *keys))
    value = step[word]
    try:
        return parse(value, step)
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{where}: {word} = {value!r}: {error}") from error


def _place(text: str) -> Place:
    match = _PLACE.fullmatch(text)
    if match is None:
        raise ValueError("expected an object such as 2100h:01")
    return int(match[1], 16), int(match[2] or "0", 16)


def _code(text: str) -> int:
    return int(text.removesuffix("h"), 16)


def _number(step: Mapping[str, Any], key: str) -> int | None:
    value = step.get(key)
    if value is not None and (not isinstance(value, int) or isinstance(value, bool)):
        raise TypeError(f"{key}: expected a whole number, got {value!r}")
    return value


def _seconds(step: Mapping[str, Any], key: str) -> float:
    value = float(step.get(key, _DEFAULT_MS))
    if not 0 <= value <= 3_600_000:
        raise ValueError(f"{key}: expected milliseconds up to an hour, got {value:g}")
    return value * 1e-3


def _refused(bench: Bench, what: str, code: int | None, access: Callable[[], object]) -> bool:
    """Access an entry; return whether it was refused, as it had to be."""
    try:
        access()
    except SdoRefused as refused:
        if code is None or refused.code != code:
            bench.deviates(f"{what}: aborted with {abort_text(refused.code)}")
        return True
    if code is not None:
        bench.deviates(f"{what}: accepted, expected abort {code:08X}h")
    return False


def _read(text: str, step: Mapping[str, Any]) -> Step:
    place, code = _place(text), _code(step["abort"]) if "abort" in step else None
    equals, mask = _number(step, "equals"), _number(step, "mask")
    low, high = _number(step, "low"), _number(step, "high")

    def act(bench: Bench) -> None:
        what = f"read of {place_text(*place)}"
        if _refused(bench, what, code, lambda: bench.upload(*place)):
            return
        data, entry = bench.upload(*place), bench.device.described(*place)
        value = int.from_bytes(data, "little", signed=entry is not None and entry.signed)
        value = value if mask is None else value & mask
        if (equals is not None and value != equals) or not (low is None or low <= value):
            bench.deviates(f"{what}: {value}, expected {equals if equals is not None else f'at least {low}'}")
        if high is not None and value > high:
            bench.deviates(f"{what}: {value}, expected at most {high}")

    return act


def _write(text: str, step: Mapping[str, Any]) -> Step:
    place, code, value = _place(text), _code(step["abort"]) if "abort" in step else None, _number(step, "value")
    if value is None:
        raise KeyError("a value is missing")

    def act(bench: Bench) -> None:
        data = bench.packed(*place, value)
        _refused(bench, f"write of {value} to {place_text(*place)}", code, lambda: bench.download(*place, data))

    return act


def _nmt(text: str, _step: Mapping[str, Any]) -> Step:
    if text not in _NMT:
        raise ValueError(f"expected one of {', '.join(_NMT)}")
    command = _NMT[text]

    def act(bench: Bench) -> None:
        if text.startswith("reset"):
            bench.reset(command)
        else:
            bench.nmt(command)
            bench.pass_time(0.01)

    return act


def _send(text: str, step: Mapping[str, Any]) -> Step:
    match = _FRAME.fullmatch(text)
    if match is None:
        raise ValueError("expected a frame such as 205#0102")
    can_id, data, within_s = int(match[1], 16), bytes.fromhex(match[2]), _seconds(step, "within_ms")
    code = _code(step["emcy"]) if "emcy" in step else None

    def act(bench: Bench) -> None:
        bench.send(can_id, data)
        if code is not None:
            bench.emcy(code, within_s)

    return act


def _expect(text: str, step: Mapping[str, Any]) -> Step:
    can_id, begin, within_s = _code(text), bytes.fromhex(step.get("data", "")), _seconds(step, "within_ms")

    def act(bench: Bench) -> None:
        until_ns, seen = bench.now_ns + round(within_s * 1e9), "none"
        while (frame := bench.next(can_id, max(0, until_ns - bench.now_ns) * 1e-9)) is not None:
            if frame.data.startswith(begin):
                return
            seen = frame.data.hex(" ")
        wanted = f" that begins with {begin.hex(' ')}, the last was {seen}" if begin else ""
        bench.deviates(f"no frame {can_id:03X}h within {within_s * 1e3:g} ms{wanted}")

    return act


def _silent(text: str, step: Mapping[str, Any]) -> Step:
    can_id, for_s = _code(text), _seconds(step, "for_ms")

    def act(bench: Bench) -> None:
        bench.expect(not bench.during(for_s, can_id), f"a frame {can_id:03X}h comes")

    return act


def _emcy(text: str, step: Mapping[str, Any]) -> Step:
    code, within_s = _code(text), _seconds(step, "within_ms")
    return lambda bench: (bench.emcy(code, within_s), None)[1]


def _wait(value: float, _step: Mapping[str, Any]) -> Step:
    seconds = _seconds({"wait_ms": value}, "wait_ms")
    return lambda bench: bench.pass_time(seconds)


def _ask(text: str, _step: Mapping[str, Any]) -> Step:
    return lambda bench: None if bench.by_hand(str(text)) else bench.does_not_apply(f"it was not done by hand: {text}")


STEPS: Mapping[str, tuple[Callable[[Any, Mapping[str, Any]], Step], tuple[str, ...]]] = {
    "read": (_read, ("equals", "mask", "low", "high", "abort")),
    "write": (_write, ("value", "abort")),
    "nmt": (_nmt, ()),
    "send": (_send, ("emcy", "within_ms")),
    "expect": (_expect, ("data", "within_ms")),
    "silent": (_silent, ("for_ms",)),
    "emcy": (_emcy, ("within_ms",)),
    "wait_ms": (_wait, ()),
    "ask": (_ask, ()),
}
"""Words of a step: what parses it, and what else it may have."""
