"""What is lived with is told once a kind, with how often, to whom and when."""

from __future__ import annotations

import pytest

from canprobe.cell.notes import KINDS_KEPT, OTHERS, Notes, nodes_text


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
    assert notes.lines()[-1].startswith(f"node 3: {OTHERS}, {1000 - KINDS_KEPT} times")
