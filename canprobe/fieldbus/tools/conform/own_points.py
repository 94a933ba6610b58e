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

from canprobe.errors import UsageError, did_you_mean
from canprobe.fieldbus.bus.files import read_document
from canprobe.fieldbus.protocol.frames import Frame, NmtCommand
from canprobe.fieldbus.protocol.sdo import Place, place_text
from canprobe.fieldbus.tools.conform.accepted import abort_text
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.point import Point
from canprobe.fieldbus.tools.conform.sdo_client import SdoRefused

FIRST_NUMBER = 201
"""Number of the first point of a file."""
_KEYS = ("name", "clause", "expected", "hint", "needs", "steps")
_NEEDS = ("eds", "nmt", "sync", "alone", "drive", "motion")
_COMMANDS = {command.name.lower().replace("_", "-"): command for command in NmtCommand}
_MAX_BYTES = 1 << 20
_DEFAULT_MS = 100.0
_PLACE = re.compile(r"([0-9A-Fa-f]{4})h?(?::([0-9A-Fa-f]{1,2})h?)?")
_FRAME = re.compile(r"([0-9A-Fa-f]{3})#((?:[0-9A-Fa-f]{2}){0,8})")
Number = int | None
Step = Callable[[Bench], object]
Parser = Callable[[str, Any], Any]
"""Called with a key of a step and its value, None where it is missing; raises ValueError, TypeError or KeyError."""


def read_points(path: Path) -> tuple[Point, ...]:
    """Read the points of a file.

    Raises:
        UsageError: the file cannot be read, or something in it is wrong; the message says where, and what is expected.
    """
    document = read_document(path, _MAX_BYTES, tomllib.loads, "TOML")
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
    act, parsers = STEPS[words[0]]
    _check_keys(where, step, tuple(parsers))
    try:
        return partial(act, **{key: parse(key, step.get(key)) for key, parse in parsers.items()})
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{where}: {words[0]} = {step[words[0]]!r}: {error}") from error


def _place(_key: str, text: str) -> Place:
    match = _PLACE.fullmatch(text)
    if match is None:
        raise ValueError("expected an object such as 2100h:01")
    return int(match[1], 16), int(match[2] or "0", 16)


def _code(_key: str, text: str | None) -> Number:
    return None if text is None else int(text.removesuffix("h"), 16)


def _bytes(_key: str, text: str | None) -> bytes:
    return bytes.fromhex("" if text is None else text)


def _number(key: str, value: object) -> Number:
    if value is not None and (not isinstance(value, int) or isinstance(value, bool)):
        raise TypeError(f"{key}: expected a whole number, got {value!r}")
    return value


def _value(key: str, value: object) -> Number:
    if value is None:
        raise KeyError("a value is missing")
    return _number(key, value)


def _milliseconds(key: str, value: Any) -> float:
    number_ms = float(_DEFAULT_MS if value is None else value)
    if not 0 <= number_ms <= 3_600_000:
        raise ValueError(f"{key}: expected milliseconds up to an hour, got {number_ms:g}")
    return number_ms


def _command(_key: str, text: str) -> NmtCommand:
    if text not in _COMMANDS:
        raise ValueError(f"expected one of {', '.join(_COMMANDS)}")
    return _COMMANDS[text]


def _frame(_key: str, text: str) -> Frame:
    match = _FRAME.fullmatch(text)
    if match is None:
        raise ValueError("expected a frame such as 205#0102")
    return int(match[1], 16), bytes.fromhex(match[2])


def _refused(bench: Bench, what: str, code: Number, access: Callable[[], object]) -> bool:
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


def _read(bench: Bench, read: Place, *, equals: Number, mask: Number, low: Number, high: Number, abort: Number) -> None:
    what = f"read of {place_text(*read)}"
    if _refused(bench, what, abort, lambda: bench.upload(*read)):
        return
    data, entry = bench.upload(*read), bench.device.described(*read)
    value = int.from_bytes(data, "little", signed=entry is not None and entry.signed)
    value = value if mask is None else value & mask
    if (equals is not None and value != equals) or not (low is None or low <= value):
        bench.deviates(f"{what}: {value}, expected {equals if equals is not None else f'at least {low}'}")
    bench.expect(high is None or value <= high, f"{what}: {value}, expected at most {high}")


def _write(bench: Bench, write: Place, value: int, abort: Number) -> None:
    data = bench.packed(*write, value)
    _refused(bench, f"write of {value} to {place_text(*write)}", abort, lambda: bench.download(*write, data))


def _nmt(bench: Bench, nmt: NmtCommand) -> None:
    if nmt in (NmtCommand.RESET_NODE, NmtCommand.RESET_COMMUNICATION):
        bench.reset(nmt)
    else:
        bench.nmt(nmt)
        bench.pass_time(0.01)


def _send(bench: Bench, send: Frame, emcy: Number, within_ms: float) -> None:
    bench.send(*send)
    if emcy is not None:
        bench.emcy(emcy, 1e-3 * within_ms)


def _expect(bench: Bench, expect: int, data: bytes, within_ms: float) -> None:
    seen = "none"
    for frame in bench.coming(expect, 1e-3 * within_ms):
        if frame.data.startswith(data):
            return
        seen = frame.data.hex(" ")
    wanted = f" that begins with {data.hex(' ')}, the last was {seen}" if data else ""
    bench.deviates(f"no frame {expect:03X}h within {within_ms:g} ms{wanted}")


def _silent(bench: Bench, silent: int, for_ms: float) -> None:
    bench.expect(not bench.during(1e-3 * for_ms, silent), f"a frame {silent:03X}h comes")


STEPS: Mapping[str, tuple[Callable[..., object], Mapping[str, Parser]]] = {
    "read": (
        _read,
        {"read": _place, "equals": _number, "mask": _number, "low": _number, "high": _number, "abort": _code},
    ),
    "write": (_write, {"write": _place, "value": _value, "abort": _code}),
    "nmt": (_nmt, {"nmt": _command}),
    "send": (_send, {"send": _frame, "emcy": _code, "within_ms": _milliseconds}),
    "expect": (_expect, {"expect": _code, "data": _bytes, "within_ms": _milliseconds}),
    "silent": (_silent, {"silent": _code, "for_ms": _milliseconds}),
    "emcy": (
        lambda bench, emcy, within_ms: bench.emcy(emcy, 1e-3 * within_ms),
        {"emcy": _code, "within_ms": _milliseconds},
    ),
    "wait_ms": (lambda bench, wait_ms: bench.pass_time(1e-3 * wait_ms), {"wait_ms": _milliseconds}),
    "ask": (
        lambda bench, ask: bench.require(bench.by_hand(ask), f"it was not done by hand: {ask}"),
        {"ask": lambda _key, text: str(text)},
    ),
}
"""Words of a step: what does it, and what parses each of its keys."""
