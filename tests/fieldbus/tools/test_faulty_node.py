"""What each kind of fault does to the frames of a node, frame by frame."""

from __future__ import annotations

import pytest

from canprobe.fieldbus import VirtualClock, load_eds, make_eds_node
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault, FaultyNode

MS = 1_000_000
ID = 0x185


class Ticker(Participant):
    """Node 5: counts in a frame of its own every millisecond, answers 100h with 101h, and boots with 705h."""

    node_id, name, listens, next_deadline_ns = 5, "node 5", frozenset({0x100}), MS

    def __init__(self):
        self.count, self.next_deadline_ns, self.heard = 0, MS, []

    def start(self, t_ns):
        self.count, self.next_deadline_ns = 0, t_ns + MS
        return [(0x705, b"\0")]

    def receive(self, can_id, data, t_ns):
        self.heard.append((t_ns, data))
        return [(0x101, data)]

    def advance(self, t_ns):
        self.next_deadline_ns = t_ns + MS
        self.count += 1
        return [(ID, bytes((self.count,))), (0x385, bytes((self.count,)))]


def played(*faults, until_ms=10, asked=()):
    """(milliseconds, identifier, data) of what came to the bus, and the node."""
    clock = VirtualClock()
    bus = LockstepBus(clock)
    ticker = Ticker()
    node = FaultyNode(ticker, faults)
    port = bus.port()
    bus.attach(node)
    seen = []
    for t_ms in sorted({*asked, until_ms}):
        clock.sleep_until_ns(int(t_ms * MS))
        if t_ms in asked:
            port.send_batch([(0x100, bytes((int(t_ms),)))])
        seen += port.drain()
    return [(t / MS, can_id, data) for can_id, data, t in seen], node, ticker


def of(frames, can_id=ID):
    return [(t, data[0]) for t, i, data in frames if i == can_id]


CLEAN = [(float(t), t) for t in range(1, 11)]


def fault(kind, start_ms=2.5, duration_ms=3.0, node_id=5, **more):
    return Fault(kind, node_id, int(start_ms * MS), int(duration_ms * MS), **more)


def test_without_faults_or_with_another_nodes_it_is_the_node():
    frames, node, _ = played(fault(BUS_FAULTS["mute"], node_id=6))
    assert of(frames) == of(frames, 0x385) == CLEAN and node.host.hits == 0
    assert frames[0] == (0.0, 0x705, b"\0")


@pytest.mark.parametrize("kind", [BUS_FAULTS["drop"], BUS_FAULTS["mute"]])
def test_frames_are_lost(kind):
    frames, node, _ = played(fault(kind))
    assert of(frames) == [pair for pair in CLEAN if pair[1] not in (3, 4, 5)]
    assert node.host.hits == 6


def test_frames_come_later():
    frames, _, _ = played(fault(BUS_FAULTS["delay"], values={"ms": 1.5}))
    assert of(frames) == [(1, 1), (2, 2), (4.5, 3), (5.5, 4), (6, 6), (6.5, 5), (7, 7), (8, 8), (9, 9), (10, 10)]


def test_frames_come_twice():
    frames, _, _ = played(fault(BUS_FAULTS["duplicate"]))
    assert [n for _, n in of(frames)] == [1, 2, 3, 3, 4, 4, 5, 5, 6, 7, 8, 9, 10]


def test_one_bit_of_a_frame_is_another_or_its_end_is_lost():
    frames, _, _ = played(fault(BUS_FAULTS["corrupt"], seed=3))
    for t, can_id, data in frames:
        if can_id == ID and 2.5 < t < 5.5:
            assert data == b"" or (data[0] ^ int(t)).bit_count() == 1
        elif can_id == ID:
            assert data[0] == t


def test_a_frame_comes_after_the_next_one():
    frames, _, _ = played(fault(BUS_FAULTS["reorder"], share=0.5, seed=1))
    numbers = [(t, i, d[0]) for t, i, d in frames if i in (ID, 0x385)]
    assert sorted(n for _, _, n in numbers) == sorted([n for n in range(1, 11) for _ in range(2)])
    assert numbers != sorted(numbers, key=lambda row: (row[0], row[1]))
    assert any(n != t for t, _, n in numbers)


def test_what_comes_in_comes_after_the_next_one_and_is_never_sent():
    reordered = fault(BUS_FAULTS["reorder"], incoming=True, share=0.5, seed=1)
    frames, _, ticker = played(reordered, asked=(2.6, 3.5, 4.5, 5.4, 7.5))
    heard = [data[0] for _, data in ticker.heard]
    assert sorted(heard) == [2, 3, 4, 5, 7] and heard != sorted(heard)
    assert of(frames) == CLEAN and not [row for row in frames if row[1] == 0x100]


def test_a_deaf_node_speaks_but_does_not_hear():
    frames, _, ticker = played(fault(BUS_FAULTS["deaf"], incoming=True), asked=(1.5, 3.5, 7.5))
    assert of(frames) == CLEAN
    assert [data[0] for _, data in ticker.heard] == [1, 7]


def test_what_comes_in_late_is_answered_late():
    frames, _, ticker = played(fault(BUS_FAULTS["delay"], incoming=True, values={"ms": 2.0}), asked=(3.5,))
    assert ticker.heard == [(int(5.5 * MS), b"\x03")]
    assert (5.5, 0x101, b"\x03") in frames


def test_a_frozen_node_is_silent_then_goes_on_where_it_was():
    frames, _, ticker = played(fault(BUS_FAULTS["freeze"]), asked=(3.5,))
    assert of(frames) == [(1, 1), (2, 2), (5.5, 3), (6.5, 4), (7.5, 5), (8.5, 6), (9.5, 7)]
    assert ticker.heard == []


def test_a_node_that_lost_its_power_boots():
    frames, _, _ = played(fault(BUS_FAULTS["reboot"]))
    assert [t for t, i, _ in frames if i == 0x705] == [0.0, 5.5]
    assert of(frames) == [(1, 1), (2, 2), (6.5, 1), (7.5, 2), (8.5, 3), (9.5, 4)]


@pytest.mark.parametrize(("seed", "can_id"), [(0, 0x050), (1, 0x185), (2, 0x705), (3, 0x085)])
def test_a_babbling_node(seed, can_id):
    frames, _, _ = played(fault(BUS_FAULTS["babble"], values={"gap_ms": 0.5}, seed=seed))
    times = [t for t, i, _ in frames if i == can_id and (t % 1 == 0.5 or i != ID)]
    wanted = [2.5, 3.0, 3.5, 4.0, 4.5, 5.0]
    assert [t for t in times if t != 0.0] == (wanted if can_id != ID else [2.5, 3.5, 4.5])


def test_a_wrong_position_keeps_the_rest_of_the_pdo():
    drive = make_eds_node(load_eds("puma260_joint", 5), 5)
    node = FaultyNode(drive, [fault(BUS_FAULTS["wrong-data"])])
    node.start(0)
    node.receive(0, b"\x01\x05", 0)
    (before,), (wrong,), (after,) = (node.receive(0x80, b"", t * MS) for t in (1, 3, 7))
    assert before == after == (ID, before[1]) and wrong[0] == ID
    assert wrong[1][:2] + wrong[1][6:] == before[1][:2] + before[1][6:] and wrong[1][2:6] != before[1][2:6]
