"""Rules on SDO: aborts, time-outs, one request at a time, and polling."""

from __future__ import annotations

from canprobe.fieldbus.tools.judge.bus_frame import BusFrame, Place, place_text
from canprobe.fieldbus.tools.judge.enable import enables
from canprobe.fieldbus.tools.judge.events import AbortSeen, AnswerSeen, BusEvent, ControlSeen, RequestSeen
from canprobe.fieldbus.tools.judge.rule import QUEUED_NS, Rule, Severity

_TIMED_OUT = 0x05040000
_SHORT_NS = 50_000_000
"""Time after which a second request may be that of a client that gave the first one up."""


class AbortPassedOver(Rule):
    """A write is aborted, and the drive is enabled all the same."""

    number, name, group, severity = 26, "abort passed over", "sdo", Severity.WRONG
    expected = "an aborted write is repeated, the value is read back, or the axis is not enabled"
    hint = "check the answer to each write"
    hears = (AbortSeen, AnswerSeen, ControlSeen)
    answers = True

    def begin(self) -> None:
        """Remember nothing yet."""
        self._open: dict[tuple[int, tuple[int, int]], AbortSeen] = {}

    def see(self, event: BusEvent) -> None:
        """Keep aborted writes until the object is written or read, and look at them at enabling."""
        if isinstance(event, AbortSeen):
            if event.writes and event.place is not None and not event.by_client:
                self._open[event.node.node_id, event.place] = event
        elif isinstance(event, AnswerSeen):
            self._open.pop((event.node.node_id, event.place), None)
        elif isinstance(event, ControlSeen) and enables(event):
            self.looked += 1
            node_id = event.node.node_id
            for key in [key for key in self._open if key[0] == node_id]:
                abort = self._open.pop(key)
                what = f"enables after the write to {place_text(key[1])} was aborted with {abort.code:08X}h"
                self.blame(what, abort.request, abort.frame, event.frame, node_id=node_id)


class PollsEachCycle(Rule):
    """An object is read by SDO in each cycle."""

    number, name, group, severity = 28, "SDO polled each cycle", "sdo", Severity.WRONG
    source = "ros_canopen#380, #259"
    expected = "cyclic values come by TPDO"
    hint = "map the object into a TPDO"
    hears = (RequestSeen,)
    _WANTED = 50

    def begin(self) -> None:
        """Remember nothing yet."""
        self._last: dict[tuple[int, int, int], int] = {}

    def see(self, event: BusEvent) -> None:
        """Count SYNC periods in a row with a read of the same object."""
        assert isinstance(event, RequestSeen)
        node = event.node
        if event.writes or not node.settled or not node.enabled:
            return
        key = (node.node_id, *event.place)
        before, now = self._last.get(key), self.bus.sync_count
        self._last[key] = now
        if before != now and self.in_a_row(key, before == now - 1, self._WANTED):
            what = f"{place_text(event.place)} was read in {self._WANTED} periods in a row"
            self.blame(what, event.frame, node_id=node.node_id)


class TimeoutTooShort(Rule):
    """The client gives up before the node answers."""

    number, name, group, severity = 29, "SDO time-out too short", "sdo", Severity.WRONG
    source = "ros2_canopen#194; canopen-stack#146"
    expected = "a time-out above the time of the node's answers, and a new timer for each request"
    hint = "wait for at least 500 ms, and stop the timer with the answer"
    hears = (AbortSeen, AnswerSeen)
    answers = True
    _STALE_NS = 10_000_000

    def begin(self) -> None:
        """Remember nothing yet."""
        self._aborts: dict[int, AbortSeen] = {}

    def see(self, event: BusEvent) -> None:
        """An abort that comes at once is stale; two answers after an abort show that the time is too short."""
        assert isinstance(event, AbortSeen | AnswerSeen)
        node_id = event.node.node_id
        if isinstance(event, AbortSeen):
            if not event.by_client or event.code != _TIMED_OUT or event.request is None:
                return
            self._aborts[node_id] = event
            waited_ns = event.frame.t_ns - event.request.t_ns
            self.looked += 1
            if waited_ns < self._STALE_NS:
                what = f"time-out {waited_ns * 1e-6:.1f} ms after the request"
                self.blame(what, event.request, event.frame, node_id=node_id)
        elif event.late and (abort := self._aborts.pop(node_id, None)) is not None:
            if self.in_a_row(node_id, True):
                took_ns = event.frame.t_ns - event.request.t_ns
                what = f"the node answers after {took_ns * 1e-6:.0f} ms, and the client has given up before"
                self.blame(what, event.request, abort.frame, event.frame, node_id=node_id)
        elif not event.late:
            self._runs[node_id] = 0


class AbortWithoutObject(Rule):
    """An abort names no object."""

    number, name, group, severity = 30, "abort without index", "sdo", Severity.MINOR
    source = "canopen#409, #516"
    expected = "an abort has index and sub-index of the transfer, which is open"
    hint = "fill in bytes 1 to 3 of the abort, and send none for a transfer that is over"
    hears = (AbortSeen, AnswerSeen)

    def begin(self) -> None:
        """Remember nothing yet."""
        self._over: dict[int, tuple[Place, BusFrame]] = {}

    def see(self, event: BusEvent) -> None:
        """Compare the object in a client's abort with that of the transfer; an abort may cross the last answer."""
        assert isinstance(event, AbortSeen | AnswerSeen)
        node_id, over = event.node.node_id, self._over.get(event.node.node_id)
        if event.place is not None:
            self._over[node_id] = event.place, event.frame
        if (
            isinstance(event, AnswerSeen)
            or not event.by_client
            or (event.place is None and not over and not event.node.booted)
        ):
            return
        self.looked += 1
        named = place_text(event.named)
        if event.place is not None and event.named != event.place:
            what = f"the abort of the transfer of {place_text(event.place)} names {named}"
            self.blame(what, event.request, event.frame, node_id=node_id)
        elif event.place is None and (
            over is None or over[0] != event.named or event.frame.t_ns - over[1].t_ns > QUEUED_NS
        ):
            what = f"an abort that names {named}, and no transfer is open"
            self.blame(what, over[1] if over else None, event.frame, node_id=node_id)


class TwoRequests(Rule):
    """A second request is sent before the first one is answered."""

    number, name, group, severity = 31, "two SDO requests", "sdo", Severity.WRONG
    source = "canopen#143; yarp-devices#159"
    expected = "one transfer at a time on a channel"
    hint = "let one thread use a node's SDO client, or lock it"
    hears = (RequestSeen,)

    def see(self, event: BusEvent) -> None:
        """Look for a young request without an answer."""
        assert isinstance(event, RequestSeen)
        self.looked += 1
        pending: BusFrame | None = event.pending
        if pending is not None and event.frame.t_ns - pending.t_ns < _SHORT_NS:
            waited = (event.frame.t_ns - pending.t_ns) * 1e-6
            what = f"a second request {waited:.2f} ms after the first, which has no answer"
            self.blame(what, pending, event.frame, node_id=event.node.node_id)


SDO_RULES: tuple[type[Rule], ...] = (
    AbortPassedOver,
    PollsEachCycle,
    TimeoutTooShort,
    AbortWithoutObject,
    TwoRequests,
)
