"""Rows on disk are those that would be in memory, at any moment, whatever they are multiples of."""

import numpy as np
import pytest

from canprobe.cell.master.log import RunLog
from canprobe.cell.npz import read_npz, write_npz
from canprobe.cell.rows import BLOCK_ROWS, Rows, read_left_rows


def row_of(k):
    row = {"t_s": 0.0025 * k, "q_rad": np.full(6, float(k))}
    return row | ({"force_n": -float(k), "κ": 1.0} if k % 3 == 0 else {})


@pytest.mark.parametrize("count", [1, BLOCK_ROWS, BLOCK_ROWS + 1, 3 * BLOCK_ROWS])
def test_a_log_on_disk_is_that_in_memory(count, tmp_path):
    on_disk, in_memory = RunLog(folder=tmp_path / "rows"), RunLog()
    for k in range(count):
        on_disk.add(row_of(k))
        in_memory.add(row_of(k))
    for name, column in in_memory.columns().items():
        np.testing.assert_array_equal(on_disk.columns()[name], column)
    files = sorted((tmp_path / "rows").glob("*.npy"))
    assert sum(len(np.load(file)) for file in files) == count // BLOCK_ROWS * BLOCK_ROWS
    if files:
        left = read_left_rows(tmp_path, "log")
        for name, column in in_memory.columns().items():
            stored = name.encode("ascii", "backslashreplace").decode()
            np.testing.assert_array_equal(left[stored], column[: len(left["t_s"])])
    on_disk.remove()
    assert not (tmp_path / "rows").exists()


def test_a_value_of_another_shape_costs_only_itself_on_disk_too(tmp_path):
    log = RunLog(folder=tmp_path / "rows")
    for k in range(BLOCK_ROWS + 5):
        log.add({"a": np.full(3, float(k)) if k != 7 else "x"})
    with pytest.warns(UserWarning, match=r"1 values of column 'a'"):
        column = log.columns()["a"]
    assert np.flatnonzero(np.isnan(column[:, 0])).tolist() == [7]
    assert len(read_left_rows(tmp_path, "log")["a"]) == BLOCK_ROWS - 1


def test_rows_of_one_type_in_blocks(tmp_path):
    rows = Rows([("t_s", float), ("taxels", np.uint8, (2, 2))], tmp_path / "tactile.npy")
    table = np.zeros(7, rows.dtype)
    table["t_s"], table["taxels"][:, 0, 1] = np.arange(7), np.arange(7)
    for some in (table[:3], table[3:4], table[4:]):
        rows.add(some.tobytes())
        rows.flush()
        np.testing.assert_array_equal(np.load(tmp_path / "tactile.npy"), table[: len(rows)])
    assert rows.columns()["taxels"].dtype == np.uint8
    np.testing.assert_array_equal(rows.columns()["taxels"], table["taxels"])


def test_a_large_column_is_mapped_and_can_be_changed_without_its_file(tmp_path):
    large = np.arange(3 * 65536.0).reshape(-1, 3)
    write_npz(
        tmp_path / "log.npz", {"a": np.arange(3), "long name": large, "empty": np.empty((0, 2)), "b": large[:, 0]}
    )
    with np.load(tmp_path / "log.npz") as whole:
        np.testing.assert_array_equal(whole["long name"], large)
    read = read_npz(tmp_path / "log.npz")
    np.testing.assert_array_equal(read["long name"], large)
    np.testing.assert_array_equal(read["b"], large[:, 0])
    assert read["long name"].flags.aligned and isinstance(read["long name"].base.base, np.memmap)
    assert read["empty"].shape == (0, 2)
    read["long name"][:] = 0.0
    np.testing.assert_array_equal(read_npz(tmp_path / "log.npz")["long name"], large)
