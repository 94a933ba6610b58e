"""The run's log: whole, or only its last rows."""

import numpy as np
import pytest

from canprobe.cell.master.log import RunLog
from canprobe.cell.master.notes import KINDS_KEPT, OTHER_KINDS_TEXT, Notes, nodes_text


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
    assert list(RunLog(7).arrays()) == ["t_s"]


def test_what_a_row_lacks_is_nan_and_what_nobody_knows_too():
    log = RunLog()
    for row in ({"a": 1.0}, {"b": np.ones(3), "a": None}, {"a": 3, "c": None}):
        log.add(row)
    columns = log.arrays()
    assert list(columns) == ["a", "b", "c"]
    np.testing.assert_array_equal(columns["a"], [1.0, np.nan, 3.0])
    np.testing.assert_array_equal(columns["b"], [[np.nan] * 3, [1.0] * 3, [np.nan] * 3])
    np.testing.assert_array_equal(columns["c"], [np.nan] * 3)


def test_a_value_of_another_shape_costs_only_itself_in_rows_of_other_names_too():
    log = RunLog()
    for row in ({"a": 1.0}, {"a": np.ones(3), "b": 2.0}, {"b": 3, "a": 4}, {"a": 10**400}, {"a": 5.0}):
        log.add(row)
    with pytest.warns(UserWarning, match=r"2 values of column 'a' are no numbers of shape \(\)"):
        columns = log.arrays()
    np.testing.assert_array_equal(columns["a"], [1.0, np.nan, 4.0, np.nan, 5.0])
    np.testing.assert_array_equal(columns["b"], [np.nan, 2.0, 3.0, np.nan, np.nan])


def test_a_column_has_the_shape_of_its_first_number_and_rows_before_it_are_nan():
    log = RunLog(3)
    for a, b in ((None, "x"), (None, 1.0), (np.ones(2), 2.0), (np.full(2, 3.0), None)):
        log.add({"a": a, "b": b, "c": None} if a is None else {"a": a, "b": b})
    with pytest.warns(UserWarning, match=r"1 values of column 'b' are no numbers of shape \(\)"):
        columns = log.arrays()
    np.testing.assert_array_equal(columns["a"], [[np.nan] * 2, [1.0] * 2, [3.0] * 2])
    np.testing.assert_array_equal(columns["b"], [1.0, 2.0, np.nan])
    assert np.isnan(columns["c"]).all() and len(columns["c"]) == 3
    log.add({"a": np.ones(2), "b": 4.0})
    assert "c" not in log.columns(), "none of the rows that are kept has it"


# What is lived with is told once a kind, with how often, to whom and when.


def test_the_same_of_several_nodes_is_one_line():
    notes = Notes()
    for i in range(98):
        notes.add("EMCY 8100h, communication", node_id=(1, 2, 3, 16)[i % 4], t_s=3.208 + 0.1 * i)
    notes.add("bus error frames: 3")
    notes.add("EMCY 8210h, PDO length", node_id=4, t_s=7.004)
    assert len(notes) == 3
    assert notes.lines() == [
        "nodes 1-3, 16: EMCY 8100h, communication, 98 times, first at 3.21 s, last at 12.91 s",
        "bus error frames: 3",
        "node 4: EMCY 8210h, PDO length, at 7.00 s",
    ]


@pytest.mark.parametrize(
    ("ids", "text"), [([7], "node 7"), ([2, 1], "nodes 1, 2"), ([16, 1, 3, 2, 5], "nodes 1-3, 5, 16")]
)
def test_nodes_in_words(ids, text):
    assert nodes_text(ids) == text


def test_a_node_that_always_says_something_else_does_not_fill_the_memory():
    notes = Notes()
    for code in range(1000):
        notes.add(f"EMCY {code:04X}h", node_id=3, t_s=0.0)
    assert len(notes) == KINDS_KEPT + 1
    assert notes.lines()[-1].startswith(f"node 3: {OTHER_KINDS_TEXT}, {1000 - KINDS_KEPT} times")
