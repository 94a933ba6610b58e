"""Logs of a bus in any form that python-can writes and reads: BLF for Vector's tools, ASC, TRC; candump by our own.

The suffix names the form: ``.blf``, ``.asc``, ``.trc``, and ``.log``, ``.txt`` or none for candump, as which a file of
any other name is read too.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, Any

import can

from canprobe.bus.candump import format_line, read_candump
from canprobe.bus.port import EFF_FLAG, ERR_BUS, ERR_FLAG, RTR_FLAG
from canprobe.errors import UsageError
from canprobe.whole_file import whole_file

_READERS: dict[str, Any] = {".asc": can.ASCReader, ".blf": can.BLFReader, ".trc": can.TRCReader}
_WRITERS: dict[str, Any] = {".asc": can.ASCWriter, ".blf": can.BLFWriter, ".trc": can.TRCWriter}
_Logged = tuple[int, str, int, bytes]
FOREIGN = tuple(_READERS)
"""Suffixes of the forms that python-can writes and reads for us."""
_CANDUMP = (".log", ".txt", "")
_STANDARD_MASK, _EXTENDED_MASK = 0x7FF, 0x1FFFFFFF


def read_log(path: str | Path) -> Iterator[_Logged]:
    """Read a log in the form that its suffix names.

    Yields:
        (t_ns, channel, can_id, data) of each frame, as `read_candump`; channels that a form numbers are can0, can1, ….

    Raises:
        UsageError: the file cannot be read, or is not of that form.
    """
    make_reader = _READERS.get(Path(path).suffix.lower())
    if make_reader is None:
        yield from read_candump(path)
        return
    try:  # a file of our own, as python-can leaves its one open where it is no log
        with (
            open(path, "rb") if make_reader is can.BLFReader else open(path, encoding="utf-8", errors="replace") as file
        ):
            for message in make_reader(file):
                channel = message.channel if isinstance(message.channel, str) else f"can{message.channel or 0}"
                yield round(message.timestamp * 1e6) * 1000, channel, _can_id(message), bytes(message.data)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from error
    except (ValueError, can.CanError, KeyError, IndexError, struct.error) as error:
        raise UsageError(f"{path}: no {Path(path).suffix} log: {error}") from error


def convert_log(source: str | Path, target: Path) -> int:
    """Write a log in another form; both are named by their suffixes.

    Args:
        source: any log.
        target: written anew.

    Returns:
        How many frames.

    Raises:
        UsageError: source and target are one file, one of them cannot be opened, the source is no log, or the target's
            suffix names no form.
        ResultsError: the target cannot be written; an older one is as it was.
    """
    form = target.suffix.lower()
    if form not in (*FOREIGN, *_CANDUMP):
        raise UsageError(f"{target}: expected .log (candump), {', '.join(FOREIGN)}, got {target.suffix}")
    if target.exists() and target.samefile(source):
        raise UsageError(f"{target}: a log cannot be converted into itself")
    write = _write_candump if form in _CANDUMP else _write_foreign
    with (
        whole_file(target) as part,
        part.open("wb") if form == ".blf" else part.open("w", encoding="utf-8", newline="\n") as file,
    ):
        return write(read_log(source), file, target)


def _write_candump(frames: Iterable[_Logged], file: IO[Any], _: Path) -> int:
    count = 0
    for t_ns, channel, can_id, data in frames:
        file.write(format_line(channel, can_id, data, t_ns))
        count += 1
    return count


def _write_foreign(frames: Iterable[_Logged], file: IO[Any], target: Path) -> int:
    count = 0
    with _WRITERS[target.suffix.lower()](file) as writer:
        if isinstance(writer, can.TRCWriter):
            writer.filepath = str(target.absolute())  # stands in its header
        for frame in frames:
            writer.on_message_received(_message(*frame))
            count += 1
    return count


def _can_id(message: can.Message) -> int:
    if message.is_error_frame:  # most of these formats say no more than that there was an error
        return ERR_FLAG | (int(message.arbitration_id) or ERR_BUS)
    flags = (EFF_FLAG if message.is_extended_id else 0) | (RTR_FLAG if message.is_remote_frame else 0)
    return int(message.arbitration_id) | flags


def _message(t_ns: int, channel: str, can_id: int, data: bytes) -> can.Message:
    extended = bool(can_id & EFF_FLAG)
    return can.Message(
        timestamp=t_ns * 1e-9,
        arbitration_id=can_id & (_EXTENDED_MASK if extended else _STANDARD_MASK),
        is_extended_id=extended,
        is_remote_frame=bool(can_id & RTR_FLAG),
        is_error_frame=bool(can_id & ERR_FLAG),
        data=data,
        is_fd=len(data) > 8,
        bitrate_switch=len(data) > 8,
        channel=channel,
    )
