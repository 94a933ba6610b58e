"""Logs of a bus by their suffix: candump's, and those of other tools that python-can reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.candump import CandumpLine, CandumpReader, with_times
from canprobe.fieldbus.bus.port import ERR_BUS, ERR_FLAG
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

MAKERS = {
    ".asc": "of Vector's tools",
    ".blf": "of Vector's tools",
    ".csv": "of python-can",
    ".db": "of python-can",
    ".mf4": "of ASAM MDF",
    ".trc": "of PEAK's tools",
}
"""Suffixes of logs that python-can reads, and whose they are: other tools have their own files with these suffixes."""


class ForeignLog:
    """Reads a log of another tool through python-can: an iterable of `CandumpLine`, with the attributes of a
    `CandumpReader`. Channels that are numbers are called as SocketCAN does it: the first is `can0`.

    Args:
        path: path of the log, which may have .gz behind its suffix.
        suffix: its suffix, one of `MAKERS`.
    """

    def __init__(self, path: str | Path, suffix: str) -> None:
        self.number = 0
        self.lost: Counter[str] = Counter()
        self.xl: Counter[str] = Counter()
        self._path, self._suffix = Path(path), suffix
        self._has_differences = False

    def __iter__(self) -> Iterator[CandumpLine]:
        """Yield the frames.

        Raises:
            UsageError: the file cannot be read, or python-can finds no log in it; with the number of the message.
        """
        next(self._frames(), None)
        yield from with_times(self._frames) if self._has_differences else self._frames()

    def _frames(self) -> Iterator[CandumpLine]:
        import can  # here, as a log of candump is read without it

        self.number = 0
        first_channel = 1 if self._suffix == ".trc" else 0
        try:
            with can.LogReader(regular_file(self._path)) as reader:
                for self.number, message in enumerate(reader, 1):
                    self._has_differences = getattr(reader, "timestamps_format", None) == "relative"
                    yield _frame_of(message, first_channel)
        except OSError as error:
            raise UsageError(f"{self._path}: {error.strerror or error}") from error
        except (ImportError, NotImplementedError) as error:
            raise UsageError(f"{self._path}: python-can reads it with a package: pip install asammdf") from error
        except GeneratorExit:
            raise
        except Exception as error:  # python-can has no error of its own for a file that is damaged
            place = f"behind message {self.number}" if self.number else "at its beginning"
            raise UsageError(
                f"{self._path}: python-can finds no {self._suffix} log {MAKERS[self._suffix]} {place}:"
                f" {type(error).__name__}: {error}; let the tool that wrote it export .asc, .blf or PEAK's .trc"
            ) from error


def open_log(path: str | Path) -> CandumpReader | ForeignLog:
    """The reader of a log; a file with another suffix than those of `MAKERS` is one of candump."""
    suffixes = [suffix.lower() for suffix in Path(path).suffixes if suffix.lower() != ".gz"]
    return ForeignLog(path, suffixes[-1]) if suffixes and suffixes[-1] in MAKERS else CandumpReader(path)


def _frame_of(message: Any, first_channel: int) -> CandumpLine:
    can_id = message.arbitration_id
    if message.is_error_frame:
        can_id = ERR_FLAG | ERR_BUS  # classes of errors are SocketCAN's
    elif message.is_extended_id:
        can_id |= EFF_FLAG
    if message.is_remote_frame and not (message.is_fd and message.dlc == 0):  # .asc: an empty frame of an FD channel
        can_id |= RTR_FLAG
    channel = message.channel or 0
    name = f"can{max(channel - first_channel, 0)}" if isinstance(channel, int) else str(channel)
    return round(message.timestamp * 1e9), name, can_id, bytes(message.data)
