"""Tactile frames as they are on the wire, in PDO order, and their PDOs put together again.

Every frame begins with the same 8 bytes, little-endian:

    byte 0  frame counter, +1 a frame, mod 256        byte 3     flags: bits 0..1 mode, 2 overload, 4..7 window
    byte 1  SYNC counter of the trigger (0: none)     bytes 4..5 sample age in µs: trigger SYNC minus sample time
    byte 2  window origin, row << 4 | column          bytes 6..7 CRC-16 over bytes 0..5 and all payload after

In features mode byte 2 is the peak taxel instead: features have no window. The flags' window is the number of taxels
along it, 0 for 8 and outside window mode; bit 3 is 0. Then follow, by mode, window: its taxels row by row, 8 to a
payload, zeros behind the last one (of 8×8 taxels: 8 payloads, a row each); image: all taxels in the same way (of 16×16:
32 payloads, the left then the right half of each row); lowest byte = lowest column. Features: one payload, a 64-bit
little-endian word from its least significant bit upward:

    field   bits  scale         range, saturating          field   bits  scale          range, saturating
    force   12    1/400 N       0..10.2375 N               var_rr  10    1/64 taxel²    0..15.98 taxel²
    row     11    1/128 taxel   0..15.992                  var_rc  10    1/64 taxel²    −8..7.98 taxel² (signed)
    col     11    1/128 taxel   0..15.992                  var_cc  10    1/64 taxel²    0..15.98 taxel²

One step of the centroid is 1/128 of the pitch and half a step the largest error inside the ranges.
"""

from __future__ import annotations

import binascii
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from canprobe.errors import ProtocolError

MAX_SIDE = 16
"""Most rows and columns of an array: the header names a taxel in 8 bits."""
Shape = tuple[int, int]
"""Rows and columns of an array."""
DEFAULT_WINDOW = 8
"""Taxels along the window of a sensor that has no other."""
WINDOW_SIZES = (4, 6, 8, 10, 12)
"""Taxels along the window that a sensor can be set to."""
_FORM = struct.Struct("<BBBBHH")
_OVERLOAD_FLAG = 0x04
_FORCE_SCALE, _CENTROID_SCALE, _MOMENT_SCALE = 400.0, 128.0, 64.0

# bits, signed, scale, in the order of the wire
_FEATURE_FIELDS = (
    (12, False, _FORCE_SCALE),
    (11, False, _CENTROID_SCALE),
    (11, False, _CENTROID_SCALE),
    (10, False, _MOMENT_SCALE),
    (10, True, _MOMENT_SCALE),
    (10, False, _MOMENT_SCALE),
)


class TactileMode(IntEnum):
    """Contents of a frame, object 2000h."""

    FEATURES = 0
    WINDOW = 1
    IMAGE = 2


def image_words(taxels: int) -> int:
    """Number of payloads of 8 taxels for so many taxels."""
    return -(-taxels // 8)


def window_words(side: int) -> int:
    """Number of payloads of 8 taxels for a window of side × side taxels."""
    return image_words(side * side)


def crc16_ccitt(data: bytes, crc: int = 0) -> int:
    """CRC-16 with the CCITT polynomial 1021h, initial value 0, not reflected: that of SDO block transfers.

    Up to three flipped bits, and any burst of 16, are always found. Check value of b"123456789": 31C3h.
    Source: CiA 301 (SDO block transfer); catalogued as CRC-16/XMODEM.
    """
    return binascii.crc_hqx(data, crc)


@dataclass(frozen=True, slots=True)
class TactileHeader:
    """First payload of every tactile frame.

    Attributes:
        frame_counter: 0..255.
        sync_counter: SYNC counter of the trigger, 1..240; 0 without a counter.
        origin_row, origin_col: first taxel of the window in the full pad; in features mode together the peak.
        mode: kind of the payloads that follow.
        overload: whether a taxel reached full scale.
        sample_age_us: trigger SYNC minus sample time, µs; 65535 means that or more.
        crc: CRC over the six bytes before it and the payloads after it; `pack_whole` computes it.
        window: number of taxels along the window.
    """

    frame_counter: int
    sync_counter: int
    origin_row: int
    origin_col: int
    mode: TactileMode
    overload: bool
    sample_age_us: int
    crc: int = 0
    window: int = DEFAULT_WINDOW

    @property
    def peak(self) -> int:
        """Byte 2 as features mode reads it: the highest taxel, counts."""
        return self.origin_row << 4 | self.origin_col

    def pack(self) -> bytes:
        """Pack into 8 bytes.

        Raises:
            ProtocolError: a field does not fit.
        """
        return self._packed(self.crc)

    def start(self) -> bytes:
        """The 6 bytes before the CRC, which it covers first.

        Raises:
            ProtocolError: a field does not fit.
        """
        return self._packed(0)[:6]

    def _packed(self, crc: int) -> bytes:
        if not (0 <= self.origin_row < MAX_SIDE and 0 <= self.origin_col < MAX_SIDE):
            raise ProtocolError(f"tactile header: window origin ({self.origin_row}, {self.origin_col}) is off the pad")
        size = self.window << 4 if self.mode is TactileMode.WINDOW and self.window != DEFAULT_WINDOW else 0
        flags = self.mode | (_OVERLOAD_FLAG if self.overload else 0) | size
        peak = self.origin_row << 4 | self.origin_col
        try:
            return _FORM.pack(self.frame_counter, self.sync_counter, peak, flags, self.sample_age_us, crc)
        except struct.error as error:
            raise ProtocolError(f"tactile header: {error} in {self}") from None

    @classmethod
    def unpack(cls, data: bytes) -> TactileHeader:
        """Unpack exactly 8 bytes.

        Raises:
            ProtocolError: the length, the flags or the mode are wrong, or the window leaves the pad.
        """
        if len(data) != _FORM.size:
            raise ProtocolError(f"tactile header: expected 8 bytes, got {len(data)}")
        counter, sync, origin, flags, age, crc = _FORM.unpack(data)
        if (read := _FLAG_MEANINGS.get(flags)) is None:
            raise ProtocolError(f"tactile header: reserved flags {flags:#04x}")
        header = cls(
            counter, sync, origin >> 4, origin & 0x0F, read[0], bool(flags & _OVERLOAD_FLAG), age, crc, read[1]
        )
        check_origin(header, (MAX_SIDE, MAX_SIDE))
        return header


_FLAG_MEANINGS = {
    mode | overload: (mode, DEFAULT_WINDOW) for mode in TactileMode for overload in (0, _OVERLOAD_FLAG)
} | {
    TactileMode.WINDOW | overload | side << 4: (TactileMode.WINDOW, side)
    for side in WINDOW_SIZES
    if side != DEFAULT_WINDOW
    for overload in (0, _OVERLOAD_FLAG)
}
"""Mode and taxels along the window, by byte 3."""


_LAST_ORIGINS = {TactileMode.FEATURES: MAX_SIDE - 1, TactileMode.IMAGE: 0}


def check_origin(header: TactileHeader, shape: Shape) -> None:
    if header.window not in WINDOW_SIZES:
        raise ProtocolError(
            f"tactile header: a window has {', '.join(map(str, WINDOW_SIZES))} taxels, not {header.window}"
        )
    last = (_LAST_ORIGINS.get(header.mode, 0),) * 2
    if header.mode is TactileMode.WINDOW:
        last = (shape[0] - header.window, shape[1] - header.window)
    if header.origin_row > last[0] or header.origin_col > last[1]:
        origin = (header.origin_row, header.origin_col)
        raise ProtocolError(f"tactile header: {header.mode.name.lower()} cannot begin at taxel {origin}")


@dataclass(frozen=True, slots=True)
class Features:
    """Contact features computed by the sensor.

    Attributes:
        force_n: sum of the force over the pad, N.
        row, col: centroid in taxels of the full pad, from 0 (7.5 is the middle of 16).
        var_rr, var_rc, var_cc: central second moments, taxel².
        peak: highest taxel, counts 0..255.
    """

    force_n: float
    row: float
    col: float
    var_rr: float
    var_rc: float
    var_cc: float
    peak: int = 0

    def pack(self) -> bytes:
        """The 8 bytes after the header; values beyond a range saturate at its end (module text).

        Raises:
            ProtocolError: a value is not a number.
        """
        word = shift = 0
        values = (self.force_n, self.row, self.col, self.var_rr, self.var_rc, self.var_cc)
        for value, (bits, signed, scale) in zip(values, _FEATURE_FIELDS, strict=True):
            if math.isnan(value):
                raise ProtocolError(f"features: not a number in {self}")
            lowest = -(1 << bits - 1) if signed else 0
            code = round(min(max(value * scale, lowest), lowest + (1 << bits) - 1))
            word |= (code & (1 << bits) - 1) << shift
            shift += bits
        return word.to_bytes(8, "little")

    @classmethod
    def unpack(cls, data: bytes, peak: int = 0) -> Features:
        """Unpack exactly 8 bytes; the peak comes from the header.

        Raises:
            ProtocolError: the data have another length.
        """
        if len(data) != 8:
            raise ProtocolError(f"features: expected 8 bytes, got {len(data)}")
        word, values = int.from_bytes(data, "little"), []
        for bits, signed, scale in _FEATURE_FIELDS:
            code = word & (1 << bits) - 1
            word >>= bits
            values.append((code - (1 << bits) if signed and code >> bits - 1 else code) / scale)
        force_n, row, col, var_rr, var_rc, var_cc = values
        return cls(force_n, row, col, var_rr, var_rc, var_cc, peak)


def pack_whole(header: TactileHeader, content: bytes | Features) -> bytes:
    """Pack a whole tactile frame into one string: its payloads of 8 bytes, in PDO order, with the CRC set.

    Args:
        header: the header; its crc is ignored, in features mode its origin too, as the peak takes that byte.
        content: one byte for each taxel of the window or the whole image, row by row; or features.

    Raises:
        ProtocolError: the content is not that of the mode, or a field does not fit.
    """
    if isinstance(content, Features) is not (header.mode is TactileMode.FEATURES):
        what = "features" if isinstance(content, Features) else "taxels"
        raise ProtocolError(f"{what} given to a frame of mode {header.mode.name}")
    if isinstance(content, Features):
        if not 0 <= content.peak <= 255:
            raise ProtocolError(f"features: peak {content.peak} is not 0..255")
        header = replace(header, origin_row=content.peak >> 4, origin_col=content.peak & 0x0F)
        body = content.pack()
    else:
        expected = header.window**2 if header.mode is TactileMode.WINDOW else len(content)
        if len(content) != expected or not content:
            raise ProtocolError(f"taxels: expected {expected or 'those of an image'}, got {len(content)}")
        body = content + bytes(-len(content) % 8)
    check_origin(header, (MAX_SIDE, MAX_SIDE))
    start = header.start()
    return start + crc16_ccitt(body, crc16_ccitt(start)).to_bytes(2, "little") + body


@dataclass(frozen=True, slots=True)
class TactileMessage:
    """One complete, checked tactile frame as it stood on the wire.

    Attributes:
        header: the header as received.
        body: bytes behind the header: taxels row by row, filled up with zeros to a multiple of 8 bytes; or features.
        t_ns: arrival of the header.
    """

    header: TactileHeader
    body: bytes
    t_ns: int

    @property
    def features(self) -> Features | None:
        """Contact features, in features mode only."""
        return Features.unpack(self.body, self.header.peak) if self.header.mode is TactileMode.FEATURES else None


class FrameAssembler:
    """Collects one sensor's PDOs; `push` returns a frame when its last PDO arrives and the CRC matches.

    A frame opens at a header and takes each expected COB-ID exactly once, in any order. A new header, a duplicate or
    the deadline before it is complete tears the frame, which is dropped.

    Attributes:
        shape: rows and columns of the array.
        frames: number of frames that were returned.
        torn: number of frames that were opened and dropped incomplete.
        crc_errors: number of complete frames with a wrong CRC: corrupted, or mixed from two triggers where a header was
            lost.
        duplicates: number of taxel PDOs that came twice, and of complete frames with the counter of the one before.
        lost: number of frames of the sensor that were not returned, from gaps of the frame counter (mod 256).
        orphans: number of taxel PDOs without an open frame.
        malformed: number of PDOs of a wrong length, of headers without a meaning, of frames of another mode or window.
    """

    __slots__ = (
        "_deadline_ns", "_last", "_missing", "_mode", "_opened_ns", "_parts", "_sizes", "_slots", "_window",
        "crc_errors", "duplicates", "frames", "lost", "malformed", "orphans", "shape", "torn",
    )  # fmt: skip

    def __init__(
        self,
        cob_ids: Sequence[int],
        mode: TactileMode,
        deadline_ns: int,
        sizes: Sequence[int] | None = None,
        *,
        window: int = DEFAULT_WINDOW,
        shape: Shape = (MAX_SIDE, MAX_SIDE),
    ) -> None:
        """Make an assembler for the given identifiers.

        Args:
            cob_ids: identifiers of the header and then of the payloads, in PDO order.
            mode: mode of the sensor.
            deadline_ns: longest time from the header to the last PDO; two cycles as a rule.
            sizes: number of bytes of each PDO; 8 by default, up to 64 on CAN FD.
            window: number of taxels along the window of the sensor.
            shape: rows and columns of the array.

        Raises:
            ProtocolError: the PDOs together are no frame of the mode, or an identifier is there twice.
        """
        self._slots = {cob_id: slot for slot, cob_id in enumerate(cob_ids)}
        self._sizes = tuple(sizes) if sizes is not None else (8,) * len(cob_ids)
        whole = image_words(shape[0] * shape[1])
        payloads = {TactileMode.FEATURES: 1, TactileMode.WINDOW: window_words(window), TactileMode.IMAGE: whole}
        needed = 8 * (1 + payloads[mode])
        if len(self._slots) != len(cob_ids) or self._sizes[:1] != (8,) or sum(self._sizes) != needed:
            raise ProtocolError(
                f"{mode.name.lower()} frames need different COB-IDs, a header of 8 bytes first, {needed} bytes in all; "
                f"got {cob_ids} with {self._sizes} bytes"
            )
        self._mode, self._window, self.shape = mode, window, shape
        self._deadline_ns = deadline_ns
        self._parts: list[bytes | None] = []
        self._missing = 0  # 0: no frame is open
        self._opened_ns = 0
        self._last: int | None = None
        self.frames = self.torn = self.crc_errors = self.duplicates = self.lost = self.orphans = self.malformed = 0

    def push(self, can_id: int, data: bytes, t_ns: int) -> TactileMessage | None:
        """Take one received frame; other identifiers are ignored. No bytes make it raise."""
        slot = self._slots.get(can_id)
        if slot is None:
            return None
        self.expire(t_ns)
        if len(data) != self._sizes[slot]:
            self.malformed += 1
            self._tear()
        elif slot == 0:
            self._open(data, t_ns)
        elif not self._missing:
            self.orphans += 1
        elif self._parts[slot] is not None:
            self.duplicates += 1
            self._tear()
        else:
            self._parts[slot] = data
            self._missing -= 1
            if not self._missing:
                return self._close()
        return None

    def expire(self, t_ns: int) -> None:
        """Drop the open frame if its deadline has passed."""
        if self._missing and t_ns - self._opened_ns > self._deadline_ns:
            self._tear()

    def reset(self) -> None:
        """Forget the open frame and the last counter (the sensor was restarted); counters stay."""
        self._missing = 0
        self._last = None

    def _tear(self) -> None:
        if self._missing:
            self.torn += 1
            self._missing = 0

    def _open(self, data: bytes, t_ns: int) -> None:
        self._tear()
        self._parts = [None] * len(self._slots)
        self._parts[0] = data
        self._missing = len(self._slots) - 1
        self._opened_ns = t_ns

    def _close(self) -> TactileMessage | None:
        start, *rest = self._parts
        assert start is not None
        body = b"".join(rest)  # type: ignore[arg-type]  # complete: no None is left
        try:
            header = TactileHeader.unpack(start)
            check_origin(header, self.shape)
        except ProtocolError:
            self.malformed += 1
            return None
        if crc16_ccitt(body, crc16_ccitt(start[:6])) != header.crc:
            self.crc_errors += 1
            return None
        if header.mode is not self._mode or (header.mode is TactileMode.WINDOW and header.window != self._window):
            self.malformed += 1
            return None
        if header.frame_counter == self._last:
            self.duplicates += 1
            return None
        if self._last is not None:
            self.lost += (header.frame_counter - self._last - 1) % 256
        self._last = header.frame_counter
        self.frames += 1
        return TactileMessage(header, body, self._opened_ns)
