"""Node ids over LSS on a lockstep bus: blank nodes found, named and given their ids."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from canprobe.cell.master.commission import (
    Assignment,
    Wanted,
    assign,
    choose_assignments,
    commission,
    find_unconfigured,
)
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.lss import Lss
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.bus.virtual.timed import TimedBus
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode, set_serial_number
from canprobe.fieldbus.protocol.lss import LssAddress, LssState

EDS = "puma260_joint"
ANY = (None, None, None)


def make_node(serial, node_id=255, eds=EDS):
    node = SlaveNode(load_eds(eds, 1 if node_id == 255 else node_id), node_id, od_of=partial(load_eds, eds))
    set_serial_number(node, serial)
    return node


def address(serial):
    return LssAddress(0xCA5E, 0x260, 0x10000, serial)


@pytest.fixture
def bus():
    """In time on the wire: equal answers of several nodes come one after another."""
    return TimedBus(VirtualClock(), "can0", bitrate=1_000_000)


def put(bus, *nodes):
    for node in nodes:
        bus.attach(node)
    return nodes


def test_all_nodes_without_an_id_are_found_in_order_and_left_waiting(bus):
    serials = [int(n) for n in np.random.default_rng(3).integers(0, 1 << 32, 6)] + [0, 0xFFFFFFFF]
    put(bus, *(make_node(serial) for serial in serials), make_node(7, node_id=7))
    network = PumpedNetwork(bus.port())
    assert find_unconfigured(network) == [address(serial) for serial in sorted(serials)]
    assert find_unconfigured(network) == [address(serial) for serial in sorted(serials)]
    assert Lss(network).inquire_node_ids() == []


def test_a_bus_without_blank_nodes_is_told_at_once(bus):
    put(bus, make_node(7, node_id=7))
    port = bus.port()
    assert find_unconfigured(PumpedNetwork(port)) == []
    assert port.clock.now_ns() < 1_000_000_000


def test_two_devices_with_one_address_are_refused(bus):
    put(bus, make_node(5), make_node(5), make_node(4))
    with pytest.raises(BusError, match=r"more than one node without an id has the address 0xca5e:0x260:0x10000:0x5 "):
        find_unconfigured(PumpedNetwork(bus.port()))


def answering_when_selected(node):
    """As CANopenNode does: a device without an id answers fastscan in LSS configuration state too."""
    hear = node.receive

    def receive(can_id, data, t_ns):
        if can_id == 0x7E5 and data[0] == 0x51:
            node.lss.state = LssState.WAITING
        return hear(can_id, data, t_ns)

    node.receive = receive
    return node


def test_a_device_that_is_found_again_ends_the_search_and_gets_an_id_by_its_name_alone(bus):
    nodes = put(bus, make_node(5), answering_when_selected(make_node(7)), make_node(9))
    port = bus.port()
    told = r"^can0: the device 0xca5e:0x260:0x10000:0x7 .* again .* CiA 305, .* --assign 0xca5e:0x260:0x10000:0x7=ID,"
    with pytest.raises(BusError, match=told):
        commission(port, [Wanted(3, "--assign", (*ANY, None))], must=True)
    assert port.clock.now_ns() < 20_000_000_000
    assert [node.node_id for node in nodes] == [255] * 3, "which of them was meant?"
    commission(port, [Wanted(3, "--assign", (*ANY, 7))], must=True)
    assert [node.node_id for node in nodes] == [255, 3, 255]
    assert commission(port, [], must=True).unconfigured == [address(5), address(9)]


def test_lost_answers_do_not_give_a_wrong_address(bus):
    """Every third answer of fastscan never arrives: an address that nobody confirms is none."""

    class Deaf:
        def __init__(self, port):
            self._port, self._count = port, 0
            self.clock, self.channel = port.clock, port.channel
            self.send_batch, self.wait = port.send_batch, port.wait

        def drain(self):
            frames = []
            for frame in self._port.drain():
                self._count += frame[0] == 0x7E4
                if frame[0] != 0x7E4 or self._count % 3:
                    frames.append(frame)
            return frames

    put(bus, make_node(0x12345678))
    with pytest.raises(BusError, match="not to the end of a search"):
        find_unconfigured(PumpedNetwork(Deaf(bus.port())))


@pytest.mark.parametrize("store", [True, False])
def test_an_assigned_node_boots_with_its_id_and_keeps_it_where_asked(bus, store):
    first, second = put(bus, make_node(0x11), make_node(0x22))
    network = PumpedNetwork(bus.port())
    assert assign(network, Assignment(address(0x22), 9), store=store) is store
    assert (first.node_id, second.node_id) == (255, 9)
    assert second.store.node_id == (9 if store else None)
    assert find_unconfigured(network) == [address(0x11)]


def test_an_id_is_changed_by_reset_communication(bus):
    (node,) = put(bus, make_node(0x11, node_id=4))
    assert assign(PumpedNetwork(bus.port()), Assignment(address(0x11), 9, before=4))
    assert node.node_id == 9


def test_a_device_that_is_not_there_or_refuses_is_named(bus):
    (node,) = put(bus, make_node(0x11))
    network = PumpedNetwork(bus.port())
    with pytest.raises(NodeError, match=r"node 9: the device 0xca5e:0x260:0x10000:0x12 did not take the id: no answer"):
        assign(network, Assignment(address(0x12), 9))
    with pytest.raises(NodeError, match="did not take the id: LSS error 1"):
        assign(network, Assignment(address(0x11), 200))
    assert node.node_id == 255


WANTED = Wanted(3, "joint 3", (0xCA5E, 0x260, None, None))


def choose(wanted, blank, present=(), must=True):
    devices = {node_id: None if serial is None else address(serial) for node_id, serial in dict(present).items()}
    return choose_assignments(wanted, [address(s) for s in blank], devices, channel="can0", must=must)


def test_the_one_device_that_fits_is_chosen():
    other = Wanted(5, "joint 5", (0xCA5E, 0x260, None, 0x22))
    assert choose([WANTED], [0x11]) == [Assignment(address(0x11), 3)]
    assert choose([other], [0x11, 0x22]) == [Assignment(address(0x22), 5)]
    assert choose([other], [0x11], {2: 0x22}) == [Assignment(address(0x22), 5, before=2)]
    assert choose([other], [], {5: 0x22}) == []
    assert choose([WANTED], [], {}, must=False) == []
    assert choose([WANTED], [0x11], {3: 0x99}, must=False) == []


@pytest.mark.parametrize(
    ("wanted", "blank", "present", "words"),
    [
        ([WANTED], [], {}, r"node 3: \(joint 3\) no device on can0 is 0xca5e:0x260:any:any; without an id: none"),
        ([Wanted(3, "x", (*ANY, 7))], [8], {}, r"is any:any:any:0x7; without an id: 0xca5e:0x260:0x10000:0x8"),
        ([WANTED], [1, 2], {}, r"2 devices could be meant: .*:0x1, .*:0x2 .*--assign 0x1=3"),
        ([Wanted(3, "x", (*ANY, 7))], [7], {3: 9}, r"the id is busy: the device 0xca5e:0x260:0x10000:0x9"),
        ([WANTED], [7], {3: None}, "the id is busy: a device without a complete identity"),
        ([WANTED, Wanted(4, "joint 4", WANTED.numbers)], [7], {}, "node 4: .* could also be node 3: .* serial number"),
    ],
)
def test_what_is_not_clear_is_refused(wanted, blank, present, words):
    with pytest.raises(NodeError, match=words):
        choose(wanted, blank, present)


def test_nothing_is_changed_where_one_wish_cannot_be_met(bus):
    nodes = put(bus, make_node(1), make_node(2))
    wishes = [Wanted(3, "--assign", (*ANY, 1)), Wanted(4, "--assign", (*ANY, 9))]
    with pytest.raises(NodeError, match="node 4"):
        commission(bus.port(), wishes, must=True)
    assert [node.node_id for node in nodes] == [255, 255]


def test_a_scene_whose_blank_devices_are_strangers_is_refused(bus):
    put(bus, make_node(1, eds="tactile_array"))
    with pytest.raises(BusError, match="has no id, and is not one of the scene's missing nodes"):
        commission(bus.port(), [WANTED], must=False)
    with pytest.raises(BusError, match="no node without an id answers on"):
        commission(LockstepBus(VirtualClock(), "empty").port(), [WANTED], must=False)
