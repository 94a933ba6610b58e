"""Files that are whole or not there."""

import os

import pytest

from canprobe.errors import ResultsError
from canprobe.fieldbus import CandumpWriter
from canprobe.fieldbus.bus.files import make_folder, whole_file, write_text

WHOLE_TEXT = b"what was there before"


@pytest.mark.parametrize("older", [True, False])
@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_a_file_is_written_whole_or_not_at_all(error, older, tmp_path):
    path = tmp_path / "log.npz"
    if older:
        path.write_bytes(WHOLE_TEXT)
    with pytest.raises((KeyboardInterrupt, ResultsError)) as raised, whole_file(path) as part:
        assert part.suffix == ".npz"  # by which libraries choose what they write
        part.write_bytes(b"PK")
        raise error
    if isinstance(error, OSError):
        assert str(raised.value) == f"{path}: cannot be written: No space left on device"
    assert [(file, file.read_bytes()) for file in tmp_path.iterdir()] == [(path, WHOLE_TEXT)] * older


def test_where_no_file_can_be_it_is_named(tmp_path):
    with pytest.raises(ResultsError, match=r"none/a\.txt: cannot be written: No such file or directory"):
        write_text(tmp_path / "none" / "a.txt", "")
    (tmp_path / "way").write_text("")
    with pytest.raises(ResultsError, match=r"way/in/it: cannot be written: Not a directory"):
        make_folder(tmp_path / "way" / "in" / "it")
    with pytest.raises(ResultsError, match=r"way: cannot be written: File exists"):
        make_folder(tmp_path / "way")
    with pytest.raises(ResultsError, match=r": cannot be written: Is a directory"):
        CandumpWriter(tmp_path, "can0")


def test_a_block_that_writes_nothing_changes_nothing(tmp_path):
    with whole_file(tmp_path / "surface.png"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path):
    link, file = tmp_path / "link", tmp_path / "file"
    file.write_bytes(WHOLE_TEXT)
    link.symlink_to(file)
    write_text(link, "new")
    assert link.is_symlink() and file.read_text() == "new"
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "told")
    assert os.read(reader, 10) == b"told" and pipe.is_fifo()
    os.close(reader)
