"""Files that are whole or not there."""

from __future__ import annotations

import pytest

from canprobe.whole_file import whole_file

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
