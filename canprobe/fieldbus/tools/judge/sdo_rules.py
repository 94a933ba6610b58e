"""Rules on SDO: aborts, time-outs, one request at a time, and polling."""

from __future__ import annotations

from canprobe.fieldbus.protocol.sdo import Abort, Place, place_text
from canprobe.fieldbus.tools.judge import events
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import enables
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, Case, Watch, rule
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_SHORT_NS = 50_000_000
"""Time after which a second request may be that of a client that gave the first one up."""
_POLLED_PERIODS = 50
"""Periods of SYNC in a row with a read of one object that are polling."""
_STALE_NS = 10_000_000
"""Waiting time below which a time-out is that of another request."""


@rule(26, answers=True)
def abort_passed_over(case: Case, node: SeenNode) -> Watch[events.AbortSeen | events.AnswerSeen | events.ControlSeen]:
    """A write is aborted, and the drive is enabled all the same."""
    aborts: dict[Place, events.AbortSeen] = {}  # of writes, until the object is written or read
    while event := (yield):
        if isinstance(event, events.AbortSeen):
            if event.writes and event.place is not None and not event.by_client:
                aborts[event.place] = event
        elif isinstance(event, events.AnswerSeen):
            aborts.pop(event.place, None)
        elif enables(event):
            case.looked += 1
            for place, abort in aborts.items():
                what = f"enables after the write to {place_text(*place)} was aborted with {abort.code:08X}h"
                case.blame(node, what, abort.request, abort, event)
            aborts.clear()


@rule(28)
def polls_each_cycle(case: Case, node: SeenNode) -> Watch[events.RequestSeen]:
    """An object is read by SDO in each cycle."""
    last: dict[Place, int] = {}  # number of the SYNC period in which an object was read
    while event := (yield):
        if event.writes or not node.settled or not node.enabled:
            continue
        before, now = last.get(event.place), case.bus.sync_count
        last[event.place] = now
        if before != now and case.in_a_row((node, event.place), before == now - 1, _POLLED_PERIODS):
            case.blame(node, f"{place_text(*event.place)} was read in {_POLLED_PERIODS} periods in a row", event)


@rule(29, answers=True)
def timeout_too_short(case: Case, node: SeenNode) -> Watch[events.AbortSeen | events.AnswerSeen]:
    """The client gives up before the node answers."""
    abort: events.AbortSeen | None = None
    late_answers = 0  # in a row; two show that the time is too short
    while event := (yield):
        if isinstance(event, events.AbortSeen):
            if not event.by_client or event.code != Abort.TIMED_OUT or event.request is None:
                continue
            abort = event
            waited_ns = event.frame.t_ns - event.request.t_ns
            what = f"time-out {waited_ns * 1e-6:.1f} ms after the request"
            case.expect(node, waited_ns >= _STALE_NS, what, event.request, event)
        elif event.late and abort is not None:
            case.looked += 1
            late_answers += 1
            if late_answers == 2:
                took_ms = (event.frame.t_ns - event.request.t_ns) * 1e-6
                what = f"the node answers after {took_ms:.0f} ms, and the client has given up before"
                case.blame(node, what, event.request, abort, event)
            abort = None
        elif not event.late:
            late_answers = 0


@rule(30)
def abort_without_object(case: Case, node: SeenNode) -> Watch[events.AbortSeen | events.AnswerSeen]:
    """An abort names no object."""
    last: tuple[Place, BusFrame] | None = None  # end of a transfer, which the abort may cross
    while event := (yield):
        over = last
        if event.place is not None:
            last = event.place, event.frame
        if isinstance(event, events.AnswerSeen) or not event.by_client:
            continue
        if event.place is None and over is None and not node.booted:
            continue
        case.looked += 1
        named = place_text(*event.named)
        if event.place is not None:
            if event.named != event.place:
                what = f"the abort of the transfer of {place_text(*event.place)} names {named}"
                case.blame(node, what, event.request, event)
        elif over is None or over[0] != event.named or event.frame.t_ns - over[1].t_ns > QUEUED_NS:
            case.blame(node, f"an abort that names {named}, and no transfer is open", over[1] if over else None, event)


@rule(31)
def two_requests(case: Case, node: SeenNode) -> Watch[events.RequestSeen]:
    """A second request is sent before the first one is answered."""
    while event := (yield):
        case.looked += 1
        pending = event.pending
        if pending is not None and event.frame.t_ns - pending.t_ns < _SHORT_NS:
            waited_ms = (event.frame.t_ns - pending.t_ns) * 1e-6
            what = f"a second request {waited_ms:.2f} ms after the first, which has no answer"
            case.blame(node, what, pending, event)
