"""Rules on SDO: aborts, time-outs, one request at a time, and polling."""

from __future__ import annotations

from canprobe.fieldbus.protocol.sdo import Abort, Place, place_text
from canprobe.fieldbus.tools.judge.bus_frame import BusFrame
from canprobe.fieldbus.tools.judge.enable import enables
from canprobe.fieldbus.tools.judge.events import AbortSeen, AnswerSeen, ControlSeen, RequestSeen
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, Rule, Severity, Watch
from canprobe.fieldbus.tools.judge.seen_node import SeenNode

_SHORT_NS = 50_000_000
"""Time after which a second request may be that of a client that gave the first one up."""


class AbortPassedOver(Rule):
    """A write is aborted, and the drive is enabled all the same."""

    number, name, group, severity = 26, "abort passed over", "sdo", Severity.WRONG
    expected = "an aborted write is repeated, the value is read back, or the axis is not enabled"
    hint = "check the answer to each write"
    answers = True

    def watch(self, node: SeenNode) -> Watch[AbortSeen | AnswerSeen | ControlSeen]:
        aborts: dict[Place, AbortSeen] = {}  # of writes, until the object is written or read
        while event := (yield):
            if isinstance(event, AbortSeen):
                if event.writes and event.place is not None and not event.by_client:
                    aborts[event.place] = event
            elif isinstance(event, AnswerSeen):
                aborts.pop(event.place, None)
            elif enables(event):
                self.looked += 1
                for place, abort in aborts.items():
                    what = f"enables after the write to {place_text(*place)} was aborted with {abort.code:08X}h"
                    self.blame(node, what, abort.request, abort, event)
                aborts.clear()


class PollsEachCycle(Rule):
    """An object is read by SDO in each cycle."""

    number, name, group, severity = 28, "SDO polled each cycle", "sdo", Severity.WRONG
    source = "ros_canopen#380, #259"
    expected = "cyclic values come by TPDO"
    hint = "map the object into a TPDO"
    _WANTED = 50

    def watch(self, node: SeenNode) -> Watch[RequestSeen]:
        last: dict[Place, int] = {}  # number of the SYNC period in which an object was read
        while event := (yield):
            if event.writes or not node.settled or not node.enabled:
                continue
            before, now = last.get(event.place), self.bus.sync_count
            last[event.place] = now
            if before != now and self.in_a_row((node, event.place), before == now - 1, self._WANTED):
                self.blame(node, f"{place_text(*event.place)} was read in {self._WANTED} periods in a row", event)


class TimeoutTooShort(Rule):
    """The client gives up before the node answers."""

    number, name, group, severity = 29, "SDO time-out too short", "sdo", Severity.WRONG
    source = "ros2_canopen#194; canopen-stack#146"
    expected = "a time-out above the time of the node's answers, and a new timer for each request"
    hint = "wait for at least 500 ms, and stop the timer with the answer"
    answers = True
    _STALE_NS = 10_000_000

    def watch(self, node: SeenNode) -> Watch[AbortSeen | AnswerSeen]:
        abort: AbortSeen | None = None
        late_answers = 0  # in a row; two show that the time is too short
        while event := (yield):
            if isinstance(event, AbortSeen):
                if not event.by_client or event.code != Abort.TIMED_OUT or event.request is None:
                    continue
                abort = event
                waited_ns = event.frame.t_ns - event.request.t_ns
                what = f"time-out {waited_ns * 1e-6:.1f} ms after the request"
                self.expect(node, waited_ns >= self._STALE_NS, what, event.request, event)
            elif event.late and abort is not None:
                self.looked += 1
                late_answers += 1
                if late_answers == 2:
                    took_ms = (event.frame.t_ns - event.request.t_ns) * 1e-6
                    what = f"the node answers after {took_ms:.0f} ms, and the client has given up before"
                    self.blame(node, what, event.request, abort, event)
                abort = None
            elif not event.late:
                late_answers = 0


class AbortWithoutObject(Rule):
    """An abort names no object."""

    number, name, group, severity = 30, "abort without index", "sdo", Severity.MINOR
    source = "canopen#409, #516"
    expected = "an abort has index and sub-index of the transfer, which is open"
    hint = "fill in bytes 1 to 3 of the abort, and send none for a transfer that is over"

    def watch(self, node: SeenNode) -> Watch[AbortSeen | AnswerSeen]:
        last: tuple[Place, BusFrame] | None = None  # end of a transfer, which the abort may cross
        while event := (yield):
            over = last
            if event.place is not None:
                last = event.place, event.frame
            if isinstance(event, AnswerSeen) or not event.by_client:
                continue
            if event.place is None and over is None and not node.booted:
                continue
            self.looked += 1
            named = place_text(*event.named)
            if event.place is not None:
                if event.named != event.place:
                    what = f"the abort of the transfer of {place_text(*event.place)} names {named}"
                    self.blame(node, what, event.request, event)
            elif over is None or over[0] != event.named or event.frame.t_ns - over[1].t_ns > QUEUED_NS:
                what = f"an abort that names {named}, and no transfer is open"
                self.blame(node, what, over[1] if over else None, event)


class TwoRequests(Rule):
    """A second request is sent before the first one is answered."""

    number, name, group, severity = 31, "two SDO requests", "sdo", Severity.WRONG
    source = "canopen#143; yarp-devices#159"
    expected = "one transfer at a time on a channel"
    hint = "let one thread use a node's SDO client, or lock it"

    def watch(self, node: SeenNode) -> Watch[RequestSeen]:
        while event := (yield):
            self.looked += 1
            pending = event.pending
            if pending is not None and event.frame.t_ns - pending.t_ns < _SHORT_NS:
                waited_ms = (event.frame.t_ns - pending.t_ns) * 1e-6
                what = f"a second request {waited_ms:.2f} ms after the first, which has no answer"
                self.blame(node, what, pending, event)
