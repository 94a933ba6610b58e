"""Faults of the services of CiA 301: heartbeat, boot-up, NMT state, SDO server, EMCY, PDO mapping."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.emcy import NO_ERROR_CODE, Emcy
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.sdo import Abort, pack_abort, place_of
from canprobe.fieldbus.tools.faults.fault import Effect, Parameter, error_code, in_ms, numbers
from canprobe.fieldbus.tools.faults.frame_faults import Babble

_BOOT_UP = b"\0"
_TOGGLE_FLAG = 0x10
_SEGMENT_ANSWERS = (0, 1)  # server command specifiers: upload segment, download segment
_INITIATE_ANSWERS = (2, 3)  # initiate upload, initiate download
_INITIATE_REQUESTS = (1, 2, 5, 6)  # client command specifiers: download, upload, block upload, block download
_EXPEDITED_FLAGS = 0x43


class HeartbeatOff(Effect):
    """The heartbeat is not sent; the boot-up message is."""

    name = "heartbeat-off"

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        return () if frame[0] == frames.HEARTBEAT_BASE + self.node.node_id and frame[1] != _BOOT_UP else None


class HeartbeatState(Effect):
    """The heartbeat reports a state in which the node is not."""

    name = "heartbeat-state"
    parameters = numbers(state=Parameter(4, 0, 127, "state: 4 stopped, 127 pre-operational"))

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        if frame[0] != frames.HEARTBEAT_BASE + self.node.node_id or frame[1] == _BOOT_UP:
            return None
        return ((frame[0], bytes((int(self.fault.value("state")),))),)


class NoBootUp(Effect):
    """The boot-up message is not sent."""

    name = "no-boot-up"

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        return () if frame == (frames.HEARTBEAT_BASE + self.node.node_id, _BOOT_UP) else None


class Nmt(Effect):
    """The node changes its NMT state as if commanded, without a command on the bus."""

    name = "nmt"
    parameters = numbers(command=Parameter(2, 1, 130, "command: 2 stop, 128 pre-operational, 129 reset"))

    def begin(self, t_ns: int) -> Sequence[Frame]:
        return self.node.receive(frames.NMT_ID, bytes((int(self.fault.value("command")), self.node.node_id)), t_ns)


class ObjectAborted(Effect):
    """Accesses to one object are aborted."""

    name = "sdo-abort"
    incoming = True
    parameters = numbers(
        index=Parameter(0x1017, 0, 0xFFFF, "index of the object"),
        code=Parameter(Abort.CANNOT_STORE, 0, 0xFFFFFFFF, "abort code"),
    )

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        can_id, data = frame
        if can_id != frames.SDO_RX_BASE + self.node.node_id or len(data) != frames.CLASSIC_BYTES:
            return None
        index, subindex = place_of(data)
        if data[0] >> 5 not in _INITIATE_REQUESTS or index != self.index(data):
            return None
        self.host.say((frames.SDO_TX_BASE + self.node.node_id, pack_abort(index, subindex, self.code)))
        return ()

    def index(self, data: bytes) -> int:
        """Index of the object that is refused."""
        return int(self.fault.value("index"))

    @property
    def code(self) -> int:
        """Abort code."""
        return int(self.fault.value("code"))


class SdoSilent(Effect):
    """SDO requests are not answered."""

    name = "sdo-silent"
    incoming = True

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        return () if frame[0] == frames.SDO_RX_BASE + self.node.node_id else None


class SdoSlow(Effect):
    """SDO answers come late."""

    name = "sdo-slow"
    parameters = numbers(ms=in_ms(100, "delay, ms"))

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        if frame[0] != frames.SDO_TX_BASE + self.node.node_id:
            return None
        return self.delayed(frame, t_ns, self.fault.value("ms"))


class SdoAnswer(Effect):
    """Base class of faults of the default SDO server's answers."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        can_id, data = frame
        if can_id != frames.SDO_TX_BASE + self.node.node_id or len(data) != frames.CLASSIC_BYTES:
            return None
        changed = self.changed(data)
        return None if changed is None else ((can_id, changed),)

    def changed(self, data: bytes) -> bytes | None:
        """The answer that is sent instead; None where it stays as it is."""
        return None


class SdoToggle(SdoAnswer):
    """Segments have the wrong toggle bit."""

    name = "sdo-toggle"

    def changed(self, data: bytes) -> bytes | None:
        return bytes((data[0] ^ _TOGGLE_FLAG,)) + data[1:] if data[0] >> 5 in _SEGMENT_ANSWERS else None


class SdoWrongObject(SdoAnswer):
    """Answers name the index behind the one that was asked for."""

    name = "sdo-wrong-object"

    def changed(self, data: bytes) -> bytes | None:
        index = (place_of(data)[0] + 1) & 0xFFFF
        return data[:1] + index.to_bytes(2, "little") + data[3:] if data[0] >> 5 in _INITIATE_ANSWERS else None


class SdoSize(SdoAnswer):
    """Expedited answers announce a byte too few; one byte becomes four."""

    name = "sdo-size"

    def changed(self, data: bytes) -> bytes | None:
        if data[0] & 0xF3 != _EXPEDITED_FLAGS:
            return None
        unused = (data[0] >> 2 & 3) + 1 & 3
        return bytes((_EXPEDITED_FLAGS | unused << 2,)) + data[1:]


class EmcyOnce(Effect):
    """The node reports an error in EMCY, 1001h and 1003h, and that it is gone at the end of the fault."""

    name = "emcy"
    parameters = numbers(code=error_code(0x5000, "emergency error code"))

    def begin(self, t_ns: int) -> Sequence[Frame]:
        return self.act(t_ns, lambda: self.node.emcy.report(int(self.fault.value("code")), source=self))

    def end(self, t_ns: int) -> Sequence[Frame]:
        return self.act(t_ns, lambda: self.node.emcy.clear(int(self.fault.value("code")), source=self))


class EmcyStorm(Babble):
    """An error comes and goes without an end, whatever the inhibit time."""

    name = "emcy-storm"
    parameters = numbers(
        gap_ms=in_ms(1, "time between two messages, ms"), code=error_code(0x8210, "emergency error code")
    )
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
                self._put(second, first, t_ns)
                return ()
        return None

    def end(self, t_ns: int) -> None:
        if self._exchanged is not None:
            index, first, second = self._exchanged
            if [self.node.dictionary.number(index, sub) for sub in (1, 2)] == [second, first]:
                self._put(first, second, t_ns)

    def _put(self, first: int, second: int, t_ns: int) -> None:
        assert self._exchanged is not None
        for sub, entry in ((1, first), (2, second)):
            self.node.dictionary.put(self._exchanged[0], sub, entry)
        self.node.pdos.reset(t_ns)
