"""Files of a run that are cut off, empty or something else: one line that names the file, from every reader."""

import io

import numpy as np
import pytest

import canprobe
from canprobe.errors import UsageError
from canprobe.npz_file import read_npz, whole_file


def npz(**columns):
    held = io.BytesIO()
    np.savez_compressed(held, **columns)
    return held.getvalue()


def npy(values):
    held = io.BytesIO()
    np.save(held, values)
    return held.getvalue()


WHOLE = npz(t_s=np.arange(3.0))
DAMAGED = {"empty": b"", "cut off": WHOLE[:-9], "torn": b"PK", "text": b"t_s\n0\n", "single array": npy(np.arange(3.0))}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
@pytest.mark.parametrize("read", [read_npz, canprobe.load_table], ids=["read_npz", "load_table"])
def test_a_damaged_file_is_named(content, read, tmp_path):
    (tmp_path / "log.npz").write_bytes(content)
    with pytest.raises(UsageError, match=r"log\.npz: expected an \.npz of a run"):
        read(tmp_path / "log.npz")


def test_a_whole_one_is_read(tmp_path):
    (tmp_path / "log.npz").write_bytes(WHOLE)
    assert read_npz(tmp_path / "log.npz")["t_s"].tolist() == [0.0, 1.0, 2.0]


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
