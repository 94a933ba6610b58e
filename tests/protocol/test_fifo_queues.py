"""FIFO transmit queues: a bound that no course of a simulated bus exceeds, worked by hand where it can be."""

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.protocol.fifo_queues import worst_case_response_fifo
from canprobe.protocol.timing import Message, worst_case_response

MS = 1_000_000
GBIT = 1_000_000_000  # a bit of 1 ns


def message(name, cob_id, period_ms, cost_ms=1, jitter_ms=0):
    return Message(name, cob_id, 8, period_ms * MS, jitter_ms * MS, frame_ns=cost_ms * MS)


def responses(analysis):
    return {r.message.name: r.response_ns for r in analysis.responses}


def test_the_last_of_a_queue_holds_up_the_first():
    """By hand: a shares a queue with z. Before a: z's frame, blocked by one frame and disturbed by m."""
    messages = [message("a", 1, 20), message("m", 5, 20), message("z", 9, 20)]
    assert responses(worst_case_response(messages))["a"] == 2 * MS  # one frame blocks it, itself
    found = responses(worst_case_response_fifo(messages, {"a": "node", "z": "node"}, GBIT))
    assert found["a"] == 4 * MS  # one frame on the wire, m, z, itself
    assert found["m"] >= 3 * MS


def test_a_node_with_one_message_is_as_with_priorities():
    messages = [message("a", 1, 9), message("b", 2, 11, 2), message("c", 3, 17)]
    alone = worst_case_response_fifo(messages, {"a": 1, "b": 2, "c": 3}, GBIT)
    assert responses(alone) == responses(worst_case_response_fifo(messages, {}, GBIT))
    for name, bound in responses(worst_case_response(messages, GBIT)).items():
        assert bound <= responses(alone)[name] <= bound + 2 * MS, "one frame of its own more at most"


def test_what_outlasts_its_period_has_no_bound_nor_what_it_disturbs():
    messages = [message("a", 1, 2), message("b", 2, 3), message("c", 3, 40)]
    assert responses(worst_case_response_fifo(messages, {"a": "n", "b": "n"}, GBIT))["c"] is None


def test_senseless_sets_are_refused():
    with pytest.raises(ProtocolError, match="nobody"):
        worst_case_response_fifo([message("a", 1, 9)], {"nobody": 1})
    with pytest.raises(ProtocolError, match="same COB-ID"):
        worst_case_response_fifo([message("a", 1, 9), message("b", 1, 9)], {})


# --- against a simulated bus ------------------------------------------------------------------------------------------


def simulate(messages, node_of, releases, by_priority=None):
    """A bus whose nodes offer their oldest frame, one of them its most urgent, and the lowest identifier of all offers
    wins: longest time from an event.

    Releases: (queued, event, rank).
    """
    pending = deque(sorted(releases))
    queues = {node: deque() for node in set(node_of)}
    worst, now = [0] * len(messages), 0
    while pending or any(queues.values()):
        if not any(queues.values()):
            now = max(now, pending[0][0])
        while pending and pending[0][0] <= now:
            _, event, rank = pending.popleft()
            queues[node_of[rank]].append((rank, event))
        if queues.get(by_priority):
            queues[by_priority] = deque(sorted(queues[by_priority]))
        node = min((node for node, queue in queues.items() if queue), key=lambda node: queues[node][0][0])
        rank, event = queues[node].popleft()
        now += messages[rank].frame_ns
        worst[rank] = max(worst[rank], now - event)
    return worst


sets = st.lists(
    st.tuples(st.integers(1, 6), st.integers(30, 120), st.integers(0, 20), st.integers(0, 2)), min_size=2, max_size=7
)


@settings(deadline=None, max_examples=300)
@given(sets, st.data())
def test_no_course_exceeds_the_bound(rows, data):
    messages = [Message(f"m{n}", n, 8, t * 1000, j * 1000, frame_ns=c * 1000) for n, (c, t, j, _) in enumerate(rows)]
    node_of = [node for *_, node in rows]
    fifo = {m.name: node for m, node in zip(messages, node_of, strict=True) if node != 2}
    analysis = worst_case_response_fifo(messages, fifo, GBIT)
    if any(r.response_ns is None for r in analysis.responses):
        return
    releases = []
    for rank, m in enumerate(messages):
        first = data.draw(st.integers(0, 40_000), label="phase")
        waits = data.draw(st.lists(st.integers(0, m.jitter_ns), min_size=3, max_size=3), label="jitter")
        for k, event in enumerate(range(first, 600_000, m.period_ns)):
            releases.append((event + waits[k % 3], event, rank))
    seen = simulate(messages, node_of, releases, by_priority=2)
    assert all(worst <= r.response_ns for worst, r in zip(seen, analysis.responses, strict=True))


def test_the_bound_is_reached_by_the_worst_course():
    """The hand-worked set: z queued just before a, a frame below on the wire, m with them."""
    messages = [message("a", 1, 20), message("m", 5, 20), message("z", 9, 20), message("low", 10, 20)]
    bound = responses(worst_case_response_fifo(messages, {"a": "n", "z": "n"}, GBIT))["a"]
    releases = [(0, 0, 3), (1, 1, 2), (1, 1, 1), (2, 2, 0)]
    assert bound - 10 <= simulate(messages, ["n", "o", "n", "p"], releases)[0] <= bound
