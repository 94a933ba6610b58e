"""Puts the PDOs of a tactile frame together again, or drops them: never half of one frame and half of another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol import tactile
from canprobe.fieldbus.protocol.tactile import Features, Shape, TactileHeader, TactileMode


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
        window: int = tactile.DEFAULT_WINDOW,
        shape: Shape = (tactile.MAX_SIDE, tactile.MAX_SIDE),
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
        whole = tactile.image_words(shape[0] * shape[1])
        payloads = {TactileMode.FEATURES: 1, TactileMode.WINDOW: tactile.window_words(window), TactileMode.IMAGE: whole}
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
            tactile.check_origin(header, self.shape)
        except ProtocolError:
            self.malformed += 1
            return None
        if tactile.crc16_ccitt(body, tactile.crc16_ccitt(start[:6])) != header.crc:
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
