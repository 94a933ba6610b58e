"""Logs converted between candump and python-can's forms: read back by python-can, and by ourselves."""

import can
import pytest

from canprobe.bus.candump import format_line, read_candump
from canprobe.bus.logfile import FOREIGN, convert_log, read_log
from canprobe.bus.port import EFF_FLAG, ERR_FLAG, RTR_FLAG, is_bus_error
from canprobe.cli import main
from canprobe.errors import UsageError

FRAMES = [
    (0, "can0", 0x080, b"\x01"),
    (2_500_000, "can0", 0x181, bytes(range(8))),
    (2_501_000, "can0", 0x201 | RTR_FLAG, b""),
    (5_000_000, "can1", 0x18FF0102 | EFF_FLAG, b"\xaa\xbb"),
    (7_500_000, "can0", 0x531, bytes(range(64))),
]


@pytest.fixture
def candump(tmp_path):
    path = tmp_path / "bus.log"
    path.write_text("".join(format_line(name, can_id, data, t_ns) for t_ns, name, can_id, data in FRAMES))
    return path


def test_fd_frames_stand_in_candump_as_can_utils_writes_them(candump):
    assert list(read_candump(candump)) == FRAMES
    assert candump.read_text().splitlines()[-1] == f"(0000000000.007500) can0 531##1{bytes(range(64)).hex().upper()}"


def test_blf_is_read_by_python_can(candump, tmp_path):
    assert convert_log(candump, tmp_path / "bus.blf") == len(FRAMES)
    with can.BLFReader(tmp_path / "bus.blf") as reader:
        messages = list(reader)
    assert [message.arbitration_id for message in messages] == [0x080, 0x181, 0x201, 0x18FF0102, 0x531]
    assert [bytes(message.data) for message in messages] == [data for *_, data in FRAMES]
    assert [message.is_fd for message in messages] == [False] * 4 + [True]
    assert [message.is_remote_frame for message in messages] == [False, False, True, False, False]
    assert [message.channel for message in messages] == [0, 0, 0, 1, 0]
    assert [message.timestamp for message in messages] == pytest.approx([0, 2.5e-3, 2.501e-3, 5e-3, 7.5e-3], abs=1e-9)


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_there_and_back(candump, tmp_path, suffix):
    convert_log(candump, tmp_path / f"there{suffix}")
    convert_log(tmp_path / f"there{suffix}", tmp_path / "back.log")
    frames = list(read_log(tmp_path / "back.log"))
    assert [frame[2:] for frame in frames] == [frame[2:] for frame in FRAMES]
    assert [frame[0] - frames[0][0] for frame in frames] == [frame[0] for frame in FRAMES]
    if suffix == ".blf":
        assert (tmp_path / "back.log").read_bytes() == candump.read_bytes()


@pytest.mark.parametrize("suffix", [".blf", ".asc"])
def test_an_error_frame_stays_one_though_its_class_is_lost(tmp_path, suffix):
    log = tmp_path / "bus.log"
    error = (1_000_000, "can0", ERR_FLAG | 0x088, bytes(8))
    log.write_text("".join(format_line(name, i, data, t_ns) for t_ns, name, i, data in (FRAMES[0], error)))
    convert_log(log, tmp_path / f"there{suffix}")
    (_, _, can_id, _) = list(read_log(tmp_path / f"there{suffix}"))[-1]
    assert is_bus_error(can_id)


def test_what_is_no_log_is_refused_and_leaves_nothing(candump, tmp_path):
    with pytest.raises(UsageError, match="itself"):
        convert_log(candump, candump)
    for suffix in FOREIGN:
        wrong = tmp_path / f"wrong{suffix}"
        wrong.write_bytes(b"\x00\x01no log at all")
        if suffix != ".asc":  # whose reader passes over what it does not know
            with pytest.raises(UsageError, match="wrong"):
                convert_log(wrong, tmp_path / "out.log")
            assert not (tmp_path / "out.log").exists()
    with pytest.raises(UsageError, match="No such file"):
        list(read_log(tmp_path / "none.blf"))
    with pytest.raises(UsageError, match="missing"):
        convert_log(candump, tmp_path / "missing" / "bus.blf")


def test_the_commands_write_blf(tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["run", "listen", "--duration", "0.05", "--out", str(out), "--blf"]) == 0
    assert main(["log", str(out), "--to", str(tmp_path / "again.blf")]) == 0
    assert "frames" in capsys.readouterr().out
    lines = [frame[2:] for frame in read_candump(out / "bus.log")]
    assert [frame[2:] for frame in read_log(out / "bus.blf")] == lines
    assert [frame[2:] for frame in read_log(tmp_path / "again.blf")] == lines
    assert main(["log", str(tmp_path / "none"), "--to", str(tmp_path / "x.blf")]) == 2


@pytest.mark.parametrize("name", ["run.csv", "run.mf4", "run.log.gz"])
def test_a_suffix_that_names_no_form_is_refused(candump, tmp_path, name):
    with pytest.raises(UsageError, match=r"expected \.log \(candump\), \.asc, \.blf, \.trc, got \."):
        convert_log(candump, tmp_path / name)
    assert not (tmp_path / name).exists()
