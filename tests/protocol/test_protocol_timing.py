"""Response times against the paper, the budget table and a simulated bus."""

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated_bus import instants, simulate

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


def test_the_second_instance_can_be_the_worst():
    """Three frames of 1 ms, the example by which Davis et al. 2007 refute the older analysis: that says 3.0 ms for the
    third message, whose second instance takes 3.5 ms and misses."""
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


# --- transactions -------------------------------------------------------------------------------------------------


def test_offsets_keep_messages_apart():
    """Worked by hand: frames of 1 ms every 4 ms, the second 2 ms after the first, which so never delays it."""
    apart = [
        Message("a", 1, 8, 4 * MS, frame_ns=MS, offset_ns=0),
        Message("b", 2, 8, 4 * MS, frame_ns=MS, offset_ns=2 * MS),
        Message("c", 3, 8, 8 * MS, frame_ns=MS, offset_ns=0),
    ]
    analysis = worst_case_response(apart)
    assert analysis.of("c").response_ns == 2 * MS  # after a, before b
    assert analysis.of("b").response_ns == 2 * MS + MS  # c is through when b comes
    assert worst_case_response([dataclasses.replace(m, offset_ns=None) for m in apart]).of("c").response_ns == 3 * MS
    late = dataclasses.replace(apart[2], offset_ns=2 * MS)
    assert worst_case_response([*apart[:2], late]).of("c").response_ns == 2 * MS + 2 * MS  # after b
    shaky = dataclasses.replace(apart[0], jitter_ns=2 * MS)
    assert worst_case_response([shaky, apart[1], late]).of("c").response_ns == 2 * MS + 4 * MS  # a, b, the next a


def test_a_transaction_and_a_stranger():
    """A message of its own time disturbs the transaction wherever it hurts most."""
    messages = [
        Message("stranger", 1, 8, 100 * MS, frame_ns=MS),
        Message("a", 2, 8, 4 * MS, frame_ns=MS, offset_ns=0),
        Message("b", 3, 8, 4 * MS, frame_ns=MS, offset_ns=2 * MS),
    ]
    analysis = worst_case_response(messages)
    assert analysis.of("a").response_ns == 3 * MS  # b on the bus, the stranger, itself
    assert analysis.of("b").response_ns == 2 * MS + 2 * MS  # the stranger, itself


transactions = st.lists(
    st.tuples(st.integers(1, 6), st.sampled_from([1, 1, 2, 4]), st.integers(0, 39), st.integers(0, 8)),
    min_size=1,
    max_size=6,
)
strangers = st.lists(st.tuples(st.integers(1, 6), st.integers(40, 300), st.integers(0, 20)), max_size=2)
BASE = 40_000


def transaction(rows):
    for n, (c, every, offset, jitter) in enumerate(rows):
        frame, period = c * 1000, BASE * every
        yield Message(f"t{n}", 2 * n, 8, period, jitter * 1000, frame_ns=frame, offset_ns=offset * 1000)


@settings(deadline=None, max_examples=150)
@given(transactions, strangers, st.data())
def test_no_course_of_a_transaction_exceeds_its_bound(rows, others, data):
    messages = list(transaction(rows))
    messages += [
        Message(f"s{n}", 2 * n + 1, 8, t * 1000, j * 1000, frame_ns=c * 1000) for n, (c, t, j) in enumerate(others)
    ]
    messages.sort(key=lambda m: m.cob_id)
    analysis = worst_case_response(messages, bitrate=1_000_000_000)
    if any(r.response_ns is None for r in analysis.responses):
        return
    releases = []
    for rank, m in enumerate(messages):
        first = data.draw(st.integers(0, 40_000), label="phase") if m.offset_ns is None else 0
        waits = data.draw(st.lists(st.integers(0, m.jitter_ns), min_size=4, max_size=4), label="jitter")
        for k, event in enumerate(range(first, 500_000, m.period_ns)):
            releases.append((event + (m.offset_ns or 0) + waits[k % 4], event, rank))
    seen = simulate(messages, releases)
    assert all(seen[n] <= r.response_ns for n, r in enumerate(analysis.responses))


@settings(deadline=None, max_examples=150)
@given(transactions)
def test_the_last_message_of_a_transaction_without_jitter_reaches_its_bound(rows):
    """Its course is fixed, and nothing is below it."""
    messages = [dataclasses.replace(m, jitter_ns=0) for m in transaction(rows)]
    if sum(m.frame_ns / m.period_ns for m in messages) > 0.95:
        return
    releases = [
        (event + m.offset_ns, event, rank)
        for rank, m in enumerate(messages)
        for event in range(0, 3_000_000, m.period_ns)
    ]
    analysis = worst_case_response(messages, bitrate=1_000_000_000)
    assert simulate(messages, releases)[len(messages) - 1] == analysis.responses[-1].response_ns


def test_an_offset_below_zero_is_refused():
    with pytest.raises(ProtocolError, match="offset"):
        worst_case_response([Message("a", 1, 8, MS, offset_ns=-1)])
