"""Rows on disk are those that would be in memory, at any moment, whatever they are multiples of."""

import gzip
import io
import math

import numpy as np
import pytest

from canprobe.cell.master.log import RunLog
from canprobe.cell.results.run_files import read_log
from canprobe.cell.rows import BLOCK_ROWS, Rows, read_left_rows
from canprobe.errors import UsageError


def loaded(file):
    """The rows of a file, read without canprobe."""
    blocks = []
    with gzip.open(file) as opened:
        while opened.peek(1):
            blocks.append(np.lib.format.read_array(opened))
    return np.concatenate(blocks)


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
    files = sorted((tmp_path / "rows").glob("*.npy.gz"))
    assert sum(map(len, map(loaded, files))) == count // BLOCK_ROWS * BLOCK_ROWS
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
    left = read_left_rows(tmp_path, "log")["a"]
    assert len(left) == BLOCK_ROWS and np.flatnonzero(np.isnan(left[:, 0])).tolist() == [7]


def test_rows_of_one_type_in_blocks(tmp_path):
    rows = Rows([("t_s", float), ("taxels", np.uint8, (2, 2)), ("q", float, (0,))], tmp_path / "tactile.npy.gz")
    table = np.zeros(7, rows.dtype)
    table["t_s"], table["taxels"][:, 0, 1] = np.arange(7), np.arange(7)
    for some in (table[:3], table[3:4], table[4:]):
        rows.add(some.tobytes())
        rows.flush()
        np.testing.assert_array_equal(loaded(tmp_path / "tactile.npy.gz"), table[: len(rows)])
    assert rows.columns()["taxels"].dtype == np.uint8
    assert rows.columns()["q"].shape == (7, 0)  # an array without an arm
    np.testing.assert_array_equal(rows.columns()["taxels"], table["taxels"])


def written(folder, count=2 * BLOCK_ROWS):
    """File of a log on disk, and its times."""
    log = RunLog(folder=folder / "rows")
    for k in range(count):
        log.add({"t_s": 0.0025 * k, "force_n": math.sin(k)})
    return folder / "rows" / "log-0.npy.gz", 0.0025 * np.arange(count)


def test_a_last_block_that_is_cut_off_costs_only_itself(tmp_path):
    """At any byte: it is being written, or was when the process was killed."""
    file, times = written(tmp_path)
    whole = file.read_bytes()
    ends = [len(read_left_rows(tmp_path, "log")["t_s"])]
    for size in range(2, len(whole), 97):
        file.write_bytes(whole[:size])
        left = read_left_rows(tmp_path, "log").get("t_s", times[:0])
        np.testing.assert_array_equal(left, times[: len(left)])
        ends.append(len(left))
    assert set(ends) == {0, BLOCK_ROWS, 2 * BLOCK_ROWS}


def test_a_damaged_block_is_named_with_its_rows(tmp_path):
    file, _ = written(tmp_path)
    content = bytearray(file.read_bytes())
    content[-300:-290] = b"0123456789"
    file.write_bytes(content)
    with pytest.raises(UsageError, match=rf"rows: expected the log of a run; .*{file.name}: damaged near row \d+: "):
        read_log(tmp_path / "log.npz")


def test_rows_of_a_killed_run_of_an_earlier_version_are_read(tmp_path):
    """Its file was one array and not compressed."""
    (tmp_path / "rows").mkdir()
    header, table = io.BytesIO(), np.zeros(3, [("#", float), ("t_s", float)])
    table["#"], table["t_s"] = np.arange(3), 1.0 + np.arange(3)
    np.lib.format.write_array_header_2_0(header, np.lib.format.header_data_from_array_1_0(table))
    (tmp_path / "rows" / "log-0.npy").write_bytes(header.getvalue() + table.tobytes())
    assert read_log(tmp_path / "log.npz")["t_s"].tolist() == [1.0, 2.0, 3.0]
