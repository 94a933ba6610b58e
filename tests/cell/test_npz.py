"""Files of a run that are cut off, empty or something else: one line that names the file, from every reader."""

import io
import re

import numpy as np
import pytest

import canprobe
from canprobe.cell.npz import read_npz
from canprobe.errors import UsageError


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
@pytest.mark.parametrize(("read", "what"), [(read_npz, "an .npz of a run"), (canprobe.load_table, "the log of a run")])
def test_a_damaged_file_is_named(content, read, what, tmp_path):
    (tmp_path / "log.npz").write_bytes(content)
    with pytest.raises(UsageError, match=rf"log\.npz: expected {re.escape(what)}; cannot be read: "):
        read(tmp_path / "log.npz")


def test_a_whole_one_is_read(tmp_path):
    (tmp_path / "log.npz").write_bytes(WHOLE)
    assert read_npz(tmp_path / "log.npz")["t_s"].tolist() == [0.0, 1.0, 2.0]
