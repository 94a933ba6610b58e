"""A wire that fails: error frames, the standard's counters, error passive, bus off, and a babbling idiot."""

from __future__ import annotations

import pytest
from timed_buses import BIT, Scripted, Source, make_bus
from wire_faults import Babbler, ErrorsAt

from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.bus.virtual.controllers import BitErrors, ErrorCounters
from canprobe.fieldbus.protocol.frame_bits import exact_bits

ERROR_BITS = 12 + 8 + 3  # two flags one behind the other, delimiter, intermission
FRAME = (0x155, b"\x55\x55")
BITS = exact_bits(*FRAME)
ACTIVE, WARNING, PASSIVE, OFF = ControllerState


# --- the counters alone -----------------------------------------------------------------------------------------------


def test_states_by_the_transmit_counter():
    counters, states = ErrorCounters(), []
    for _ in range(32):
        states.append(counters.state)
        counters.transmit_error()
    assert states == [ACTIVE] * 12 + [WARNING] * 4 + [PASSIVE] * 16  # 96 and 128 in steps of 8
    assert counters.state is OFF and counters.bus_offs == 1


def test_states_by_the_receive_counter():
    counters = ErrorCounters()
    for _ in range(1000):
        counters.receive_error()
    assert counters.state is PASSIVE, "a receiver never goes bus off"
    counters.received()
    assert counters.receive == 127 and counters.state is WARNING


def test_success_counts_down_by_one_and_never_below_zero():
    counters = ErrorCounters(transmit=9, receive=2)
    for _ in range(4):
        counters.transmitted()
        counters.received()
    assert (counters.transmit, counters.receive) == (5, 0)


def test_the_way_back_from_bus_off():
    counters = ErrorCounters(transmit=250, receive=90)
    counters.transmit_error()
    assert counters.state is OFF
    assert not counters.heard_recessive(127)
    counters.receive_error()
    assert counters.state is OFF
    assert counters.heard_recessive(1)
    assert (counters.state, counters.transmit, counters.receive) == (ACTIVE, 0, 0)
    assert not counters.heard_recessive(5)


def test_a_missing_acknowledgement_never_ends_in_bus_off():
    counters = ErrorCounters()
    for _ in range(100):
        counters.transmit_error(acknowledge=True)
    assert (counters.transmit, counters.state) == (128, PASSIVE)


# --- on the bus -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bit", [0, 12, 10_000])
def test_a_corrupted_frame_is_sent_again(bit):
    sender, receiver = Scripted({0: [FRAME]}), Scripted()
    bus, seen = make_bus(sender, receiver, errors=ErrorsAt({0: bit}))
    bus.clock.sleep_until_ns(10**8)
    lost = min(bit, BITS - 4) + 1 + ERROR_BITS
    assert seen == [(*FRAME, (lost + BITS - 3) * BIT)]
    assert (bus.frames, bus.error_frames) == (1, 1)
    assert bus.counters(sender).transmit == 7  # 8 for the error, 1 back for the success
    assert bus.counters(receiver).receive == 0
    assert bus.busy_ns == (lost + BITS) * BIT


def test_a_retransmission_competes_again():
    high = (0x010, b"")
    bus, seen = make_bus(Scripted({0: [FRAME]}), Scripted({1: [high]}), errors=ErrorsAt({0: 5}))
    bus.clock.sleep_until_ns(10**8)
    assert [frame[:2] for frame in seen] == [high, FRAME]


@pytest.mark.parametrize("queue", ["priority", "fifo"])
def test_a_retransmission_comes_before_the_nodes_next_frame_of_the_same_identifier(queue):
    frames = [(0x155, bytes([k])) for k in range(4)]
    bus, seen = make_bus(Scripted({0: frames}), Scripted(), errors=ErrorsAt({0: 5, 2: 60}), queue=queue)
    bus.clock.sleep_until_ns(10**8)
    assert [frame[:2] for frame in seen] == frames


def test_sixteen_errors_make_passive_and_a_passive_sender_waits_eight_bits():
    """Meanwhile a frame of lower priority gets in, which it would not behind an active sender. (With sixteen errors the
    success of the frame makes it active again: 128 - 1.)"""
    low = (0x700, b"\5")
    for errors, waits, order in ((16, 1, [0x155, 0x156, 0x700]), (17, 2, [0x155, 0x700, 0x156])):
        sent = errors * (4 + ERROR_BITS) + waits * 8  # waits before its second try as a passive node, too
        sender = Scripted({0: [FRAME, (0x156, b"")]})
        bus, seen = make_bus(
            sender, Scripted({(sent + 10) * BIT: [low]}), errors=ErrorsAt(dict.fromkeys(range(errors), 3))
        )
        bus.clock.sleep_until_ns(10**8)
        assert [frame[0] for frame in seen] == order
        assert seen[0][2] == (sent + BITS - 3) * BIT
        assert bus.error_frames == errors


def test_thirty_two_errors_cut_a_node_off_until_it_has_heard_128_times_eleven_recessive_bits():
    sender = Scripted({0: [FRAME, (0x156, b"")], 10**6: [(0x157, b"lost")], 10**7: [(0x158, b"back")]})
    receiver = Scripted()
    bus, seen = make_bus(sender, receiver, errors=ErrorsAt(dict.fromkeys(range(32), 3)))
    sixteen = 16 * (4 + ERROR_BITS)
    passive = 16 * (4 + ERROR_BITS + 8)
    off = (sixteen + passive - 3) * BIT  # the last bit of its last error delimiter
    bus.clock.sleep_until_ns(off + 128 * 11 * BIT - 8 * BIT - 1)
    assert bus.counters(sender).state is OFF
    assert bus.clock.now_ns() > 10**6, "it wanted to say 157h meanwhile"
    bus.clock.sleep_until_ns(off + 128 * 11 * BIT - 8 * BIT)
    assert bus.counters(sender) == ErrorCounters(bus_offs=1)
    assert bus.counters(receiver).state is ACTIVE
    bus.clock.sleep_until_ns(10**8)
    assert [frame[:2] for frame in seen] == [(0x158, b"back")]


def test_others_go_on_and_the_recovery_counts_their_frames():
    """Between two frames end to end there is one sequence of eleven recessive bits: ACK delimiter to intermission."""
    sender = Scripted({0: [FRAME]})
    other = Source((0x200, b"\x55"), [1_100_000] * 127)
    listener = Scripted()
    bus, seen = make_bus(sender, other, listener, errors=ErrorsAt(dict.fromkeys(range(32), 3), can_id=0x155))
    bus.clock.sleep_until_ns(1_099_999)
    assert bus.counters(sender).state is OFF
    heard_before = 128 - bus.counters(sender).outstanding
    bus.clock.sleep_until_ns(1_100_000 + 40 * exact_bits(0x200, b"\x55") * BIT + 1)
    assert 128 - bus.counters(sender).outstanding == pytest.approx(heard_before + 40, abs=1)
    assert all(frame[0] == 0x200 for frame in seen)
    bus.clock.sleep_until_ns(10**8)
    assert bus.counters(sender).state is ACTIVE
    assert sender.heard and len(sender.heard) < len(listener.heard), "a node that is off hears nothing"


def test_a_node_alone_gets_no_acknowledgement():
    bus, seen = make_bus(lonely := Scripted({0: [FRAME]}))
    bus.clock.sleep_until_ns(10**8)
    assert seen == [] and bus.error_frames > 100
    assert bus.counters(lonely).state is PASSIVE
    bus.attach(Scripted())
    bus.clock.sleep_until_ns(2 * 10**8)
    assert [frame[:2] for frame in seen] == [FRAME]


def test_bit_errors_hit_at_their_rate_and_repeat_with_their_seed():
    bits, rate, frames = 120, 1e-3, 20_000
    model, again, other = BitErrors(rate, 1), BitErrors(rate, 1), BitErrors(rate, 2)
    hits = [model(1, b"", bits) for _ in range(frames)]
    assert hits == [again(1, b"", bits) for _ in range(frames)]
    assert hits != [other(1, b"", bits) for _ in range(frames)]
    share = sum(hit is not None for hit in hits) / frames
    expected = 1 - (1 - rate) ** bits
    assert share == pytest.approx(expected, abs=4 * (expected * (1 - expected) / frames) ** 0.5)
    assert all(hit is None or 0 <= hit < bits for hit in hits)
    assert BitErrors(0.0, 1)(1, b"", 10**9) is None
    with pytest.raises(ValueError):
        BitErrors(1.0, 1)


def test_a_babbling_idiot_shuts_everybody_below_it_up():
    shout = (0x000, b"")
    period = exact_bits(*shout) * BIT
    idiot = Babbler(shout, period, first_ns=10**6, last_ns=5 * 10**6)
    speaker = Source((0x080, b"\1"), range(0, 10**7, 500_000))
    bus, seen = make_bus(idiot, speaker, Scripted())
    bus.clock.sleep_until_ns(10**7)
    times = [t for can_id, _, t in seen if can_id == 0x080]
    assert len(times) == 20, "nothing is lost"
    assert not [t for t in times if 1_100_000 < t < 4_900_000]
    assert {can_id for can_id, _, t in seen if 1_100_000 < t < 4_900_000} == {0x000}
    with pytest.raises(ValueError):
        Babbler(shout, 0)


def test_a_port_shows_the_state_of_its_controller():
    bus, _ = make_bus(Scripted(), errors=ErrorsAt(dict.fromkeys(range(32), 3)))
    port = bus.port()
    port.send_batch([FRAME])
    seen = set()
    for t_ns in range(0, 3_000_000, 10_000):
        bus.clock.sleep_until_ns(t_ns)
        seen.add(port.state)
    assert seen == {ACTIVE, WARNING, PASSIVE, OFF}
    assert port.state is ACTIVE, "it is back"
    assert port.counters.error_frames == 32
