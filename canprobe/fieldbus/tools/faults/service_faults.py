"""Faults of the services of CiA 301: heartbeat, boot-up, NMT state, SDO server, EMCY, PDO mapping."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.emcy import NO_ERROR_CODE, Emcy
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.sdo import pack_abort, place_of
from canprobe.fieldbus.tools.faults.fault import Effect
from canprobe.fieldbus.tools.faults.frame_faults import Babble, FrameFault

_TOGGLE_FLAG = 0x10
_SEGMENT_ANSWERS = (0, 1)  # server command specifiers: upload segment, download segment
_INITIATE_ANSWERS = (2, 3)  # initiate upload, initiate download
_INITIATE_REQUESTS = (1, 2, 5, 6)  # client command specifiers: download, upload, block upload, block download
_EXPEDITED_FLAGS = 0x43


class HeartbeatState(FrameFault):
    """The heartbeat reports a state in which the node is not."""

    name = "heartbeat-state"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame]:
        return ((frame[0], bytes((int(self.fault.value("state")),))),)


class Nmt(Effect):
    """The node changes its NMT state as if commanded, without a command on the bus."""

    name = "nmt"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        return self.node.receive(frames.NMT_ID, bytes((int(self.fault.value("command")), self.node.node_id)), t_ns)


class ObjectAborted(FrameFault):
    """Accesses to one object are aborted."""

    name = "sdo-abort"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        data = frame[1]
        index, subindex = place_of(data)
        if data[0] >> 5 not in _INITIATE_REQUESTS or index != self.index(data):
            return None
        self.host.said.append((frames.SDO_TX_BASE + self.node.node_id, pack_abort(index, subindex, self.code)))
        return ()

    def index(self, data: bytes) -> int:
        """Index of the object that is refused."""
        return int(self.fault.value("index"))

    @property
    def code(self) -> int:
        """Abort code."""
        return int(self.fault.value("code"))


class SdoToggle(FrameFault):
    """Segments have the wrong toggle bit."""

    name = "sdo-toggle"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        can_id, data = frame
        return ((can_id, bytes((data[0] ^ _TOGGLE_FLAG,)) + data[1:]),) if data[0] >> 5 in _SEGMENT_ANSWERS else None


class SdoWrongObject(FrameFault):
    """Answers name the index behind the one that was asked for."""

    name = "sdo-wrong-object"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        can_id, data = frame
        index = (place_of(data)[0] + 1 & 0xFFFF).to_bytes(2, "little")
        return ((can_id, data[:1] + index + data[3:]),) if data[0] >> 5 in _INITIATE_ANSWERS else None


class SdoSize(FrameFault):
    """Expedited answers announce a byte too few; one byte becomes four."""

    name = "sdo-size"

    def changed(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        can_id, data = frame
        if data[0] & 0xF3 != _EXPEDITED_FLAGS:
            return None
        unused = (data[0] >> 2 & 3) + 1 & 3
        return ((can_id, bytes((_EXPEDITED_FLAGS | unused << 2,)) + data[1:]),)


class EmcyOnce(Effect):
    """The node reports an error in EMCY, 1001h and 1003h, and that it is gone at the end of the fault."""

    name = "emcy"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        return self.act(t_ns, lambda: self.node.emcy.report(int(self.fault.value("code")), source=self))

    def end(self, t_ns: int) -> Sequence[Frame]:
        return self.act(t_ns, lambda: self.node.emcy.clear(int(self.fault.value("code")), source=self))


class EmcyStorm(Babble):
    """An error comes and goes without an end, whatever the inhibit time."""

    name = "emcy-storm"
    _present = False

    def made(self) -> Frame:
        self._present = not self._present
        code = int(self.fault.value("code")) if self._present else NO_ERROR_CODE
        return frames.EMCY_BASE + self.node.node_id, Emcy(code, 0x11 if self._present else 0).pack()


class Remapped(Effect):
    """The first two entries of the first TPDO that has two are exchanged, in the frames and in 1Axxh.

    At the end they are exchanged back, unless somebody has mapped anew.
    """

    name = "remapped"
    _exchanged: tuple[int, int, int] | None = None

    def begin(self, t_ns: int) -> Sequence[Frame] | None:
        dictionary = self.node.dictionary
        for index in dictionary.indices_in(range(0x1A00, 0x1C00)):
            if dictionary.number(index) >= 2:
                first, second = dictionary.number(index, 1), dictionary.number(index, 2)
                self._exchanged = index, first, second
                self._put(index, second, first, t_ns)
                return ()
        return None

    def end(self, t_ns: int) -> None:
        if self._exchanged is not None:
            index, first, second = self._exchanged
            if [self.node.dictionary.number(index, sub) for sub in (1, 2)] == [second, first]:
                self._put(index, first, second, t_ns)

    def _put(self, index: int, first: int, second: int, t_ns: int) -> None:
        for sub, entry in ((1, first), (2, second)):
            self.node.dictionary.put(index, sub, entry)
        self.node.pdos.reset(t_ns)
