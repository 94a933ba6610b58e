"""Files that are whole or not there."""

from __future__ import annotations

import os

import pytest

from canprobe.whole_file import whole_file, write_text

WHOLE = b"what was there before"


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device", "x")])
def test_a_file_is_written_whole_or_not_at_all(error, tmp_path):
    path = tmp_path / "log.npz"
    path.write_bytes(WHOLE)
    with pytest.raises(BaseException) as raised, whole_file(path) as part:
        part.write_bytes(b"PK")
        raise error
    if isinstance(error, OSError):  # an old file beside new ones would be taken for one of them
        assert list(tmp_path.iterdir()) == [] and raised.value.filename == str(path)
    else:
        assert list(tmp_path.iterdir()) == [path] and path.read_bytes() == WHOLE


def test_a_link_stays_a_link_and_a_device_a_device(tmp_path):
    link, file = tmp_path / "link", tmp_path / "file"
    file.write_bytes(WHOLE)
    link.symlink_to(file)
    write_text(link, "new")
    assert link.is_symlink() and file.read_text() == "new"
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "told")
    assert os.read(reader, 10) == b"told" and pipe.is_fifo()
    os.close(reader)
