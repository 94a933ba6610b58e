"""candump logs: written and read back, against lines that candump itself writes."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.bus.candump import CandumpWriter, RecordingPort, read_candump
from canprobe.bus.clock import VirtualClock
from canprobe.bus.lockstep import LockstepBus
from canprobe.bus.port import EFF_FLAG, ERR_FLAG, RTR_FLAG
from canprobe.errors import UsageError

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


def test_recording_port_writes_both_directions(tmp_path: Path) -> None:
    bus = LockstepBus(VirtualClock(), "can0")
    one, two = bus.port(), bus.port()
    with CandumpWriter(tmp_path / "x", "can0") as writer:
        port = RecordingPort(one, writer)
        port.send_batch([(0x080, b"\1"), (0x201, b"\2")])
        port.clock.sleep_until_ns(2_500_000)
        two.send_batch([(0x181, b"\3")])
        port.wait(3_000_000)
        assert port.drain() == [(0x181, b"\3", 2_500_000)]
        port.close()
    assert (port.channel, two.drain()) == ("can0", [(0x080, b"\1", 0), (0x201, b"\2", 0)])
    assert [(t, i, d) for t, _, i, d in read_candump(tmp_path / "x")] == [
        (0, 0x080, b"\1"),
        (0, 0x201, b"\2"),
        (2_500_000, 0x181, b"\3"),
    ]


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
