"""Logs of other tools: what python-can has written is read as a log of candump is, and what is damaged is an error."""

from __future__ import annotations

from pathlib import Path

import can
import pytest

from canprobe.errors import UsageError
from canprobe.fieldbus import read_candump
from canprobe.fieldbus.bus.logs import MAKERS, open_log
from canprobe.fieldbus.bus.port import is_bus_error
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG
from canprobe.fieldbus.tools.judge.bus_frame import read_record

CLASSIC = [
    can.Message(timestamp=0.0, arbitration_id=0x80, data=[1], is_extended_id=False, channel=1),
    can.Message(timestamp=0.0025, arbitration_id=0x181, data=range(8), is_extended_id=False, channel=1),
    can.Message(timestamp=0.5, arbitration_id=0x18FF0001, data=[0xAA], is_extended_id=True, channel=1),
    can.Message(timestamp=1.25, arbitration_id=0x701, dlc=1, is_remote_frame=True, is_extended_id=False, channel=1),
]
READ = [
    (0, "can1", 0x80, b"\1"),
    (2_500_000, "can1", 0x181, bytes(range(8))),
    (500_000_000, "can1", 0x18FF0001 | EFF_FLAG, b"\xaa"),
    (1_250_000_000, "can1", 0x701 | RTR_FLAG, b""),
]
FD = can.Message(timestamp=2.0, arbitration_id=0x201, data=range(16), is_extended_id=False, is_fd=True, channel=1)
ERROR = can.Message(timestamp=3.0, is_error_frame=True, channel=1)
WRITTEN = [suffix for suffix in MAKERS if suffix != ".mf4"]
"""Suffixes of logs that python-can writes without a further package."""


def written(path: Path, messages: list[can.Message]) -> Path:
    with can.Logger(path) as log:
        for message in messages:
            log(message)
    return path


@pytest.mark.parametrize("suffix", [*WRITTEN, ".log.gz", ".asc.gz", ".TRC"])
def test_frames_clocks_and_channels_are_kept(tmp_path, suffix):
    path = written(tmp_path / f"bus{suffix}", CLASSIC if "trc" not in suffix.lower() else CLASSIC[:3])
    read = list(open_log(path))
    wanted = READ[: len(read)]
    assert len(read) == len(CLASSIC) - ("trc" in suffix.lower())
    if suffix in (".csv", ".db"):  # which have no channel
        wanted = [(t_ns, "can0", can_id, data) for t_ns, _, can_id, data in wanted]
    for (t_ns, *frame), (wanted_ns, *expected) in zip(read, wanted, strict=True):
        assert frame == expected and t_ns - read[0][0] == pytest.approx(wanted_ns, abs=1000)
    assert list(open_log(path)) == read, "it is read twice"


@pytest.mark.parametrize("suffix", [".asc", ".blf"])
def test_fd_and_error_frames_are_what_they_are(tmp_path, suffix):
    (_, _, can_id, data), (*_, error_id, _) = open_log(written(tmp_path / f"bus{suffix}", [FD, ERROR]))
    assert (can_id, data) == (0x201, bytes(range(16))) and is_bus_error(error_id)


def test_asc_with_differences_and_with_classic_frames_of_an_fd_channel(tmp_path):
    """Lines as CANoe writes them; python-can takes each stamp for a time, and an empty frame for a remote one."""
    path = tmp_path / "bus.asc"
    lines = [
        "date Fri Jan 3 09:21:38.000 am 2020",
        "base hex  timestamps relative",
        "internal events logged",
        "Begin Triggerblock Fri Jan 3 09:21:38.000 am 2020",
        "   0.002000 CANFD   1 Rx         80                                  0 0 0  0   80000  100   1000 0 0 0 0",
        "   0.002000 CANFD   1 Rx        181                                  0 0 1  1 05   80000  100   1000 0 0 0 0",
        "   0.001000 1  181             Rx   d 1 06",
        "End TriggerBlock",
    ]
    path.write_text("\n".join(lines))
    assert list(open_log(path)) == [
        (2_000_000, "can0", 0x80, b""),
        (4_000_000, "can0", 0x181, b"\5"),
        (5_000_000, "can0", 0x181, b"\6"),
    ]


def test_other_files_are_those_of_candump(tmp_path):
    path = tmp_path / "bus.txt"
    path.write_text("(0000000000.000000) can1 080#01\n")
    assert list(open_log(path)) == list(read_candump(path)) == READ[:1]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # python-can leaves its .blf open
@pytest.mark.parametrize("suffix", [*WRITTEN, ".asc.gz"])
def test_what_is_no_log_is_an_error_with_its_place(tmp_path, suffix):
    path = tmp_path / f"bus{suffix}"
    path.write_bytes(b"\xff\x00 nothing of a log\n" * 20)
    with pytest.raises(
        UsageError, match=r"bus\S*: python-can finds no .* log of .* at its beginning|has no frames|Not a gzipped file"
    ):
        list(read_record(path))
    with pytest.raises(UsageError, match="No such file"):
        list(open_log(tmp_path / f"none{suffix}"))


def test_a_log_that_needs_a_package_says_which(tmp_path):
    path = tmp_path / "bus.mf4"
    path.write_bytes(b"MDF     4.10")
    with pytest.raises(UsageError, match="pip install asammdf"):
        list(open_log(path))


@pytest.mark.parametrize("suffix", [".asc", ".trc"])
def test_a_log_that_ends_amid_a_line_is_judged_or_refused_and_never_a_fault(tmp_path, suffix):
    path = written(tmp_path / f"bus{suffix}", CLASSIC[:3])
    whole = path.read_bytes()
    for length in range(0, len(whole), 23):
        path.write_bytes(whole[:length])
        try:
            frames = list(read_record(path))
        except UsageError as error:
            assert str(path) in str(error)
        else:
            assert len(frames) <= 3
