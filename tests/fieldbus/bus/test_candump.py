"""candump logs: written and read back, against lines that candump itself writes."""

import bz2
import contextlib
import gzip
import lzma
import os
import re
import struct
import subprocess
import threading
from pathlib import Path

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import CandumpReader, CandumpWriter, read_candump
from canprobe.fieldbus.bus.clock_steps import RecordedBus
from canprobe.fieldbus.bus.port import ERR_FLAG
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

LINES = [
    ("(0000000000.002500) can0 181#37060000", (2_500_000, "can0", 0x181, b"\x37\x06\0\0")),
    ("(0000000000.000000) vcan0 080#", (0, "vcan0", 0x080, b"")),
    ("(1436509052.249713) vcan0 044#2A366C2BBA", (1436509052249713000, "vcan0", 0x044, b"\x2a\x36\x6c\x2b\xba")),
    ("(0000000001.000001) can0 00000001#01", (1_000_001_000, "can0", 1 | EFF_FLAG, b"\1")),
    ("(0000000001.000001) can0 1FFFFFFF#0102030405060708", (1_000_001_000, "can0", 0x9FFFFFFF, bytes(range(1, 9)))),
    ("(0000000001.000001) can0 701#R", (1_000_001_000, "can0", 0x701 | RTR_FLAG, b"")),
]


@pytest.mark.parametrize(("line", "frame"), LINES, ids=[line[20:] for line, _ in LINES])
def test_lines_both_ways(tmp_path: Path, line: str, frame: tuple[int, str, int, bytes]) -> None:
    t_ns, channel, can_id, data = frame
    log = tmp_path / "bus.log"
    with CandumpWriter(log, channel) as writer:
        writer.write(can_id, data, t_ns)
    assert log.read_bytes() == line.encode() + b"\n"
    assert list(read_candump(log)) == [frame]


@pytest.mark.parametrize(
    ("line", "frame"),
    [
        ("(0000000000.000001) can0 181#0a T", (1000, "can0", 0x181, b"\x0a")),
        ("(0000000000.000001) can0 701#R1", (1000, "can0", 0x701 | RTR_FLAG, b"")),
        ("(0000000000.000001234) can0 181#0A", (1234, "can0", 0x181, b"\x0a")),
        ("(000.000001)  can0 181#0A", (1000, "can0", 0x181, b"\x0a")),
        ("(0000000000.000001) can0 181#0102030405060708_F", (1000, "can0", 0x181, bytes(range(1, 9)))),
        ("(0000000000.000001) can0 701#R8_9", (1000, "can0", 0x701 | RTR_FLAG, b"")),
        ("(0000000000.000001) can0 20000004#0000000000000000", (1000, "can0", ERR_FLAG | 4, bytes(8))),
    ],
)
def test_lines_of_other_writers_are_read(tmp_path: Path, line: str, frame: tuple[int, str, int, bytes]) -> None:
    log = tmp_path / "bus.log"
    log.write_text(line + "\r\n\n")
    assert list(read_candump(log)) == [frame]


@pytest.mark.parametrize(
    "line",
    [
        "(0000000000.0025) can0 181#00",
        "(0000000000.002500) can0 1811#00",
        "(0000000000.002500) can0 181#001",
        "(0000000000.002500) can0 181#" + "00" * 9,
        "(0000000000.002500) can0 181##1" + "00" * 65,
        "(0000000000.002500) can0 181##0011",
        "(0000000000.002500) can0 181#00 X",
        "(0000000000.0025001) can0 181#00",
        "(0000000000.002500) can0 181#00_F",
        "(0000000000.002500) can0 181#0102030405060708_8",
        "(0000000000.002500) can0 45123#81:00:1234567#11",
        "DROPCOUNT: dropped some CAN frames",
        " (0000000000.002500) can0 181#00",
        "0.002500 can0 181#00",
        "can0  181   [1]  00",
    ],
)
def test_anything_else_is_refused_with_its_line_number(tmp_path: Path, line: str) -> None:
    log = tmp_path / "bus.log"
    log.write_text(f"{LINES[0][0]}\n{line}\n")
    with pytest.raises(UsageError, match=r"bus\.log:2: "):
        list(read_candump(log))


def test_lines_for_lost_frames_and_of_can_xl_are_counted_and_no_frames(tmp_path: Path) -> None:
    log = tmp_path / "bus.log"
    log.write_text(
        f"{LINES[0][0]}\n"
        "DROPCOUNT: dropped 1 CAN frame on 'can0' socket (total drops 1)\n"
        "DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 4)\n"
        "(0000000000.002600) vcan0 45123#81:00:12345678#11223344\n"
    )
    reader = CandumpReader(log)
    for _ in range(2):
        assert list(reader) == [LINES[0][1]]
        assert (reader.lost, reader.xl) == ({"can0": 4}, {"vcan0": 1})


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_a_log_that_another_system_wrote_again_is_read(tmp_path: Path, encoding: str) -> None:
    log = tmp_path / "bus.log"
    log.write_text("".join(f"{line}\r\n" for line, _ in LINES), encoding=encoding)
    assert list(read_candump(log)) == [frame for _, frame in LINES]


PCAP = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 227)


@pytest.mark.parametrize(
    ("name", "head", "told"),
    [
        ("a b.pcap", PCAP, "a capture of tcpdump or Wireshark (pcap), not a candump log; type: tshark -r '"),
        ("x.pcap", struct.pack(">I", 0xA1B23C4D), "a capture of tcpdump or Wireshark (pcap), not a candump log"),
        ("x.pcapng", b"\n\r\r\n\x1c\0\0\0", "a capture of Wireshark (pcapng), not a candump log; type: tshark -r"),
        ("x.log.xz", lzma.compress(b"(1.000000) can0 123#00\n"), "compressed by xz, not a candump log; type: xzcat < "),
        ("x.blf", b"LOGG" + bytes(140), "a log of Vector's tools (BLF), not a candump log; type: can_logconvert"),
        ("x.xdd", b"<?xml version='1.0'?>\n", "XML, as XDD and XDC files are, not a candump log"),
    ],
)
def test_a_file_of_another_kind_is_named_as_what_it_is(tmp_path: Path, name: str, head: bytes, told: str) -> None:
    path = tmp_path / name
    path.write_bytes(head)
    with pytest.raises(UsageError, match=re.escape(f"{path}: {told}")):
        list(read_candump(path))


def test_the_way_out_of_a_compressed_log_works_as_it_is_typed(tmp_path: Path) -> None:
    path = tmp_path / "my log.bz2"
    path.write_bytes(bz2.compress(b"(1.000000) can0 123#00\n"))
    with pytest.raises(UsageError) as raised:
        list(read_candump(path))
    subprocess.run(str(raised.value).rpartition("type: ")[2], shell=True, check=True, cwd=tmp_path)
    assert list(read_candump(tmp_path / "bus.log")) == [(1_000_000_000, "can0", 0x123, b"\0")]


# printed by log2long of can-utils 2020.11.0, which prints as candump does
ON_SCREEN = [
    ("044   [5]  2A 36 6C 2B BA            '*6l+.'", 0x044, "2a366c2bba"),
    ("0800AABB   [8]  01 02 03 04 05 06 07 08   '........'", 0x0800AABB | EFF_FLAG, "0102030405060708"),
    ("701   [0]  remote request", 0x701 | RTR_FLAG, ""),
    ("080   [0] ", 0x080, ""),
    ("20000004   [8]  00 00 00 00 00 00 00 00   ERRORFRAME", ERR_FLAG | 4, "00" * 8),
    ("201  [12]  00 01 02 03 04 05 06 07 08 09 0A 0B", 0x201, "000102030405060708090a0b"),
]


@pytest.mark.parametrize(
    ("stamps", "times_ms"),
    [
        (("", "", "", ""), (0, 0, 0, 0)),
        (("(1436509052.250000) ", "(1436509052.252000) "), (1436509052250, 1436509052252)),
        (("(2015-07-10 06:17:32.250000) ", "(2015-07-10 06:17:32.252000000) "), (1436509052250, 1436509052252)),
        (("(000.000000) ", "(000.002000) ", "(000.004000) ", "(000.009000) "), (0, 2, 4, 9)),  # -tz
        (("(000.000000) ", "(000.002000) ", "(000.002000) ", "(000.001000) "), (0, 2, 4, 5)),  # -td
    ],
)
@pytest.mark.parametrize("channel", [" vcan0  ", "  vcan0  RX - -  ", " vcan0  TX B E       "])
def test_what_candump_prints_on_a_screen_is_read(tmp_path: Path, stamps, times_ms, channel: str) -> None:
    log = tmp_path / "screen.txt"
    for text, can_id, data in ON_SCREEN:
        lines = [f" {stamp}{channel}{text}\n" for stamp in stamps]
        log.write_text("\tcontroller-problem{}\n".join(lines) + lines[0][:-4])  # -e, and a line that is torn
        wanted = [(ms * 1_000_000, "vcan0", can_id, bytes.fromhex(data)) for ms in times_ms]
        assert list(read_candump(log))[: len(stamps)] == wanted


def test_a_line_on_a_screen_that_is_torn_is_none(tmp_path: Path) -> None:
    log = tmp_path / "screen.txt"
    for torn, read in (("  can0  181   [2]  0A", 1), ("  can0  181   [2]  0A\n", None)):
        log.write_text("  can0  701   [1]  05\n" + torn)
        if read is not None:
            assert len(list(read_candump(log))) == read
        else:
            with pytest.raises(UsageError, match=r"screen\.txt:2: no candump line"):
                list(read_candump(log))


def test_differences_in_a_log_become_times_and_times_stay(tmp_path: Path) -> None:
    log = tmp_path / "bus.log.gz"  # stamps by channel grow, although lines of two channels are out of order
    log.write_bytes(gzip.compress(b"(000.000000) can0 080#\n(000.003000) can1 080#\n(000.002000) can0 080#\n"))
    assert [frame[0] for frame in read_candump(log)] == [0, 3_000_000, 2_000_000]
    log.write_bytes(gzip.compress(b"(000.000000) can0 080#\n" + b"(000.010000) can0 080#\n" * 20, mtime=0))
    assert [frame[0] for frame in read_candump(log)] == [10_000_000 * k for k in range(21)]
    log.write_bytes(log.read_bytes()[:-9])
    with pytest.raises(UsageError, match=r"bus\.log\.gz: "):
        list(read_candump(log))


def test_a_log_that_comes_through_a_pipe_is_read_twice(tmp_path: Path) -> None:
    os.mkfifo(pipe := tmp_path / "pipe")
    writer = threading.Thread(target=pipe.write_text, args=(LINES[0][0] + "\n",))
    writer.start()
    assert list(RecordedBus(pipe)) == [LINES[0][1]]
    writer.join()


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none\.log: No such file"):
        list(read_candump(tmp_path / "none.log"))


@given(st.text(max_size=60))
def test_random_text_raises_only_its_own_error(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    log = tmp_path_factory.getbasetemp() / "random.log"
    log.write_text(text, encoding="utf-8")
    with contextlib.suppress(UsageError):
        list(read_candump(log))


def test_time_starts_at_t0_and_ns_are_cut(tmp_path: Path) -> None:
    with CandumpWriter(tmp_path / "x", "can0", t0_ns=5_000_000_000) as writer:
        writer.write(0x80, b"", 5_000_001_999)
    assert (tmp_path / "x").read_text() == "(0000000000.000001) can0 080#\n"


def test_a_torn_last_line_is_passed_over_unless_the_log_should_be_whole(tmp_path):
    path, line = tmp_path / "bus.log", "(0000000000.002500) vcan0 080#01\n"
    path.write_text(line + line[:20])
    assert len(list(read_candump(path))) == 1
    with pytest.raises(UsageError, match=r"bus\.log:2: no candump line"):
        list(read_candump(path, whole=True))
    path.write_text(line + line.rstrip())  # an editor's last line: not torn
    assert len(list(read_candump(path))) == len(list(read_candump(path, whole=True))) == 2
    path.write_text(line[:20] + "\n" + line)
    with pytest.raises(UsageError, match=r"bus\.log:1: no candump line"):
        list(read_candump(path))


FRAMES = [
    (0, "can0", 0x080, b"\x01"),
    (2_500_000, "can0", 0x181, bytes(range(8))),
    (2_501_000, "can0", 0x201 | RTR_FLAG, b""),
    (5_000_000, "can1", 0x18FF0102 | EFF_FLAG, b"\xaa\xbb"),
    (7_500_000, "can0", 0x531, bytes(range(64))),
]


def test_python_can_reads_a_log_of_ours_with_its_fd_frames(tmp_path):
    path = tmp_path / "bus.log"
    with CandumpWriter(path, "can0") as writer:
        for t_ns, channel, can_id, data in FRAMES:
            writer.on(channel)(can_id, data, t_ns)
    assert list(read_candump(path)) == FRAMES
    assert path.read_text().splitlines()[-1] == f"(0000000000.007500) can0 531##1{bytes(range(64)).hex().upper()}"
    messages = list(can.CanutilsLogReader(path))
    assert [message.arbitration_id for message in messages] == [0x080, 0x181, 0x201, 0x18FF0102, 0x531]
    assert [bytes(message.data) for message in messages] == [data for *_, data in FRAMES]
    assert [message.is_fd and message.bitrate_switch for message in messages] == [False] * 4 + [True]
    assert [message.is_remote_frame for message in messages] == [False, False, True, False, False]
    assert [message.channel for message in messages] == [channel for _, channel, _, _ in FRAMES]
    assert [message.timestamp for message in messages] == pytest.approx([0, 2.5e-3, 2.501e-3, 5e-3, 7.5e-3], abs=1e-9)
