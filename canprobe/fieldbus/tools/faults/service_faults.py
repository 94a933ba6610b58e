"""Faults of the services of CiA 301: heartbeat, boot-up, NMT state, SDO server, EMCY, PDO mapping."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from canprobe.fieldbus.protocol.emcy import NO_ERROR_CODE, Emcy
from canprobe.fieldbus.protocol.frames import (
    CLASSIC_BYTES,
    EMCY_BASE,
    HEARTBEAT_BASE,
    NMT_ID,
    SDO_RX_BASE,
    SDO_TX_BASE,
    Frame,
)
from canprobe.fieldbus.tools.faults.fault import Effect
from canprobe.fieldbus.tools.faults.frame_faults import Babble

_ABORT = struct.Struct("<BHBI")
_BOOT_UP = b"\0"
_TOGGLE_FLAG = 0x10
_SEGMENT_ANSWERS = (0, 1)  # server command specifiers: upload segment, download segment
_INITIATE_ANSWERS = (2, 3)  # initiate upload, initiate download
_INITIATE_REQUESTS = (1, 2, 5, 6)  # client command specifiers: download, upload, block upload, block download
_EXPEDITED_FLAGS = 0x43


class HeartbeatOff(Effect):
    """The heartbeat is not sent; the boot-up message is."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Lose a heartbeat."""
        return () if frame[0] == HEARTBEAT_BASE + self.node.node_id and frame[1] != _BOOT_UP else None


class HeartbeatState(Effect):
    """The heartbeat reports a state in which the node is not."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Change a heartbeat."""
        if frame[0] != HEARTBEAT_BASE + self.node.node_id or frame[1] == _BOOT_UP:
            return None
        return ((frame[0], bytes((int(self.fault.value("state")),))),)


class NoBootUp(Effect):
    """The boot-up message is not sent."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Lose a boot-up message."""
        return () if frame == (HEARTBEAT_BASE + self.node.node_id, _BOOT_UP) else None


class Nmt(Effect):
    """The node changes its NMT state as if commanded, without a command on the bus."""

    def begin(self, t_ns: int) -> Sequence[Frame]:
        """Give the node the command."""
        self.host.hits += 1
        return self.node.receive(NMT_ID, bytes((int(self.fault.value("command")), self.node.node_id)), t_ns)


class SdoAnswer(Effect):
    """Base class of faults of the default SDO server's answers."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Change an answer."""
        can_id, data = frame
        if can_id != SDO_TX_BASE + self.node.node_id or len(data) != CLASSIC_BYTES:
            return None
        changed = self.changed(data)
        return None if changed is None else ((can_id, changed),)

    def changed(self, data: bytes) -> bytes | None:
        """The answer that is sent instead; None where it stays as it is."""
        return None


class ObjectAborted(Effect):
    """Accesses to one object are aborted."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Answer a request for the object in the place of the node."""
        can_id, data = frame
        if can_id != SDO_RX_BASE + self.node.node_id or len(data) != CLASSIC_BYTES:
            return None
        if data[0] >> 5 not in _INITIATE_REQUESTS or int.from_bytes(data[1:3], "little") != self.index(data):
            return None
        self.host.say((SDO_TX_BASE + self.node.node_id, _ABORT.pack(0x80, self.index(data), data[3], self.code)))
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

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Lose a request."""
        return () if frame[0] == SDO_RX_BASE + self.node.node_id else None


class SdoSlow(Effect):
    """SDO answers come late."""

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        """Let an answer wait."""
        if frame[0] != SDO_TX_BASE + self.node.node_id:
            return None
        self.host.later(frame, t_ns + max(1, round(self.fault.value("ms") * 1e6)), incoming=False)
        return ()


class SdoToggle(SdoAnswer):
    """Segments have the wrong toggle bit."""

    def changed(self, data: bytes) -> bytes | None:
        """Turn the bit round."""
        return bytes((data[0] ^ _TOGGLE_FLAG,)) + data[1:] if data[0] >> 5 in _SEGMENT_ANSWERS else None


class SdoWrongObject(SdoAnswer):
    """Answers name another object than the one that was asked for."""

    def changed(self, data: bytes) -> bytes | None:
        """Name the next index."""
        index = (int.from_bytes(data[1:3], "little") + 1) & 0xFFFF
        return data[:1] + index.to_bytes(2, "little") + data[3:] if data[0] >> 5 in _INITIATE_ANSWERS else None


class SdoSize(SdoAnswer):
    """Expedited answers have a byte too few."""

    def changed(self, data: bytes) -> bytes | None:
        """Announce a byte less; one byte becomes four."""
        if data[0] & 0xF3 != _EXPEDITED_FLAGS:
            return None
        unused = (data[0] >> 2 & 3) + 1 & 3
        return bytes((_EXPEDITED_FLAGS | unused << 2,)) + data[1:]


class EmcyOnce(Effect):
    """The node reports an error, and that it is gone at the end of the fault."""

    def begin(self, t_ns: int) -> Sequence[Frame]:
        """Report the error in EMCY, 1001h and 1003h."""
        self.host.hits += 1
        self.node.core.now_ns = t_ns
        self.node.emcy.report(int(self.fault.value("code")), source=self)
        return self.node.advance(t_ns)

    def end(self, t_ns: int) -> Sequence[Frame]:
        """Report that it is gone."""
        self.node.core.now_ns = t_ns
        self.node.emcy.clear(int(self.fault.value("code")), source=self)
        return self.node.advance(t_ns)


class EmcyStorm(Babble):
    """An error comes and goes without an end, whatever the inhibit time."""

    _present = False

    def made(self) -> Frame:
        """The error, or its end."""
        self._present = not self._present
        code = int(self.fault.value("code")) if self._present else NO_ERROR_CODE
        return EMCY_BASE + self.node.node_id, Emcy(code, 0x11 if self._present else 0).pack()


class Remapped(Effect):
    """The first two entries of the first TPDO that has two are exchanged, in the frames and in 1Axxh."""

    _exchanged: tuple[int, int, int] | None = None

    def begin(self, t_ns: int) -> Sequence[Frame]:
        """Exchange them."""
        dictionary = self.node.dictionary
        for index in dictionary.indices_in(range(0x1A00, 0x1C00)):
            if dictionary.number(index) >= 2:
                self.host.hits += 1
                first, second = dictionary.number(index, 1), dictionary.number(index, 2)
                self._exchanged = index, first, second
                self._put(second, first, t_ns)
                break
        return ()

    def end(self, t_ns: int) -> Sequence[Frame]:
        """Exchange them back, unless somebody has mapped anew."""
        if self._exchanged is not None:
            index, first, second = self._exchanged
            if [self.node.dictionary.number(index, sub) for sub in (1, 2)] == [second, first]:
                self._put(first, second, t_ns)
        return ()

    def _put(self, first: int, second: int, t_ns: int) -> None:
        assert self._exchanged is not None
        for sub, entry in ((1, first), (2, second)):
            self.node.dictionary.put(self._exchanged[0], sub, entry)
        self.node.pdos.reset(t_ns)
