"""candump log files: `(0000000000.002500) can0 181#37060000`, time with six digits, from 0 in a recording of ours.

CAN FD frames, which here are those of more than 8 bytes, stand as `521##1<data>`: 1 is the bit rate switch.

Source: can-utils, `candump -l` and `lib.c` (parse_canframe).
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Container, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol

from canprobe.bus.clock import Clock
from canprobe.bus.port import EFF_FLAG, RTR_FLAG, ControllerState, Frame, Port, PortCounters, TimedFrame
from canprobe.errors import UsageError

_LINE = re.compile(
    r"\((?P<s>\d+)\.(?P<us>\d{6})\) (?P<channel>\S+) (?P<id>[0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#"
    r"(?:R(?P<length>[0-8]?)|#(?P<flags>[0-9A-Fa-f])(?P<fd>(?:[0-9A-Fa-f]{2}){0,64})|"
    r"(?P<data>(?:[0-9A-Fa-f]{2}){0,8}))(?: [RT])?"
)


CLASSIC_BYTES = 8
_BIT_RATE_SWITCH = 1
_LINES = 256
"""Lines that are joined before they go to the file."""


class CandumpWriter:
    """Writes frames as candump does; a context manager. Its `write` is a recorder for a `LockstepBus`.

    A file that fails (full disk) ends the log after a whole line and raises nothing: whoever records a moving machine
    looks at `failure`.

    Args:
        path: the file to write; an existing one is replaced.
        channel: the name in each line.
        t0_ns: the time on the frames' clock that is written as 0.

    Attributes:
        failure: why nothing is written any more; None while all is well.
    """

    def __init__(self, path: str | Path, channel: str, t0_ns: int = 0) -> None:
        self._t0_ns = t0_ns
        self.failure: str | None = None
        self._path = path
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by close
        self._size = 0
        self._lines: list[str] = []
        self.write = self.on(channel)

    def on(self, channel: str) -> Callable[[int, bytes, int], None]:
        """A recorder of the frames of one channel: called with (can_id, data, t_ns), it adds a line to this file."""
        return _ChannelWriter(self._lines, self.flush, channel, self._t0_ns).write

    def flush(self) -> None:
        """Hand what was written to the file."""
        data = "".join(self._lines).encode("ascii")
        self._lines.clear()
        if self.failure is not None:
            return
        written = 0
        try:
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            self.failure = f"{self._path}: {error.strerror}"
            with contextlib.suppress(OSError):
                self._file.truncate(self._size + data.rfind(b"\n", 0, written) + 1)
        self._size += written

    def close(self) -> None:
        """Flush and close the file; twice is allowed."""
        if not self._file.closed:
            self.flush()
        self._file.close()

    def __enter__(self) -> CandumpWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


class _ChannelWriter:
    """Lines of one channel."""

    __slots__ = ("_channel", "_flush", "_lines", "_names", "_prefix", "_t0_ns", "_t_ns")

    def __init__(self, lines: list[str], flush: Callable[[], None], channel: str, t0_ns: int) -> None:
        self._lines, self._flush, self._channel, self._t0_ns = lines, flush, channel, t0_ns
        self._t_ns: int | None = None
        self._prefix = ""
        self._names: dict[int, str] = {}

    def write(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Add one frame that was on the bus at `t_ns`; the same line as `format_line`, for a fifth of its time."""
        if t_ns != self._t_ns:
            self._t_ns = t_ns
            self._prefix = _format_prefix(self._channel, t_ns - self._t0_ns)
        name = self._names.get(can_id)
        if name is None:
            name = self._names[can_id] = _format_id(can_id) + "#"
        lines = self._lines
        plain = not can_id & RTR_FLAG and len(data) <= CLASSIC_BYTES
        lines.append(f"{self._prefix}{name}{data.hex().upper() if plain else _format_payload(can_id, data)}\n")
        if len(lines) >= _LINES:
            self._flush()


def format_line(channel: str, can_id: int, data: bytes, t_ns: int) -> str:
    """Return the line of one frame, newline included; ns below the microsecond are cut off."""
    return f"{_format_prefix(channel, t_ns)}{_format_id(can_id)}#{_format_payload(can_id, data)}\n"


def _format_prefix(channel: str, t_ns: int) -> str:
    seconds, us = divmod(t_ns // 1000, 1_000_000)
    return f"({seconds:010d}.{us:06d}) {channel} "


def _format_payload(can_id: int, data: bytes) -> str:
    if len(data) > CLASSIC_BYTES:
        return f"#{_BIT_RATE_SWITCH}{data.hex().upper()}"
    return "R" if can_id & RTR_FLAG else data.hex().upper()


def _format_id(can_id: int) -> str:
    if can_id <= 0x7FF:
        return f"{can_id:03X}"
    plain = can_id & ~RTR_FLAG
    return f"{plain & ~EFF_FLAG:08X}" if plain & EFF_FLAG else f"{plain:03X}"


def read_candump(path: str | Path, only: Container[int] | None = None) -> Iterator[tuple[int, str, int, bytes]]:
    """Read a candump log.

    Args:
        path: the log.
        only: 11-bit identifiers that are wanted; other lines are passed over unread, a torn one too. None: all.

    Yields:
        (t_ns, channel, can_id, data) of each line; can_id with the flags of `canprobe.bus.port`.

    Raises:
        UsageError: the file cannot be read, or a line is not one of candump's; with file and line number.
    """
    try:
        with Path(path).open(encoding="ascii", errors="replace") as file:
            for number, line in enumerate(file, 1):
                if only is not None and _id_of(line) not in only:
                    continue
                if text := line.rstrip("\r\n"):
                    yield _parse_line(text, path, number)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def _id_of(line: str) -> int:
    """The 11-bit identifier of a line without reading the rest of it; −1 where there is none."""
    name = line.partition("#")[0].rpartition(" ")[2]
    try:
        return int(name, 16) if len(name) == 3 else -1
    except ValueError:
        return -1


def _parse_line(text: str, path: str | Path, number: int) -> tuple[int, str, int, bytes]:
    match = _LINE.fullmatch(text)
    if match is None:
        form = "(seconds.microseconds) channel ID#DATA, or ID##fDATA for CAN FD"
        raise UsageError(f"{path}:{number}: no candump line: {text[:60]!r}; expected '{form}'")
    t_ns = (int(match["s"]) * 1_000_000 + int(match["us"])) * 1000
    return t_ns, match["channel"], _parse_id(match), bytes.fromhex(match["fd"] or match["data"] or "")


def _parse_id(match: re.Match[str]) -> int:
    can_id = int(match["id"], 16)
    if len(match["id"]) == 8:  # 29 bits, or an error frame, which carries its own flag in the text
        can_id = can_id | EFF_FLAG if can_id <= 0x1FFFFFFF else can_id
    return can_id | RTR_FLAG if match["data"] is None and match["fd"] is None else can_id


class FrameWriter(Protocol):
    """Something frames are written to, such as a `CandumpWriter`."""

    @property
    def write(self) -> Callable[[int, bytes, int], None]:
        """Called with (can_id, data, t_ns)."""
        ...


class RecordingPort:
    """A `Port` that writes down what passes through it, sent frames with the time of sending.

    In real time a received frame is written when it is drained, with the time of its reception, so a line may be older
    than the line above it.

    Args:
        port: the port to use.
        writer: where to write; it is not closed with the port.
    """

    def __init__(self, port: Port, writer: FrameWriter) -> None:
        self._port = port
        self._write = writer.write

    @property
    def clock(self) -> Clock:
        """The port's clock."""
        return self._port.clock

    @property
    def channel(self) -> str:
        """The port's channel."""
        return self._port.channel

    @property
    def counters(self) -> PortCounters:
        """The port's counters."""
        return self._port.counters

    @property
    def state(self) -> ControllerState:
        """As the port tells it."""
        return self._port.state

    @property
    def stamps_arrival(self) -> bool:
        """As the port does."""
        return self._port.stamps_arrival

    def send_batch(self, frames: Sequence[Frame], t_ns: int | None = None) -> None:
        """Send `frames` and write them down, with `t_ns` where it is given."""
        sent_ns = self._port.clock.now_ns() if t_ns is None else t_ns
        self._port.send_batch(frames)
        for can_id, data in frames:
            self._write(can_id, data, sent_ns)

    def drain(self) -> list[TimedFrame]:
        """Return what arrived, written down."""
        frames = self._port.drain()
        for can_id, data, t_ns in frames:
            self._write(can_id, data, t_ns)
        return frames

    def wait(self, until_ns: int) -> None:
        """Wait as the port does."""
        self._port.wait(until_ns)

    def close(self) -> None:
        """Close the port; the writer stays open."""
        self._port.close()
