"""Logs of a bus by their suffix: candump's, and those of other tools that python-can reads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from canprobe.errors import UsageError, regular_file
from canprobe.fieldbus.bus.candump import CandumpLine, CandumpReader
from canprobe.fieldbus.bus.port import ERR_FLAG
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

SUFFIXES = (".asc", ".blf", ".csv", ".db", ".mf4", ".trc")
"""Suffixes of logs that python-can reads: of Vector's and PEAK's tools, its own tables, and ASAM MDF."""


class ForeignLog:
    """Reads a log of another tool through python-can: an iterable of `CandumpLine`, with the attributes of a
    `CandumpReader`. Channels that are numbers are called as SocketCAN does it: 0 is `can0`.

    Args:
        path: path of the log; its suffix is one of `SUFFIXES`, or has .gz behind it.
    """

    def __init__(self, path: str | Path) -> None:
        self.number = 0
        self.lost: Counter[str] = Counter()
        self.xl: Counter[str] = Counter()
        self._path = Path(path)

    def __iter__(self) -> Iterator[CandumpLine]:
        """Yield the frames.

        Raises:
            UsageError: the file cannot be read, or python-can finds no log in it; with the number of the message.
        """
        import can  # here, as a log of candump is read without it

        self.number = 0
        try:
            with can.LogReader(regular_file(self._path)) as reader:
                for self.number, message in enumerate(reader, 1):
                    yield _frame_of(message)
        except OSError as error:
            raise UsageError(f"{self._path}: {error.strerror or error}") from error
        except (ImportError, NotImplementedError) as error:
            raise UsageError(f"{self._path}: python-can reads it with a package: pip install asammdf") from error
        except GeneratorExit:
            raise
        except Exception as error:  # python-can has no error of its own for a file that is damaged
            place = f"behind message {self.number}" if self.number else "at its beginning"
            raise UsageError(
                f"{self._path}: python-can finds no {self._path.suffix} log {place}: {type(error).__name__}: {error}"
            ) from error


def open_log(path: str | Path) -> CandumpReader | ForeignLog:
    """The reader of a log; a file with another suffix than those of `SUFFIXES` is one of candump."""
    suffixes = [suffix.lower() for suffix in Path(path).suffixes]
    packed = suffixes[-1:] == [".gz"]
    kind = suffixes[-2:-1] if packed else suffixes[-1:]
    foreign = kind and (kind[0] in SUFFIXES or (packed and kind[0] == ".log"))
    return ForeignLog(path) if foreign else CandumpReader(path)


def _frame_of(message: Any) -> CandumpLine:
    can_id = message.arbitration_id
    if message.is_error_frame:
        can_id |= ERR_FLAG
    elif message.is_extended_id:
        can_id |= EFF_FLAG
    if message.is_remote_frame:
        can_id |= RTR_FLAG
    channel = message.channel
    name = f"can{channel or 0}" if channel is None or isinstance(channel, int) else str(channel)
    return round(message.timestamp * 1e9), name, can_id, bytes(message.data)
