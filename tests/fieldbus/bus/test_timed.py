"""The bus with a bit rate: against the arithmetic of its frames, and against the worst-case analysis."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from timed_buses import BIT, INTERMISSION, Scripted, Source, make_bus

from canprobe.errors import BusError
from canprobe.fieldbus.protocol.frame_bits import exact_bits, worst_case_bits
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.response_times import Message, worst_case_response


def ends(*frames: Frame, at: int = 0) -> list[int]:
    """When the last bit of each frame is through, sent end to end from `at`."""
    times = []
    for frame in frames:
        at += exact_bits(*frame) * BIT
        times.append(at - INTERMISSION)
    return times


def test_a_frame_takes_its_bits():
    frame = (0x181, bytes(8))
    bus, seen = make_bus(Scripted({5: [frame]}), Scripted())
    bus.clock.sleep_until_ns(10**9)
    assert seen == [(*frame, 5 + (exact_bits(*frame) - 3) * BIT)]
    assert (bus.frames, bus.busy_ns) == (1, exact_bits(*frame) * BIT)


@pytest.mark.parametrize("bitrate", [10_000, 125_000, 300_000, 800_000])
def test_other_bit_rates(bitrate):
    frame = (0x123, b"\x55")
    bus, seen = make_bus(Scripted({0: [frame]}), Scripted(), bitrate=bitrate)
    bus.clock.sleep_until_ns(10**9)
    assert seen[0][2] == -(-(exact_bits(*frame) - 3) * 10**9 // bitrate)


def test_arbitration_is_not_preemptive():
    low, middle, high = (0x700, b"\5"), (0x300, bytes(8)), (0x080, b"\1")
    bus, seen = make_bus(Scripted({0: [low]}), Scripted({1: [middle]}), Scripted({2: [high]}))
    bus.clock.sleep_until_ns(10**9)
    assert [frame[0] for frame in seen] == [0x700, 0x080, 0x300]
    assert [frame[2] for frame in seen] == ends(low, high, middle)


def test_what_is_queued_with_the_last_bit_of_a_frame_takes_part_in_the_next_arbitration():
    first, other, answer = (0x080, b"\1"), (0x200, b""), (0x181, b"q")
    bus, seen = make_bus(Scripted({0: [first, other]}), Scripted(answers={0x080: [answer]}))
    bus.clock.sleep_until_ns(10**9)
    assert [frame[:2] for frame in seen] == [first, answer, other]
    assert [frame[2] for frame in seen] == ends(first, answer, other)


def test_transmit_queues():
    frames = [(0x300, b"a"), (0x050, b"A")]
    for queue, order in (("priority", [0x050, 0x200, 0x300, 0x400]), ("fifo", [0x200, 0x300, 0x050, 0x400])):
        bus, seen = make_bus(Scripted({0: frames}), Scripted({0: [(0x200, b"b"), (0x400, b"B")]}), queue=queue)
        bus.clock.sleep_until_ns(10**9)
        assert [can_id for can_id, _, _ in seen] == order, queue


def test_equal_identifiers_of_one_node_keep_their_order():
    frames = [(0x585, bytes([k])) for k in range(20)]
    for queue in ("priority", "fifo"):
        bus, seen = make_bus(Scripted({0: frames}), Scripted(), queue=queue)
        bus.clock.sleep_until_ns(10**9)
        assert [frame[:2] for frame in seen] == frames


def test_a_port_sees_arrival_times_and_never_its_own_frames():
    answer = (0x181, b"q")
    bus, _ = make_bus(Scripted(answers={0x080: [answer]}))
    port = bus.port()
    port.send_batch([(0x080, b"\1")])
    assert port.drain() == []
    port.wait(10**9)
    assert port.drain() == [(*answer, ends((0x080, b"\1"), answer)[1])]
    assert bus.clock.now_ns() == ends((0x080, b"\1"), answer)[1]


def test_a_node_that_leaves_takes_its_frames_along():
    quitter = Scripted({0: [(0x100, bytes(8)), (0x101, b"")]})
    bus, seen = make_bus(quitter, Scripted({1: [(0x200, b"")]}), Scripted())
    bus.clock.sleep_until_ns(10 * BIT)
    bus.detach(quitter)
    bus.clock.sleep_until_ns(10**9)
    assert [frame[0] for frame in seen] == [0x200]


def test_two_participants_that_answer_each_other_fill_the_bus_but_time_goes_on():
    bus, seen = make_bus(Scripted({0: [(1, b"")]}, answers={2: [(1, b"")]}), Scripted(answers={1: [(2, b"")]}))
    bus.clock.sleep_until_ns(10**7)
    assert bus.busy_ns == pytest.approx(10**7, rel=0.01)
    assert len(seen) > 150


def test_a_participant_that_queues_without_end_is_named():
    bus, _ = make_bus(Scripted({0: [(1, b"")] * 101}), Scripted(), max_frames=100)
    with pytest.raises(BusError, match="Scripted"):
        bus.clock.sleep_until_ns(1)


# --- against the analysis ---------------------------------------------------------------------------------------------


def bound_length(can_id: int, data: bytes) -> int:
    return worst_case_bits(len(data))


message_sets = st.lists(st.tuples(st.binary(max_size=8), st.integers(5, 60), st.integers(0, 9)), min_size=1, max_size=6)


def as_messages(rows, length):
    """Rows of (data, period and jitter in 100 µs) as messages with identifiers that stuff differently."""
    for n, (data, period, jitter) in enumerate(rows):
        can_id = 0x080 + 0x111 * n
        frame_ns = length(can_id, data) * BIT
        yield Message(f"m{n}", can_id, len(data), period * 100_000, jitter * 100_000, frame_ns=frame_ns)


def run(rows, releases, length, until):
    """Worst time from each event to the end of its frame with intermission; releases: per message (event, queued)."""
    sources = [Source((0x080 + 0x111 * n, row[0]), [q for _, q in releases[n]]) for n, row in enumerate(rows)]
    bus, seen = make_bus(*sources, Scripted(), length=length)
    bus.clock.sleep_until_ns(until)
    worst = []
    for n in range(len(rows)):
        done = [t for can_id, _, t in seen if can_id == 0x080 + 0x111 * n]
        events = sorted(releases[n], key=lambda pair: (pair[1], pair[0]))
        assert len(done) == len(events)
        worst.append(max((t + INTERMISSION - event for t, (event, _) in zip(done, events, strict=True)), default=0))
    return worst


@settings(deadline=None, max_examples=60)
@given(message_sets, st.sampled_from([exact_bits, bound_length]), st.data())
def test_simulated_response_times_never_exceed_the_analysis(rows, length, data):
    messages = list(as_messages(rows, length))
    analysis = worst_case_response(messages)
    if any(r.response_ns is None for r in analysis.responses):
        return
    releases = []
    for m in messages:
        first = data.draw(st.integers(0, m.period_ns), label="phase")
        waits = data.draw(st.lists(st.integers(0, m.jitter_ns), min_size=3, max_size=3), label="jitter")
        events = range(first, 30_000_000, m.period_ns)
        queued = [event + waits[k % 3] for k, event in enumerate(events)]
        releases.append([(event, max(queued[: k + 1])) for k, event in enumerate(events)])
    worst = run(rows, releases, length, 200_000_000)
    assert all(seen <= r.response_ns for seen, r in zip(worst, analysis.responses, strict=True))
