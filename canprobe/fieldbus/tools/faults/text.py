"""Faults as people write them: `node 3: delay ms=2 share=0.5 at 5 s for 200 ms`.

    node N: NAME [k=v …] [at T | on EVENT] [for D]

For a motor that speaks no CANopen it is `motor N`.
T and D have a unit, s, ms or us. Besides the parameters of the kind, k is share (0…1), count (frames, then it is over),
seed, or direction (in, out). Numbers may be hexadecimal, such as 0x1017.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping

from canprobe.errors import UsageError, did_you_mean
from canprobe.fieldbus.tools.faults.fault import DIRECTIONS, ENDLESS_HITS, FOREVER_NS, Fault, FaultKind, Parameter
from canprobe.fieldbus.tools.faults.faulty_node import EVENTS

FORM = "node N: NAME [k=v …] [at T | on EVENT] [for D], such as: node 3: heartbeat-off at 5 s for 200 ms"
_FORM = re.compile(
    r"\s*(?:node|motor)\s+(?P<node>\d+)\s*:\s*(?P<name>[\w-]+)(?P<values>(?:\s+[\w-]+=\S+)*)"
    r"(?:\s+at\s+(?P<at>[\d.eE+-]+)\s*(?P<at_unit>[a-zµ]+)|\s+on\s+(?P<event>[\w-]+))?"
    r"(?:\s+for\s+(?P<long>[\d.eE+-]+)\s*(?P<long_unit>[a-zµ]+))?\s*"
)
_UNITS_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "µs": 1_000}
_COMMON = {
    "share": Parameter(1.0, 0.0, 1.0, "share of the frames that it hits"),
    "count": Parameter(ENDLESS_HITS, 1, ENDLESS_HITS, "number of frames, then it is over"),
    "seed": Parameter(0, 0, 2**63 - 1, "seed of its random choices"),
}


def node_of(text: str) -> int:
    """Node id that a fault names, before it is read; 0 where it names none."""
    match = re.match(r"\s*(?:node|motor)\s+(\d+)", text)
    return int(match[1]) if match else 0


def parse_fault(text: str, kinds: Mapping[str, FaultKind], now_ns: int = 0) -> Fault:
    """Read one fault.

    Args:
        text: the fault.
        kinds: kinds that it may be.
        now_ns: time on the clock of the bus from which `at` counts, and at which a fault without `at` begins.

    Raises:
        UsageError: the text is no fault, or a kind, parameter, value or event is unknown.
    """
    match = _FORM.fullmatch(text)
    if match is None:
        raise UsageError(f"fault {text!r}: expected {FORM}")
    kind = kinds.get(match["name"])
    if kind is None:
        raise UsageError(
            f"fault {text!r}: unknown kind {match['name']!r}{did_you_mean(match['name'], kinds, 0.6)};"
            " `canprobe inject --list` lists them"
        )
    if not 1 <= int(match["node"]) <= 127:
        raise UsageError(f"fault {text!r}: expected a node from 1 to 127, got {match['node']}")
    event = match["event"] or ""
    if event and event not in EVENTS:
        raise UsageError(
            f"fault {text!r}: unknown event {event!r}{did_you_mean(event, EVENTS, 0.6)}; events: {', '.join(EVENTS)}"
        )
    given = dict(word.split("=", 1) for word in match["values"].split())
    incoming = _direction(text, kind, given.pop("direction", None))
    known = {**kind.parameters, **_COMMON}
    values = {name: _number(text, name, value, known) for name, value in given.items()}
    share, count, seed = (values.pop(name, parameter.default) for name, parameter in _COMMON.items())
    start_ns = now_ns + (_time(text, match["at"], match["at_unit"]) if match["at"] else 0)
    lasts_ns = _time(text, match["long"], match["long_unit"]) if match["long"] else kind.lasts_ns
    node_id = int(match["node"])
    return Fault(kind, node_id, start_ns, lasts_ns, values, share, int(count), incoming, int(seed), event)


def _direction(text: str, kind: FaultKind, given: str | None) -> bool | None:
    if given is None:
        return None
    if given not in DIRECTIONS:
        raise UsageError(f"fault {text!r}: expected direction=in or direction=out, got {given!r}")
    if kind.incoming is not None and kind.incoming is not DIRECTIONS[given]:
        raise UsageError(f"fault {text!r}: {kind.name} has its own direction; leave direction= out")
    return DIRECTIONS[given]


def _number(text: str, name: str, value: str, known: Mapping[str, Parameter]) -> float:
    parameter = known.get(name)
    if parameter is None:
        raise UsageError(
            f"fault {text!r}: unknown parameter {name!r}{did_you_mean(name, known, 0.6)};"
            f" it takes {', '.join([*known, 'direction'])}"
        )
    number = math.nan
    for parse in (float, lambda word: int(word, 0)):
        with contextlib.suppress(ValueError):
            number = parse(value)
    if not parameter.low <= number <= parameter.high:
        raise UsageError(
            f"fault {text!r}: {name}: expected {parameter.what}, {parameter.low:g} to {parameter.high:g}, got {value!r}"
        )
    return number


def _time(text: str, number: str, unit: str) -> int:
    try:
        seconds = float(number)
    except ValueError:
        seconds = -1.0
    if unit not in _UNITS_NS or not 0.0 <= seconds * _UNITS_NS.get(unit, 1) < FOREVER_NS:
        raise UsageError(f"fault {text!r}: expected a time such as 5 s or 200 ms, got '{number} {unit}'")
    return round(seconds * _UNITS_NS[unit])
