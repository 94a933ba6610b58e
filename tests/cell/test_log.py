"""The run's log: whole, or only its last rows."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.cell.cycle import CycleStatistics
from canprobe.cell.log import RunLog


def rows(count):
    for k in range(count):
        yield {"t_s": 0.1 * k, "q_rad": np.full(6, float(k))} | ({"force_n": float(k)} if k % 3 == 0 else {})


def filled(log, count):
    for row in rows(count):
        log.add(row)
    return log


def test_the_last_rows_are_those_of_the_whole_log():
    whole, last = filled(RunLog(), 50).arrays(), filled(RunLog(7), 50)
    assert len(last) == 7
    for name, column in last.arrays().items():
        np.testing.assert_array_equal(column, whole[name][-7:])


def test_fewer_rows_than_are_kept():
    assert filled(RunLog(7), 3).arrays()["q_rad"].shape == (3, 6)
    assert RunLog(7).arrays() == {}


def test_what_a_row_lacks_is_nan_and_what_nobody_knows_too():
    log = RunLog()
    for row in ({"a": 1.0}, {"b": np.ones(3), "a": None}, {"a": 3, "c": None}):
        log.add(row)
    columns = log.arrays()
    assert list(columns) == ["a", "b", "c"]
    np.testing.assert_array_equal(columns["a"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(columns["b"], [[np.nan] * 3, [1.0] * 3, [np.nan] * 3])
    np.testing.assert_array_equal(columns["c"], [np.nan] * 3)


def test_a_value_of_another_shape_costs_only_itself():
    log = RunLog()
    for row in ({"a": np.ones(3)}, {"a": np.ones(2)}, {"a": "x"}, {"a": np.full(3, 2.0)}):
        log.add(row)
    with pytest.warns(UserWarning, match=r"2 values of column 'a' are no numbers of shape \(3,\)"):
        columns = log.arrays()
    np.testing.assert_array_equal(columns["a"], [[1.0] * 3, [np.nan] * 3, [np.nan] * 3, [2.0] * 3])


def test_rows_of_other_names_have_no_other_shape():
    log = RunLog()
    for row in ({"a": 1.0}, {"a": np.ones(3), "b": 2.0}, {"b": 3, "a": 4}, {"a": 10**400}, {"a": 5.0}):
        log.add(row)
    with pytest.warns(UserWarning, match=r"2 values of column 'a' are no numbers of shape \(\)"):
        columns = log.arrays()
    np.testing.assert_array_equal(columns["a"], [1.0, np.nan, 4.0, np.nan, 5.0])
    np.testing.assert_array_equal(columns["b"], [np.nan, 2.0, 3.0, np.nan, np.nan])


def test_a_controller_may_write_into_what_it_gave():
    log, value = RunLog(), np.zeros(2)
    for k in range(3):
        value[:] = k
        log.add({"a": value, "b": k if k else None})
    np.testing.assert_array_equal(log.arrays()["a"], [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])


def test_statistics_of_the_last_cycles():
    kept, all_ = CycleStatistics.of_last(3), CycleStatistics.of_last(None)
    for statistics in (kept, all_):
        for k in range(5):
            statistics.period_error_ns.append(k)
    assert list(kept.period_error_ns) == [2, 3, 4]
    assert len(all_.period_error_ns) == 5
