"""Points 18 to 23: segmented and block transfers. Source: CiA 301, "SDO download", "SDO upload", block protocols.

Downloads go to 1017h, which is put back; uploads read a text of the device that needs several segments.
"""

from __future__ import annotations

from binascii import crc_hqx

from canprobe.fieldbus.protocol.sdo import ABORT, Abort, abort_code, pack_request
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.accepted import AbortSet
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.device import TEXTS
from canprobe.fieldbus.tools.conform.point import PointGroup

point = PointGroup("sdo", "CiA 301")
SEGMENTS = "SDO segmented transfer"
BLOCKS = "SDO block transfer"
_SERVER_TIMEOUT_S = 5.0
_HEARTBEAT = 0x1017


def _segmented_download(bench: Bench) -> None:
    """Begin a segmented download of two bytes to 1017h."""
    bench.need((_HEARTBEAT, 0))
    answer = bench.request(0x21, _HEARTBEAT, 0, b"\2\0\0\0")
    what = "a segmented download of 2 bytes to 1017h"
    bench.expect(answer[0] == 0x60, f"{what} is answered with {answer.hex(' ')}")


def _segmented_upload(bench: Bench) -> None:
    """Begin a segmented upload of a text."""
    for index in TEXTS:
        if len(bench.device.values.get((index, 0), b"")) > 4:
            if bench.request(0x40, index)[0] & 0xE2 != 0x40:
                bench.deviates(f"{index:04X}h is longer than four bytes, and comes expedited")
            return
    bench.does_not_apply("the device has no text of more than four bytes")


def _segment(value: bytes, toggle: int = 0) -> bytes:
    """The only segment of a download, and so the last."""
    return bytes((toggle | (7 - len(value)) << 1 | 1,)) + value.ljust(7, b"\0")


def _must_end_transfer(bench: Bench, segment: bytes, codes: AbortSet, what: str) -> None:
    """Send a frame that must end the transfer with an abort; the server is free afterwards."""
    bench.must_refuse(segment, codes, what)
    bench.serves("the transfer")


def _own_value(bench: Bench) -> bytes:
    return bench.device.values[_HEARTBEAT, 0]


@point(18, "toggle of a download", SEGMENTS, accepted.TOGGLE)
def toggle_down(bench: Bench) -> None:
    """The first segment has toggle bit 1."""
    _segmented_download(bench)
    _must_end_transfer(bench, _segment(_own_value(bench), 0x10), accepted.TOGGLE, "a segment that is not toggled")


@point(18, "toggle of an upload", SEGMENTS, accepted.TOGGLE)
def toggle_up(bench: Bench) -> None:
    """The first request for a segment has toggle bit 1."""
    _segmented_upload(bench)
    _must_end_transfer(bench, b"\x70" + bytes(7), accepted.TOGGLE, "a request for a segment that is not toggled")


@point(19, "time-out", "SDO abort codes", "05040000h, or no time-out at all; then it serves again")
def server_timeout(bench: Bench) -> None:
    """A download that is not continued: an abort, if one comes, is the time-out, and the server is free afterwards."""
    _segmented_download(bench)
    frame = bench.next(bench.answer_id, _SERVER_TIMEOUT_S)
    if frame is not None:
        bench.check_abort(frame.data, accepted.TIMED_OUT, "a download that is not continued")
    else:
        bench.notes.append(f"no time-out within {_SERVER_TIMEOUT_S:g} s")
    bench.serves("the transfer")


@point(20, "no transfer", SEGMENTS, accepted.UNKNOWN_COMMAND)
def no_transfer(bench: Bench) -> None:
    """Segments while no transfer is open."""
    for command, what in ((0x60, "a request for a segment"), (0x00, "a segment")):
        bench.must_refuse(bytes((command,)) + bytes(7), accepted.UNKNOWN_COMMAND, f"{what} without a transfer")


@point(21, "client's abort", "SDO abort", "no answer; the transfer is over")
def client_abort(bench: Bench) -> None:
    """The client aborts a download."""
    _segmented_download(bench)
    bench.taken(bench.answer_id)
    bench.abort(_HEARTBEAT)
    bench.expect(bench.is_silent(), "the abort of the client is answered")
    _must_end_transfer(bench, _segment(_own_value(bench)), accepted.UNKNOWN_COMMAND, "a segment after the abort")


@point(22, "fewer than announced", SEGMENTS, accepted.TOO_SHORT)
def fewer_than_announced(bench: Bench) -> None:
    """Two bytes are announced, one is sent."""
    _segmented_download(bench)
    _must_end_transfer(bench, _segment(_own_value(bench)[:1]), accepted.TOO_SHORT, "1 byte where 2 were announced")


@point(22, "more than announced", SEGMENTS, accepted.TOO_LONG)
def more_than_announced(bench: Bench) -> None:
    """Two bytes are announced, three are sent."""
    _segmented_download(bench)
    _must_end_transfer(bench, _segment(_own_value(bench) + b"\0"), accepted.TOO_LONG, "3 bytes where 2 were announced")


@point(23, "expedited", "SDO expedited transfer", "1000h in four bytes; 1017h takes its own value")
def expedited(bench: Bench) -> None:
    """An upload, and a download that is read back."""
    bench.need((0x1000, 0), written=False)
    answer = bench.request(0x40, 0x1000)
    if answer[0] not in (0x43, 0x42):
        bench.deviates(f"1000h has four bytes, its upload is answered with command {answer[0]:02X}h")
    if bench.device.writable(_HEARTBEAT):
        bench.put(_HEARTBEAT, 0, int.from_bytes(_own_value(bench), "little"))
        bench.expect(bench.upload(_HEARTBEAT) == _own_value(bench), "1017h does not keep the value that was written")


@point(23, "segmented upload", SEGMENTS, "a text in segments, as long as announced")
def segmented_upload(bench: Bench) -> None:
    """A text in segments, twice the same."""
    _segmented_upload(bench)
    bench.abort(_HEARTBEAT)
    for index in TEXTS:
        value = bench.device.values.get((index, 0), b"")
        if len(value) > 4 and bench.upload(index) != value:
            bench.deviates(f"{index:04X}h differs from one upload to the next")


@point(23, "segmented download", SEGMENTS, "1017h takes a value in a segment")
def segmented_download(bench: Bench) -> None:
    """1017h gets another value in a segment."""
    _segmented_download(bench)
    value = (int.from_bytes(_own_value(bench), "little") ^ 0x1000).to_bytes(2, "little")
    answer = bench.ask(_segment(value))
    bench.expect(answer[0] & 0xF0 == 0x20, f"a segment is answered with {answer.hex(' ')}")
    bench.expect(bench.upload(_HEARTBEAT) == value, "1017h does not have the value of the segment")


def _block_answer(bench: Bench, request: bytes) -> bytes:
    """Begin a block transfer; where the device has none, the point does not apply."""
    answer = bench.ask(request)
    if answer[0] == ABORT and abort_code(answer) == Abort.COMMAND:
        bench.does_not_apply("the device has no block transfer (05040001h)")
    return answer


def _text_index(bench: Bench) -> int:
    """A text of the device. Raises PointNotApplicable."""
    index = next((i for i in TEXTS if bench.device.has(i)), 0x1008)
    bench.need((index, 0), written=False)
    return index


def _block_segments(bench: Bench, index: int) -> tuple[bytes, int, int]:
    """Begin a block upload; return the bytes of its first block, the number of segments, and the bit of the CRC."""
    answer = _block_answer(bench, pack_request(0xA4, index, 0, bytes((127, 0))))
    bench.expect(answer[0] >> 5 == 6, f"a block upload is answered with {answer.hex(' ')}")
    bench.taken(bench.answer_id)
    bench.send(bench.request_id, b"\xa3" + bytes(7))
    value, number, last = b"", 0, False
    while not last and number < 127:
        frame = bench.next(bench.answer_id, bench.times.sdo_s)
        number += 1
        if frame is None or len(frame.data) != 8 or frame.data[0] & 0x7F != number:
            bench.deviates(f"segment {number} of a block does not come, or has another number")
        value, last = value + frame.data[1:], bool(frame.data[0] & 0x80)
    return value, number, answer[0] & 4


@point(23, "block upload", BLOCKS, "the same bytes as in segments, with the right CRC")
def block_upload(bench: Bench) -> None:
    """A text in blocks of 127 segments."""
    index = _text_index(bench)
    wanted = bench.device.values[index, 0]
    value, number, with_crc = _block_segments(bench, index)
    end = bench.ask(bytes((0xA2, number, 127)) + bytes(5))
    bench.expect(end[0] & 0xE3 == 0xC1, f"the end of a block upload is {end.hex(' ')}")
    value = value[: len(value) - (end[0] >> 2 & 7)]
    bench.send(bench.request_id, b"\xa1" + bytes(7))
    bench.expect(value == wanted, f"a block upload of {index:04X}h gives {value.hex()}, segments gave {wanted.hex()}")
    if with_crc and int.from_bytes(end[1:3], "little") != crc_hqx(value, 0):
        bench.deviates("the CRC of a block upload is wrong")
    bench.serves("the transfer")


@point(23, "acknowledgement of 128", BLOCKS, accepted.SEQUENCE)
def acknowledgement_of_128(bench: Bench) -> None:
    """A block upload, of which more segments are acknowledged than a block can have."""
    _block_segments(bench, _text_index(bench))
    acknowledgement = bytes((0xA2, 128, 127)) + bytes(5)
    _must_end_transfer(bench, acknowledgement, accepted.SEQUENCE, "an acknowledgement of 128 segments")


def _block_download(bench: Bench, value: bytes, *, number: int = 1, crc: int | None = None) -> bytes:
    """A block download of 1017h in one segment; return the last answer."""
    bench.need((_HEARTBEAT, 0))
    answer = _block_answer(bench, pack_request(0xC6, _HEARTBEAT, 0, len(value).to_bytes(4, "little")))
    if answer[0] >> 5 != 5 or not 1 <= answer[4] <= 127:
        bench.deviates(f"a block download is answered with {answer.hex(' ')}")
    bench.send(bench.request_id, bytes((0x80 | number,)) + value.ljust(7, b"\0"), segment=True)
    frame = bench.next(bench.answer_id, bench.times.sdo_s)
    if frame is None:
        bench.deviates("a block is not acknowledged")
    if frame.data[0] == ABORT or frame.data[1] != 1:
        return frame.data
    crc = crc_hqx(value, 0) if crc is None else crc
    return bench.ask(bytes((0xC1 | (7 - len(value)) << 2,)) + crc.to_bytes(2, "little") + bytes(5))


@point(23, "block download", BLOCKS, "1017h takes a value in a block")
def block_download(bench: Bench) -> None:
    """1017h gets another value in a block of one segment."""
    value = b"\x10\x27"
    answer = _block_download(bench, value)
    bench.expect(answer[0] & 0xE3 == 0xA1, f"the end of a block download is answered with {answer.hex(' ')}")
    bench.expect(bench.upload(_HEARTBEAT) == value, "1017h does not have the value of the block")


@point(23, "CRC of a block", BLOCKS, accepted.CRC)
def block_crc(bench: Bench) -> None:
    """A wrong CRC, where the device announces that it checks it."""
    answer = _block_answer(bench, pack_request(0xC6, _HEARTBEAT, 0, bytes((2, 0, 0, 0))))
    bench.abort(_HEARTBEAT)
    bench.require(answer[0] & 4, "the device does not check a CRC")
    value = b"\x10\x27"
    last = _block_download(bench, value, crc=crc_hqx(value, 0) ^ 0xFFFF)
    bench.check_abort(last, accepted.CRC, "a block with a wrong CRC")
    bench.serves("the transfer")


@point(23, "sequence of a block", BLOCKS, "05040003h, or the segment is not acknowledged")
def block_sequence(bench: Bench) -> None:
    """A block that begins with segment 2: it is refused, or segment 0 is acknowledged, as one is lost."""
    answer = _block_download(bench, b"\x10\x27", number=2)
    if answer[0] == ABORT:
        bench.check_abort(answer, accepted.SEQUENCE, "a block that begins with segment 2")
    elif answer[0] & 0xE3 != 0xA2 or answer[1] != 0:
        bench.deviates(f"a block that begins with segment 2 is answered with {answer.hex(' ')}")
    else:
        bench.abort(_HEARTBEAT)
    bench.serves("the transfer")


def _refuses_block_size(bench: Bench, size: int) -> None:
    index = 0x1008 if bench.device.has(0x1008) else 0x1000
    bench.need((index, 0), written=False)
    answer = _block_answer(bench, pack_request(0xA4, index, 0, bytes((size, 0))))
    bench.check_abort(answer, accepted.BLOCK_SIZE, f"blocks of {size} segments")
    bench.serves("the transfer")


@point(23, "block of 0", BLOCKS, accepted.BLOCK_SIZE)
def block_of_0(bench: Bench) -> None:
    """An upload in blocks of no segment."""
    _refuses_block_size(bench, 0)


@point(23, "block of 128", BLOCKS, accepted.BLOCK_SIZE)
def block_of_128(bench: Bench) -> None:
    """An upload in blocks of more than 127 segments."""
    _refuses_block_size(bench, 128)
