"""An LSS slave under random requests, and its place beside the node's other services."""

from __future__ import annotations

from functools import partial

from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.fieldbus import SlaveNode, load_eds
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.protocol.lss import LssCommand

EDS = "puma260_joint"
OD_OF = partial(load_eds, EDS)
ODS = {1: OD_OF(1)}


def od_of(node_id):
    """Every id has the dictionary of node 1: parsing one takes longer than a whole example."""
    return ODS[1]


COMMANDS = [*LssCommand, 0x00, 0x12, 0x45, 0x5F, 0xFF]
REQUESTS = st.tuples(
    st.just(0x7E5),
    st.builds(lambda cs, rest: bytes((cs,)) + rest, st.sampled_from(COMMANDS), st.binary(min_size=7, max_size=7)),
)
LIKELY = st.sampled_from(
    [
        (0x7E5, bytes.fromhex(text.ljust(16, "0")))
        for text in ("0400", "0401", "1103", "1107", "11ff", "17", "5100000000800000")
    ]
    + [(0, bytes((command, 0))) for command in (0x01, 0x02, 0x80, 0x81, 0x82)]
)
OTHERS = st.tuples(st.sampled_from([0x7E5, 0x7E4, 0x000, 0x080]), st.binary(max_size=8))


@settings(max_examples=60, deadline=None)
@given(st.sampled_from([1, 255]), st.lists(st.one_of(LIKELY, REQUESTS, OTHERS), max_size=60))
def test_whatever_is_asked_the_node_stays_one(node_id, frames):
    """It never raises; it has an id it may have; without one it says nothing but LSS answers; with one it is alive."""
    node = SlaveNode(ODS[1], node_id, od_of=od_of)
    node.start(0)
    for t_ns, (can_id, data) in enumerate(frames, start=1):
        before = node.node_id
        answers = node.receive(can_id, data, t_ns)
        assert node.lss.pending == 255 or 1 <= node.lss.pending <= 127
        assert node.node_id == 255 or 1 <= node.node_id <= 127
        assert (node.state is NmtState.INITIALISING) == (node.node_id == 255)
        allowed = {0x7E4, *(0x700 + i for i in (before, node.node_id) if i != 255)}
        assert {i for i, _ in answers if i not in range(0x80, 0x600)} <= allowed
        assert all(len(answer) == 8 for i, answer in answers if i == 0x7E4)
        if node.node_id == 255:
            assert {i for i, _ in answers} <= {0x7E4} and set(node.listens) == {0x7E5}


def test_a_node_that_does_not_speak_lss_does_not_listen_to_it():
    node = SlaveNode(ODS[1], 1)
    node.start(0)
    assert node.lss is None and 0x7E5 not in node.listens
