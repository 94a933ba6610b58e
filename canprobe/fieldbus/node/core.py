"""State that the services of one node share: identity, NMT state, time, dictionary, timers and frames to send."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.node.dictionary import Dictionary, Value
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.node.timers import Holder, Timers
from canprobe.fieldbus.protocol.frames import INVALID_FLAG, Frame, NmtState, is_restricted
from canprobe.fieldbus.protocol.pdo import NO_RTR_FLAG, PDO_OBJECTS, TPDOS, is_mapping
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

Route = Callable[[bytes, int], None]
BOOTED_STATES = frozenset(NmtState) - {NmtState.INITIALISING}
TALKING_STATES = frozenset({NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL})
"""States with SDO, SYNC and EMCY."""


class NodeCore:
    """State that the services of one node share; the node itself changes it.

    Args:
        node_id: node id, 1–127, or 255 for none.
        dictionary: the node's dictionary.
        holder: object that shows the next deadline of the timers.
        quirks: difficulties of the node.

    Attributes:
        state: NMT state.
        now_ns: time of the event being served.
        out: frames to send, in order.
        reroute: function that a service calls when its routes have changed.
    """

    def __init__(self, node_id: int, dictionary: Dictionary, holder: Holder, quirks: Quirks) -> None:
        self.node_id = node_id
        self.dictionary = dictionary
        self.quirks = quirks
        _refuse(dictionary, quirks)
        self.timers = Timers(holder)
        self.state = NmtState.INITIALISING
        self.now_ns = 0
        self.out: list[Frame] = []
        self.reroute: Callable[[], None] = nothing

    def send(self, can_id: int, data: bytes) -> None:
        """Queue a frame behind those that the node already sends."""
        self.out.append((can_id, data))


def _refuse(dictionary: Dictionary, quirks: Quirks) -> None:
    """Add the checks of a node that refuses writes, before any other check."""

    def refuse(code: Abort, only: int | None, subindex: int, value: Value) -> None:
        if only in (None, subindex):
            raise SdoAbort(code)

    def keep_bit30(index: int, subindex: int, value: Value) -> None:
        if subindex == 1 and (int(value) ^ dictionary.number(index, 1)) & NO_RTR_FLAG:
            raise SdoAbort(Abort.VALUE)

    for index in quirks.refuse:
        dictionary.on_check(index, partial(refuse, Abort.UNSUPPORTED_ACCESS, None))
    for index in dictionary.indices_in(PDO_OBJECTS) if quirks.fixed_mapping else ():
        dictionary.on_check(index, partial(refuse, Abort.READ_ONLY, None if is_mapping(index) else 1))
    for index in dictionary.indices_in(TPDOS) if quirks.keep_bit30 else ():
        dictionary.on_check(index, partial(keep_bit30, index))


class DelayedFrames:
    """Frames of a node that is slow: each leaves some time after it was made.

    Args:
        core: the node's core.
        delay_ns: time from the making of a frame until it leaves; 0: it leaves at once.
    """

    def __init__(self, core: NodeCore, delay_ns: int) -> None:
        self._core, self._delay_ns = core, delay_ns
        self._waiting: deque[tuple[int, Sequence[Frame]]] = deque()  # when they leave, and the frames
        self._timer = core.timers.new(self._leave)

    def send(self, frames: Sequence[Frame], t_ns: int) -> None:
        """Send frames that were made at `t_ns`."""
        if not self._delay_ns:
            self._core.out += frames
            return
        self._waiting.append((t_ns + self._delay_ns, frames))
        self._timer.arm(self._waiting[0][0])

    def clear(self) -> None:
        """Forget the frames that wait."""
        self._waiting.clear()
        self._timer.cancel()

    def _leave(self, due_ns: int) -> None:
        while self._waiting and self._waiting[0][0] <= due_ns:
            self._core.out += self._waiting.popleft()[1]
        if self._waiting:
            self._timer.arm(self._waiting[0][0])


class Service:
    """One CiA 301 service of a node. The base class has no state and no routes.

    Attributes:
        states: NMT states in which the node receives its routes.
    """

    states = BOOTED_STATES

    def reset(self, t_ns: int) -> None:
        """Forget everything and read the parameters again; the dictionary holds its defaults."""

    def entered(self, t_ns: int) -> None:
        """Act on the new NMT state, which is `core.state`."""

    def routes(self) -> Mapping[int, Route]:
        """Receivers by CAN-ID."""
        return {}


def check_cob_id(new: Value, old: int, reserved: int = 0x3FFFF800) -> None:
    """Check a new COB-ID. Raises SdoAbort for reserved bits, 29 bits, a restricted identifier, or a change while valid.

    Source: CiA 301, objects 1014h, 1200h, 1400h, 1800h, "Restricted CAN-IDs".
    """
    word = int(new)
    changed_while_valid = not (word | old) & INVALID_FLAG and (word ^ old) & 0x7FF
    if word & reserved or changed_while_valid or (not word & INVALID_FLAG and is_restricted(word & 0x7FF)):
        raise SdoAbort(Abort.VALUE)
