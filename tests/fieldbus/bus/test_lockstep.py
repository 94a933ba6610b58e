"""The lockstep bus: order of frames, movement of virtual time, and participants that misbehave."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import pytest
import timed_buses
from hypothesis import given
from hypothesis import strategies as st
from timed_buses import Scripted

from canprobe.errors import BusError, InterfaceError
from canprobe.fieldbus import LockstepBus, VirtualClock
from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG, Frame

MS = 1_000_000


make_bus = partial(timed_buses.make_bus, kind=LockstepBus)


def test_arbitration_with_extended_and_remote_frames() -> None:
    # ISO 11898-1: with equal base identifiers a data frame beats a remote frame, which beats an extended frame.
    base = 0x123
    ids = [
        base << 18 | EFF_FLAG | RTR_FLAG,
        base << 18 | EFF_FLAG,
        base | RTR_FLAG,
        base,
        0x124,
        0x122 << 18 | EFF_FLAG,
    ]
    bus, seen = make_bus(*(Scripted({0: [(can_id, b"")]}) for can_id in ids))
    bus.clock.sleep_until_ns(0)
    assert [can_id for can_id, _, _ in seen] == [ids[5], ids[3], ids[2], ids[1], ids[0], ids[4]]


def test_answers_join_the_arbitration_of_the_same_instant() -> None:
    slow = Scripted({5: [(0x080, b"\1"), (0x7FF, b"")]})
    quick = Scripted(answers={0x080: [(0x181, b"q")]})
    bus, seen = make_bus(slow, quick)
    bus.clock.sleep_until_ns(9)
    assert seen == [(0x080, b"\1", 5), (0x181, b"q", 5), (0x7FF, b"", 5)]
    assert slow.heard == [(0x181, b"q", 5)], "nobody receives what it sent"
    assert quick.heard == [(0x080, b"\1", 5), (0x7FF, b"", 5)]


def test_send_batch_returns_with_the_answers() -> None:
    bus, seen = make_bus(*(Scripted(answers={0x080: [(0x180 + k, b"t")]}) for k in (3, 1, 2)))
    port = bus.port()
    port.send_batch([(0x080, b"\1"), (0x205, b"r")])
    assert port.drain() == [(0x181, b"t", 0), (0x182, b"t", 0), (0x183, b"t", 0)]
    assert port.drain() == []
    # the answers (180h + n) win against the master's own next frame
    assert [can_id for can_id, _, _ in seen] == [0x080, 0x181, 0x182, 0x183, 0x205]
    assert (port.counters.sent, port.counters.received) == (2, 3)


def test_wait_stops_at_the_first_frame_and_at_its_limit() -> None:
    bus, _ = make_bus(Scripted({3 * MS: [(0x701, b"\5")], 7 * MS: [(0x701, b"\5")]}))
    port = bus.port()
    port.wait(10 * MS)
    assert bus.clock.now_ns() == 3 * MS
    port.wait(10 * MS)
    assert bus.clock.now_ns() == 3 * MS, "the frame has not been fetched yet"
    assert port.drain() == [(0x701, b"\5", 3 * MS)]
    port.wait(5 * MS)
    assert (bus.clock.now_ns(), port.drain()) == (5 * MS, [])
    port.wait(7 * MS)
    assert port.drain() == [(0x701, b"\5", 7 * MS)], "due at the limit itself counts"
    port.wait(1)
    assert bus.clock.now_ns() == 7 * MS, "time never goes back"


def test_sleeping_runs_silent_deadlines_and_boot_ups_are_heard() -> None:
    class Booting(Scripted):
        def start(self, t_ns: int) -> Sequence[Frame]:
            return [(0x705, b"\0")]

    node = Booting({2: (), 4: ()})
    bus, _ = make_bus(node)
    port = bus.port()
    assert port.drain() == [(0x705, b"\0", 0)]
    bus.clock.sleep_until_ns(3)
    assert (list(node.timed), bus.clock.now_ns()) == ([4], 3)


def test_two_buses_share_one_clock() -> None:
    clock = VirtualClock()
    order: list[str] = []
    for name, times in (("x", (1, 3)), ("y", (2, 3))):
        bus = LockstepBus(clock, name)
        bus.recorder = lambda can_id, data, t_ns, name=name: order.append(f"{name}{t_ns}")  # type: ignore[misc]
        bus.attach(Scripted({t: [(0x100, b"")] for t in times}))
    clock.sleep_until_ns(10)
    assert order == ["x1", "y2", "x3", "y3"]


def test_an_endless_conversation_is_an_error_that_names_it() -> None:
    ping = Scripted({6 * MS: [(0x101, b"")]}, {0x102: [(0x101, b"")]})
    bus, seen = make_bus(ping, Scripted(answers={0x101: [(0x102, b"")]}), max_frames=50)
    with pytest.raises(BusError, match=r"can7: no end at 0\.006000 s: 101 from Scripted is frame 51 of this instant"):
        bus.clock.sleep_until_ns(10 * MS)
    assert len(seen) == 50
    bus.clock.sleep_until_ns(20 * MS)  # the bus is usable again


def test_a_deadline_that_never_moves_is_an_error() -> None:
    class Stuck(Scripted):
        next_deadline_ns = 4

        def advance(self, t_ns: int) -> Sequence[Frame]:
            return ()

    bus, _ = make_bus(Stuck(), max_frames=50)
    with pytest.raises(BusError, match="never move on, of Stuck"):
        bus.clock.sleep_until_ns(10)


def test_detached_and_closed_are_silent() -> None:
    node = Scripted({1: [(0x100, b"")]}, {0x080: [(0x181, b"")]})
    bus, seen = make_bus(node)
    port = bus.port()
    bus.detach(node)
    port.send_batch([(0x080, b"")])
    bus.clock.sleep_until_ns(5)
    assert (port.drain(), len(seen), node.heard) == ([], 1, [])
    port.close()
    with pytest.raises(InterfaceError, match="can7: this port is closed"):
        port.drain()
    with pytest.raises(BusError, match="already"):
        bus.attach(node)
        bus.attach(node)


frames_of_a_node = st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=6)


@given(st.lists(frames_of_a_node, min_size=1, max_size=5))
def test_order_follows_the_definition(queues: list[list[Frame]]) -> None:
    # Independent truth: repeatedly take the least (identifier, order of attachment) of the heads.
    bus, seen = make_bus(*(Scripted({0: queue} if queue else {}) for queue in queues))
    bus.clock.sleep_until_ns(0)
    left = [list(queue) for queue in queues]
    expected = []
    while any(left):
        _, k = min((queue[0][0], k) for k, queue in enumerate(left) if queue)
        expected.append((*left[k].pop(0), 0))
    assert seen == expected
