"""SDO requests to the device as raw frames, each with its one answer."""

from __future__ import annotations

from canprobe.errors import CanprobeError
from canprobe.fieldbus.protocol import sdo
from canprobe.fieldbus.tools.conform.accepted import AbortSet, abort_text
from canprobe.fieldbus.tools.conform.frame_link import FrameLink
from canprobe.fieldbus.tools.conform.frame_text import sdo_text
from canprobe.fieldbus.tools.conform.outcome import Deviation

MAX_VALUE_BYTES = 1 << 16
READ_TYPE = sdo.pack_read(0x1000)
"""Request for 1000h, which every device answers."""


class SdoRefused(CanprobeError):  # noqa: N818 - what a server does
    """The device aborted an access.

    Attributes:
        code: its abort code.
    """

    def __init__(self, index: int, subindex: int, code: int) -> None:
        self.code = code
        super().__init__(f"{sdo.place_text(index, subindex)}: abort {abort_text(code)}")


class SdoClient(FrameLink):
    """The default SDO channel of the device.

    Attributes:
        notes: what the report notes although the point passes.
    """

    notes: list[str]

    def ask(self, request: bytes) -> bytes:
        """Send a request; return the eight bytes of the answer.

        An answer that names another entry is a late one to an earlier request, as long as the right one comes, too.

        Raises:
            Deviation: no answer came, or one of another length.
        """
        answer = None
        self.taken(self.answer_id)
        self.send(self.request_id, request)
        named = request[0] >> 5 in (1, 2) or request[0] & 0xE1 == 0xC0 or request[0] & 0xE3 == 0xA0
        for frame in self.coming(self.answer_id, self.times.sdo_s):
            answer = frame.data
            if len(answer) != 8 or not named or sdo.place_of(answer) == sdo.place_of(request):
                break
        if answer is None:
            raise Deviation(f"no answer within {self.times.sdo_s:g} s to: {sdo_text(request)}")
        if len(answer) != 8:
            raise Deviation(f"an SDO answer has 8 bytes, this one has {len(answer)}")
        return answer

    def request(self, command: int, index: int = 0, subindex: int = 0, data: bytes = b"") -> bytes:
        """Send a request with a multiplexer; return the answer."""
        return self.ask(sdo.pack_request(command, index, subindex, data))

    def upload(self, index: int, subindex: int = 0) -> bytes:
        """Read an entry, expedited or segmented.

        Raises:
            SdoRefused: the device aborted.
            Deviation: no answer, or one that does not follow the protocol.
        """
        answer = self._initiated(sdo.pack_read(index, subindex), 2)
        if answer[0] & 2:
            return sdo.expedited_value(answer)
        announced, value, toggle, last = sdo.stated_size(answer), b"", 0, False
        while not last and len(value) < MAX_VALUE_BYTES:
            answer = self.ask(bytes((0x60 | toggle,)) + bytes(7))
            if answer[0] == sdo.ABORT:
                raise SdoRefused(index, subindex, sdo.abort_code(answer))
            if answer[0] & 0xF0 != toggle:
                raise Deviation(f"a segment of {sdo.place_text(index, subindex)} has the wrong command or toggle bit")
            value += sdo.segment_value(answer)
            toggle ^= 0x10
            last = bool(answer[0] & 1)
        if announced is not None and announced != len(value):
            raise Deviation(f"{sdo.place_text(index, subindex)} announced {announced} bytes and sent {len(value)}")
        return value

    def present(self, place: sdo.Place) -> bytes | None:
        """The value of an entry now; None where the device does not give it."""
        try:
            return self.upload(*place)
        except (SdoRefused, Deviation):
            return None

    def download(self, index: int, subindex: int, value: bytes) -> None:
        """Write an entry of up to four bytes.

        Raises:
            SdoRefused: the device aborted.
            Deviation: no answer, or a wrong one.
        """
        self._initiated(sdo.pack_write(index, subindex, value), 3)

    def _initiated(self, request: bytes, specifier: int) -> bytes:
        answer, place = self.ask(request), sdo.place_of(request)
        if answer[0] == sdo.ABORT:
            raise SdoRefused(*place, sdo.abort_code(answer))
        if answer[0] >> 5 != specifier:
            raise Deviation(f"command byte {answer[0]:02X}h answers: {sdo_text(request)}")
        if (named := sdo.place_of(answer)) != place:
            raise Deviation(f"the answer names {sdo.place_text(*named)}, asked was {sdo.place_text(*place)}")
        return answer

    def must_refuse(self, request: bytes, accepted: AbortSet, what: str) -> None:
        """Send a request that must be aborted.

        Raises:
            Deviation: it is not, or with a code that is not accepted.
        """
        self.check_abort(self.ask(request), accepted, what)

    def must_refuse_write(self, index: int, subindex: int, value: int | bytes, accepted: AbortSet, what: str) -> None:
        """Write bytes, or a number of four bytes, which must be refused. Raises Deviation, as `must_refuse`."""
        data = value.to_bytes(4, "little") if isinstance(value, int) else value
        self.must_refuse(sdo.pack_write(index, subindex, data), accepted, what)

    def check_abort(self, answer: bytes, accepted: AbortSet, what: str) -> None:
        """Check that an answer is an abort with an accepted code. Raises Deviation."""
        if answer[0] != sdo.ABORT:
            raise Deviation(f"{what}: expected an abort, got {answer.hex(' ').upper()}")
        code = sdo.abort_code(answer)
        if code not in accepted:
            raise Deviation(f"{what}: aborted with {abort_text(code)}")
        if code != accepted[0]:
            self.notes.append(f"{what}: {abort_text(code)}, the exact code is {accepted[0]:08X}h")

    def is_silent(self) -> bool:
        """Whether no SDO answer has come, and none comes for the time of a silence."""
        self.pass_time(self.times.silence_s)
        return not self.taken(self.answer_id)

    def abort(self, index: int) -> None:
        """End a transfer of an entry from the client's side."""
        self.send(self.request_id, sdo.pack_abort(index, 0, sdo.Abort.GENERAL))

    def ignores(self, can_id: int, data: bytes = b"") -> bool:
        """Send a frame; whether no SDO answer comes."""
        self.taken(self.answer_id)
        self.send(can_id, data)
        return self.is_silent()
