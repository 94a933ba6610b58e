"""Response times against the paper, the budget table and a simulated bus."""

import dataclasses
import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.protocol.timing import Message, frame_time_ns, worst_case_response

MS = 1_000_000
CYCLE = 2_500_000


def test_frame_time():
    assert frame_time_ns(8, 1_000_000) == 135_000
    assert frame_time_ns(8, 125_000) == 1_080_000
    assert frame_time_ns(0, 800_000) == 68_750


def paper(*rows):
    """Rows of (period, deadline) in ms, frames of 1 ms, priorities in the order given."""
    return [
        Message(f"m{n}", n, 8, round(t * MS), deadline_ns=round(d * MS), frame_ns=MS)
        for n, (t, d) in enumerate(rows, 1)
    ]


def test_counter_example_of_davis_2007_table_1():
    """The old analysis said 3.0 ms for the third message; its second instance takes 3.5 ms and misses."""
    analysis = worst_case_response(paper((2.5, 2.5), (3.5, 3.25), (3.5, 3.25)), bitrate=125_000)
    assert [r.response_ns for r in analysis.responses] == [2 * MS, 3 * MS, 3_500_000]
    assert [r.fits for r in analysis.responses] == [True, True, False]
    assert analysis.responses[2].instances == 2
    assert not analysis.fits
    assert analysis.load == pytest.approx(1 / 2.5 + 2 / 3.5)


def drives_and_window(grouped, jitter_ns=0):
    """The bus of the default cell at 1 Mbit/s: SYNC, six drives at 400 Hz, tactile header and 8 rows at 200 Hz."""
    yield Message("sync", 0x080, 1, CYCLE, jitter_ns)
    for n in range(1, 7):
        yield Message(f"tpdo{n}", 0x180 + n, 8, CYCLE, jitter_ns)
    for n in (1, 3, 5) if grouped else range(1, 7):
        yield Message(f"rpdo{n}", 0x300 + n if grouped else 0x200 + n, 8 if grouped else 6, CYCLE, jitter_ns)
    for n in range(9):
        yield Message(f"tactile{n}", 0x511 + n, 8, 2 * CYCLE, deadline_ns=2 * CYCLE)


@pytest.mark.parametrize(
    "grouped, jitter_ns, last_us, load",
    [
        (False, 0, 4345, 0.869),  # 2 × 1565 + 9 × 135
        (True, 0, 2495, 0.755),  # 1280 + 9 × 135: the last frame starts just before the next SYNC
        (True, 150_000, 3775, 0.755),  # and 1280 later where jitter lets those of the next cycle in first
    ],
)
def test_tactile_frames_need_two_cycles_and_no_more(grouped, jitter_ns, last_us, load):
    analysis = worst_case_response(list(drives_and_window(grouped, jitter_ns)))
    assert analysis.fits
    assert analysis.of("tactile8").response_ns == last_us * 1000
    assert analysis.load == pytest.approx(load)


def test_six_drives_fill_63_percent():
    messages = [m for m in drives_and_window(False) if not m.name.startswith("tactile")]
    assert worst_case_response(messages).load == pytest.approx(1565 / 2500)


def test_an_overloaded_bus_has_no_bound_below_the_messages_that_fit():
    messages = [Message("a", 1, 8, 200_000), Message("b", 2, 8, 200_000), Message("c", 3, 0, 10**9)]
    analysis = worst_case_response(messages)
    assert [r.response_ns for r in analysis.responses] == [270_000, None, None]
    assert not any(r.fits for r in analysis.responses)
    assert analysis.load > 1


def test_jitter_is_added_and_disturbs_what_is_below():
    still = worst_case_response([Message("a", 1, 8, MS), Message("b", 2, 8, MS)])
    shaky = worst_case_response([Message("a", 1, 8, MS, jitter_ns=900_000), Message("b", 2, 8, MS)])
    assert still.of("b").response_ns == 270_000
    assert shaky.of("a").response_ns == still.of("a").response_ns + 900_000
    assert shaky.of("b").response_ns == 405_000


def test_order_does_not_matter_but_identifiers_do():
    messages = list(drives_and_window(False))
    assert worst_case_response(messages[::-1]) == worst_case_response(messages)
    with pytest.raises(ProtocolError, match="080h"):
        worst_case_response([*messages, Message("second", 0x080, 0, CYCLE)])


@pytest.mark.parametrize(
    "message",
    [Message("x", 1, 8, 0), Message("x", 1, 9, 1), Message("x", 0x800, 8, 1), Message("x", 1, 8, 1, jitter_ns=-1)],
)
def test_senseless_messages_are_refused(message):
    with pytest.raises(ProtocolError):
        worst_case_response([message])


def test_an_empty_bus_fits():
    analysis = worst_case_response([])
    assert analysis.fits and analysis.load == 0
    with pytest.raises(KeyError):
        analysis.of("sync")


# --- against a simulated bus --------------------------------------------------------------------------------------


def simulate(messages, releases):
    """Non-preemptive bus, lowest identifier first: longest response per message. Releases: (queued, event, rank)."""
    pending, worst, now = sorted(releases), dict.fromkeys(range(len(messages)), 0), -(10**9)
    queue = []
    while pending or queue:
        if not queue:
            now = max(now, pending[0][0])
        while pending and pending[0][0] <= now:
            queued, event, rank = pending.pop(0)
            queue.append((rank, queued, event))
        queue.sort()
        rank, _, event = queue.pop(0)
        now += messages[rank].frame_ns
        worst[rank] = max(worst[rank], now - event)
    return worst


def instants(message, rank, first, until, queued_from=None):
    for k in itertools.count():
        event = first + k * message.period_ns
        if event > until:
            return
        yield (event if queued_from is None else max(event, queued_from), event, rank)


message_sets = st.lists(
    st.tuples(st.integers(1, 6), st.integers(4, 40), st.integers(0, 30)), min_size=1, max_size=5
).map(lambda rows: [Message(f"m{n}", n, 8, t * 1000, j * 1000, frame_ns=c * 1000) for n, (c, t, j) in enumerate(rows)])


@settings(deadline=None, max_examples=150)
@given(message_sets)
def test_the_bound_is_reached_by_the_critical_instant(messages):
    """All higher messages with their jitter used up at 0, the longest lower one just on the bus (and 1 ns longer)."""
    analysis = worst_case_response(messages, bitrate=1_000_000_000)
    for rank, response in enumerate(analysis.responses):
        level_load = sum(m.frame_ns / m.period_ns for m in messages[: rank + 1])
        assert (response.response_ns is None) == (level_load > 1 - 1e-12)
        if response.response_ns is None or level_load > 0.9:
            continue
        until = response.instances * response.message.period_ns
        lower = messages[rank + 1 :]
        releases = []
        for n, m in enumerate(messages[: rank + 1]):
            releases += instants(m, n, -m.jitter_ns, until, queued_from=0)
        if lower:
            longest = max(m.frame_ns for m in lower)
            blocker = dataclasses.replace(lower[0], frame_ns=longest + 1)
            releases.append((-1, -1, rank + 1))
            lower = [blocker]
        assert simulate([*messages[: rank + 1], *lower], releases)[rank] == response.response_ns


@settings(deadline=None, max_examples=100)
@given(message_sets, st.lists(st.integers(0, 40_000), min_size=5, max_size=5))
def test_no_phasing_exceeds_the_bound(messages, phases):
    analysis = worst_case_response(messages, bitrate=1_000_000_000)
    if any(r.response_ns is None for r in analysis.responses):
        return
    releases = [r for n, m in enumerate(messages) for r in instants(m, n, phases[n], 400_000)]
    seen = simulate(messages, releases)
    assert all(seen[n] <= r.response_ns for n, r in enumerate(analysis.responses))
