"""Logs of a bus in candump's format.

CAN FD frames, which here are those of more than 8 bytes, stand as `521##1<data>`: 1 is the bit rate switch.

Source: can-utils, `candump -l` and `lib.c` (parse_canframe).
"""

from __future__ import annotations

import contextlib
import re
import shlex
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from gzip import GzipFile
from io import BufferedReader, BytesIO, FileIO, TextIOWrapper
from pathlib import Path

from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.files import writing
from canprobe.fieldbus.bus.port import Port, TimedFrame, nothing
from canprobe.fieldbus.bus.system import system
from canprobe.fieldbus.bus.tapped import TappedPort
from canprobe.fieldbus.eds.foreign_files import HEAD_BYTES, file_kind
from canprobe.fieldbus.protocol.frames import BRS_FLAG, CLASSIC_BYTES, EFF_FLAG, EFF_MASK, RTR_FLAG, Frame

# candump log files: `(0000000000.002500) can0 181#37060000`, time with six digits, from 0 in a recording of ours.
# candump pads the channel on the left (several interfaces), writes nine digits with -N, the DLC of a frame of 8 bytes
# behind "_" with -8, and a line of its own for lost frames with -d.

_DROPS = r"DROPCOUNT: dropped (?P<dropped>\d+) CAN frames? on '(?P<socket>[^']+)' socket \(total drops \d+\)"
_LINE_PATTERN = re.compile(
    r"\((?P<s>\d+)\.(?P<fraction>\d{6}(?:\d{3})?)\) +(?P<channel>\S+) (?:(?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    r"(?:R(?:[0-7]?|8(?:_[9A-Fa-f])?)|#[0-9A-Fa-f](?P<fd>(?:[0-9A-Fa-f]{2}){0,64})|"
    r"(?P<data>(?:[0-9A-Fa-f]{2}){0,7}|(?:[0-9A-Fa-f]{2}){8}(?:_[9A-Fa-f])?))|"
    r"(?P<xl>[0-9A-Fa-f]{5}#[0-9A-Fa-f]{2}:[0-9A-Fa-f]{2}:[0-9A-Fa-f]{8}#(?:[0-9A-Fa-f]{2})*))(?: [RT])?|" + _DROPS
)
_SCREEN_PATTERN = re.compile(
    r" *(?:\((?:(?P<s>\d+)|(?P<date>\d{4}-\d\d-\d\d \d\d:\d\d:\d\d))\.(?P<fraction>\d{6}(?:\d{3})?)\))? *"
    r"(?P<channel>\S+)  (?:[RT]X [-B] [-E]  )? *(?:(?P<xl>[0-9A-F]{3} +\[\d{4}\] \(.*)|"
    r"(?P<id>[0-9A-F]{8}|[0-9A-F]{3}) +\[(?P<length>\d+)\] *"
    r"(?:remote request|(?P<data>(?:[0-9A-F]{2} ?){0,64})(?: *ERRORFRAME| *'.*')?))|" + _DROPS
)
"""Line that candump prints without -l and -L: `(000.002500)  can0  181   [4]  37 06 00 00`; the time may be missing."""
_SHORT_STAMP = re.compile(rb" *\(000\.0{6}")
"""Beginning of a log whose stamps count from its first frame (candump -tz), or from the frame before (-td)."""
_MAX_FALLS = 0.1
"""Largest share of stamps that do not grow on their channel, as far as stamps are times; more are differences."""
_ENCODINGS = {
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
    b"(\0": "utf-16-le",
    b"\0(": "utf-16-be",
    b"\xef\xbb": "utf-8-sig",
}
"""Encodings by the first two bytes; anything else is ASCII."""


_BUFFERED_LINES = 256
"""Lines that are kept before they are joined and go to the file."""


class CandumpWriter:
    """Writes frames as candump does; a context manager. Its `write` is a recorder for a `LockstepBus`.

    A file that fails (full disk) ends the log after a whole line and raises nothing, as a machine moves meanwhile: look
    at `failure`.

    Args:
        path: file to write; an existing one is replaced.
        channel: name in each line.
        t0_ns: time on the frames' clock that is written as 0.

    Raises:
        ResultsError: the file cannot be opened.
        UsageError: another run writes this file now.

    Attributes:
        failure: reason why nothing is written any more; None while there is none.
    """

    def __init__(self, path: str | Path, channel: str, t0_ns: int = 0) -> None:
        self._t0_ns = t0_ns
        self.failure: str | None = None
        self._path = path
        with writing(Path(path)):
            self._file = _opened_alone(path)
        self._size = 0
        self._lines: list[str] = []
        self.write = self.on(channel)

    def on(self, channel: str, also: Callable[[int, bytes, int], None] = nothing) -> Callable[[int, bytes, int], None]:
        """A recorder of the frames of one channel: called with (can_id, data, t_ns), it adds a line to this file.

        Args:
            channel: name in its lines.
            also: function that is called with the same frames.
        """
        form = _line_maker(channel, self._t0_ns)

        def write(can_id: int, data: bytes, t_ns: int) -> None:
            self._lines.append(form(can_id, data, t_ns))
            also(can_id, data, t_ns)
            if len(self._lines) >= _BUFFERED_LINES:
                self.flush()

        return write

    def flush(self) -> None:
        """Write to the file what was recorded so far."""
        data = "".join(self._lines).encode("ascii")
        self._lines.clear()
        if self.failure is not None:
            return
        written = 0
        try:
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            self.failure = f"{self._path}: cannot be written: {error.strerror or error}"
            with contextlib.suppress(OSError):
                self._file.truncate(self._size + data.rfind(b"\n", 0, written) + 1)
        self._size += written

    def close(self) -> None:
        """Flush and close the file; it may be called twice."""
        if not self._file.closed:
            self.flush()
        self._file.close()

    def __enter__(self) -> CandumpWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _line_maker(channel: str, t0_ns: int) -> Callable[[int, bytes, int], str]:
    """A function that makes the line of one frame, newline included; ns below the microsecond are cut off."""
    names: dict[int, str] = {}
    prefix, prefix_s = "", -1

    def line(can_id: int, data: bytes, t_ns: int) -> str:
        nonlocal prefix, prefix_s
        second, us = divmod((t_ns - t0_ns) // 1000, 1_000_000)
        if second != prefix_s:
            prefix, prefix_s = f"({second:010d}.", second
        name = names.get(can_id)
        if name is None:
            name = names[can_id] = f") {channel} {_format_id(can_id)}#"
        if len(data) > CLASSIC_BYTES:
            payload = f"#{BRS_FLAG}{data.hex().upper()}"
        else:
            payload = "R" if can_id & RTR_FLAG else data.hex().upper()
        return f"{prefix}{us:06d}{name}{payload}\n"

    return line


def _format_id(can_id: int) -> str:
    if can_id <= 0x7FF:
        return f"{can_id:03X}"
    plain = can_id & ~RTR_FLAG
    return f"{plain & ~EFF_FLAG:08X}" if plain & EFF_FLAG else f"{plain:03X}"


def _opened_alone(path: str | Path) -> FileIO:
    """An empty file to write to, locked against other runs until it is closed."""
    file = open(path, "ab", buffering=0)  # noqa: SIM115 - the caller's
    try:
        system.lock(file)
    except BlockingIOError:
        file.close()
        raise UsageError(f"{path}: another run writes this file; choose another folder") from None
    except OSError:
        pass  # a file system without locks
    with contextlib.suppress(OSError):  # no file but a device
        file.truncate(0)
    return file


CandumpLine = tuple[int, str, int, bytes]
"""Frame of a log: t_ns, channel, can_id with the flags of `protocol.frames` and `bus.port`, data."""


class CandumpReader:
    """Reads a candump log line by line: an iterable of `CandumpLine`. Lines without a CAN or CAN FD frame are counted.

    What candump prints on a screen is read too; its frames without a time are at 0, and differences (-td) become times.

    Args:
        path: path of the log, in ASCII, UTF-8 or UTF-16, or the same compressed (.gz).
        whole: whether a torn last line is an error; else it is passed over, as a logger that is killed leaves one.

    Attributes:
        number: number of the line that was read last, from 1.
        lost: number of frames that candump did not receive (its option -d), by channel.
        xl: number of CAN XL frames, by channel.
    """

    def __init__(self, path: str | Path, *, whole: bool = False) -> None:
        self.number = 0
        self.lost: Counter[str] = Counter()
        self.xl: Counter[str] = Counter()
        self._path, self._whole = path, whole
        self._piped: bytes | None = None

    def __iter__(self) -> Iterator[CandumpLine]:
        """Yield the frames.

        Raises:
            UsageError: the file cannot be read, or a line is none of candump; the message has file and line number.
        """
        try:
            with self._opened() as file:
                may_be_differences = _SHORT_STAMP.match(file.peek(HEAD_BYTES))
            yield from with_times(self._frames) if may_be_differences else self._frames()
        except (OSError, EOFError, zlib.error) as error:
            raise UsageError(f"{self._path}: {getattr(error, 'strerror', None) or error}") from error

    def _frames(self) -> Iterator[CandumpLine]:
        self.lost.clear()
        self.xl.clear()
        parse: Callable[[str], re.Match[str] | None] = _LINE_PATTERN.fullmatch
        frame_of = _frame_of
        file = self._opened()
        head = file.peek(HEAD_BYTES)[:HEAD_BYTES]
        with TextIOWrapper(file, _ENCODINGS.get(head[:2], "ascii"), errors="replace") as lines:
            if (kind := file_kind(head)) is not None:
                way = f"; {kind.into_log.format(path=shlex.quote(str(self._path)))}" if kind.into_log else ""
                raise UsageError(f"{self._path}: {kind.name}, not a candump log{way}")
            for self.number, line in enumerate(lines, 1):
                text = line.rstrip("\r\n")
                if self.number == 1 and _SCREEN_PATTERN.fullmatch(text):
                    parse, frame_of = _match_screen, _screen_frame
                match = parse(text)
                if match is None:
                    if text.lstrip("\t") == text != "" and (self._whole or line.endswith("\n")):  # -e explains errors
                        raise self._no_line(text)
                elif match["dropped"]:
                    self.lost[match["socket"]] += int(match["dropped"])
                elif match["xl"]:
                    self.xl[match["channel"]] += 1
                else:
                    yield frame_of(match)

    def _opened(self) -> BufferedReader | GzipFile:
        """The file from its start; the content of a pipe is kept, as it comes only once."""
        path = Path(self._path)
        if self._piped is None and path.is_fifo():
            self._piped = path.read_bytes()
        if self._piped is not None:
            return BufferedReader(BytesIO(self._piped))
        path = regular_file(path)
        return GzipFile(path) if path.suffix.lower() == ".gz" else path.open("rb")

    def _no_line(self, text: str) -> UsageError:
        form = "(seconds.microseconds) channel ID#DATA, or ID##fDATA for CAN FD"
        return UsageError(
            f"{self._path}:{self.number}: no candump line: {text[:60]!r}; expected '{form}', or what candump prints;"
            " a log of another tool is known by its suffix, such as .asc, .blf or .trc"
        )


def with_times(read: Callable[[], Iterator[CandumpLine]]) -> Iterator[CandumpLine]:
    """Frames with stamps that may be differences from frame to frame; then they are added up.

    Args:
        read: function that gives the frames, and is called twice.
    """
    latest: dict[str, int] = {}
    count = falls = 0
    for t_ns, channel, _, _ in read():
        count += 1
        falls += t_ns <= latest.get(channel, -1)
        latest[channel] = t_ns
    are_differences, time_ns = falls > _MAX_FALLS * count, 0
    for t_ns, channel, can_id, data in read():
        time_ns = time_ns + t_ns if are_differences else t_ns
        yield time_ns, channel, can_id, data


def read_candump(path: str | Path, *, whole: bool = False) -> Iterator[CandumpLine]:
    """Read the frames of a candump log in the order of its lines: see `CandumpReader`."""
    return iter(CandumpReader(path, whole=whole))


def _frame_of(match: re.Match[str]) -> CandumpLine:
    t_ns = int(match["s"]) * 1_000_000_000 + int(match["fraction"].ljust(9, "0"))
    can_id = _parse_id(match["id"], match["data"] is None and match["fd"] is None)
    return t_ns, match["channel"], can_id, bytes.fromhex(match["fd"] or (match["data"] or "")[:16])


def _match_screen(text: str) -> re.Match[str] | None:
    match = _SCREEN_PATTERN.fullmatch(text)
    is_torn = match and match["data"] is not None and len(bytes.fromhex(match["data"])) != int(match["length"])
    return None if is_torn else match


def _screen_frame(match: re.Match[str]) -> CandumpLine:
    s = int(match["s"] or 0)
    if match["date"]:
        s = int(datetime.fromisoformat(match["date"]).replace(tzinfo=UTC).timestamp())
    t_ns = s * 1_000_000_000 + int((match["fraction"] or "").ljust(9, "0"))
    return t_ns, match["channel"], _parse_id(match["id"], match["data"] is None), bytes.fromhex(match["data"] or "")


def _parse_id(text: str, is_remote: bool) -> int:
    can_id = int(text, 16)
    if len(text) == 8:  # 29 bits, or an error frame, which carries its own flag in the text
        can_id = can_id | EFF_FLAG if can_id <= EFF_MASK else can_id
    return can_id | RTR_FLAG if is_remote else can_id


class RecordingPort(TappedPort):
    """A `Port` that records what passes through it, sent frames with the time of sending.

    In real time a received frame is written when it is drained, with the time of its reception, so a line may be older
    than the line above it.

    Args:
        port: port to use.
        write: recorder that is called with (can_id, data, t_ns), such as `CandumpWriter.write`.
    """

    def __init__(self, port: Port, write: Callable[[int, bytes, int], None]) -> None:
        super().__init__(port)
        self._write = write

    def hear_sent(self, frames: Sequence[Frame], t_ns: int) -> None:
        for can_id, data in frames:
            self._write(can_id, data, t_ns)

    def hear_received(self, frames: Sequence[TimedFrame]) -> None:
        for can_id, data, t_ns in frames:
            self._write(can_id, data, t_ns)
