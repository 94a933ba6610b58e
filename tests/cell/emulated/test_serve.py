"""Serving nodes on a port, nodes that hear each other, and the truth recorder."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

import canprobe
from canprobe.cell.emulated import world as build
from canprobe.cell.emulated.world import TruthRecorder
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.setup import HomingParameters
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.port import PlainPort
from canprobe.fieldbus.bus.virtual.lockstep import ALL_IDS, LockstepBus, Participant
from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.node.serve import Exchange, serve

MS = 1_000_000
CYCLE = 2_500_000


class Scripted(Participant):
    """A participant that answers by table and remembers what it heard."""

    listens, patient, next_deadline_ns = ALL_IDS, frozenset(), None

    def __init__(self, boot, answers=(), deadline=None):
        self.boot, self.answers, self.heard = boot, dict(answers), []
        self.next_deadline_ns = deadline

    def start(self, t_ns):
        return list(self.boot)

    def receive(self, can_id, data, t_ns):
        self.heard.append(can_id)
        return self.answers.get(can_id, [])

    def advance(self, t_ns):
        self.next_deadline_ns = None
        return [(0x3, b"")]


def step(exchange, frames, t_ns):
    """All frames that leave for the bus."""
    return [frame for batch in exchange.batches(frames, t_ns) for frame in batch]


def test_lowest_identifier_first_fifo_per_node_no_self_reception():
    a = Scripted([(0x300, b""), (0x100, b"")])
    b = Scripted([(0x200, b""), (0x400, b"")], {0x300: [(0x250, b"")]})
    sent = [can_id for can_id, _ in Exchange([a, b]).start(0)]
    assert sent == [0x200, 0x300, 0x100, 0x400, 0x250]
    assert a.heard == [0x200, 0x400, 0x250]
    assert b.heard == [0x300, 0x100]


def test_due_nodes_are_advanced_after_the_frames():
    a, b = Scripted([], {0x80: [(0x181, b"")]}), Scripted([], deadline=10)
    exchange = Exchange([a, b])
    assert exchange.start(0) == []
    assert exchange.next_deadline_ns() == 10
    assert step(exchange, [(0x80, b"", 5)], 9) == [(0x181, b"")]
    assert step(exchange, [], 10) == [(0x3, b"")]
    assert exchange.next_deadline_ns() is None


class Alarm(Scripted):
    """Listens to SYNC alone, which gives it a deadline 1 ns later."""

    listens = (0x80,)

    def receive(self, can_id, data, t_ns):
        self.next_deadline_ns = t_ns + 1 if can_id == 0x80 else self.next_deadline_ns
        return super().receive(can_id, data, t_ns)


def test_a_deadline_that_a_sync_sets_is_kept_where_others_answer_behind_it():
    exchange = Exchange([Alarm([]), Scripted([], {0x201: [(0x181, b"")]})])
    assert exchange.start(0) == []
    assert step(exchange, [(0x80, b"", 5), (0x201, b"", 6)], 9) == [(0x3, b""), (0x181, b"")]


def test_of_several_syncs_the_last_is_answered_and_witnesses_hear_all():
    late, witness = Scripted([], {0x80: [(0x181, b"")]}), Scripted([])
    witness.hears_every_sync = True
    exchange = Exchange([late, witness])
    assert exchange.start(0) == []
    frames = [(0x80, b"\1", 1), (0x201, b"", 2), (0x80, b"\2", 3), (0x80, b"\3", 4), (0x202, b"", 5)]
    assert step(exchange, frames, 9) == [(0x181, b"")]
    assert late.heard == [0x201, 0x80, 0x202]
    assert witness.heard == [0x80, 0x201, 0x80, 0x80, 0x181, 0x202]
    assert exchange.skipped == 2


def test_receptions_never_go_back_in_time():
    """As where their stamps come from a clock that is set; what is in the future is now."""
    heard = []
    node = Scripted([])
    node.receive = lambda can_id, data, t_ns: heard.append(t_ns) or []
    exchange = Exchange([node])
    exchange.start(0)
    step(exchange, [(0x80, b"", 50), (0x201, b"", 45), (0x80, b"", 400)], 60)
    step(exchange, [(0x201, b"", 10), (0x80, b"", 20), (0x201, b"", 70)], 90)
    assert heard == [50, 60, 60, 60, 70]


class Slow(Scripted):
    """Another kind of device, that notes what had left when it began to work on a SYNC."""

    def __init__(self, port, answers=()):
        super().__init__([], answers)
        self.port, self.had_left = port, []

    def receive(self, can_id, data, t_ns):
        if can_id == 0x80:
            self.had_left.append([list(batch) for batch in self.port.sent])
        return super().receive(can_id, data, t_ns)


class OneShot(PlainPort):
    """A port on which the given frames arrive at once; it keeps what is sent."""

    def __init__(self, *arrivals):
        self.clock, self.arrivals, self.sent = VirtualClock(), list(arrivals), []

    def wait(self, until_ns):
        return None

    def drain(self):
        taken, self.arrivals = self.arrivals, []
        return taken

    def send_batch(self, frames):
        self.sent.append(list(frames))


def test_answers_to_sync_leave_before_another_kind_of_node_starts_to_work():
    port = OneShot((0x80, b"", 5))
    a = Scripted([], {0x80: [(0x186, b""), (0x281, b"")], 0x182: [(0x700, b"")]})
    b = Scripted([], {0x80: [(0x182, b"")]})
    slow = Slow(port, {0x80: [(0x150, b"")]})
    serve([([a, b, slow], port)], lambda: bool(port.sent))
    drives, sensor, late = [(0x182, b""), (0x186, b""), (0x281, b"")], [(0x150, b"")], [(0x700, b"")]
    assert port.sent == [drives, sensor, late]
    assert slow.had_left == [[drives]]


def test_nodes_hear_the_sync_before_anybody_s_answer_to_it():
    port = OneShot((0x201, b"", 4), (0x80, b"", 5), (0x202, b"", 6))
    a = Scripted([], {0x80: [(0x181, b"")], 0x201: [(0x81, b"")]})
    b, slow = Scripted([], {0x80: [(0x182, b"")]}), Slow(port)
    serve([([a, b, slow], port)], lambda: bool(port.sent))
    assert port.sent == [[(0x81, b"")], [(0x181, b""), (0x182, b"")]]
    assert a.heard == [0x201, 0x80, 0x182, 0x202]
    assert b.heard == [0x201, 0x81, 0x80, 0x181, 0x202]
    assert slow.heard == [0x201, 0x81, 0x80, 0x181, 0x182, 0x202]


def test_a_node_is_spared_what_it_does_not_listen_to():
    a, b = Scripted([(0x300, b""), (0x301, b"")]), Scripted([])
    b.listens = {0x301}
    Exchange([a, b]).start(0)
    assert b.heard == [0x301]


def test_nodes_of_two_buses_hear_their_own_bus_only(plant):
    clock = VirtualClock()
    buses = [LockstepBus(clock, name) for name in ("a", "b")]
    masters = [bus.port() for bus in buses]
    nodes = [make_drive_node(load_eds("puma260_joint", i), i, i - 1, plant) for i in (1, 2)]
    turn = itertools.count()

    def stop():
        number = next(turn)
        if number == 0:
            for master in masters:  # both ask node 1, which is on the first bus
                master.send_batch([(0x601, bytes.fromhex("4000100000000000"))])
        return number == 2

    serve([([node], bus.port()) for node, bus in zip(nodes, buses, strict=True)], stop)
    heard = [[can_id for can_id, _, _ in master.drain()] for master in masters]
    assert heard == [[0x701, 0x581], [0x702]]


def test_serve_keeps_the_deadlines_of_its_nodes(plant):
    bus = LockstepBus(VirtualClock(), "test")
    master, port = bus.port(), bus.port()
    node = make_drive_node(load_eds("puma260_joint", 1), 1, 0, plant)
    turn = itertools.count()

    def stop():
        if next(turn) == 0:
            master.send_batch([(0x601, bytes.fromhex("2b17100064000000"))])  # heartbeat every 100 ms
        return bus.clock.now_ns() >= 300 * MS

    serve([([node], port)], stop)
    beats = [t_ns for can_id, data, t_ns in master.drain() if (can_id, data) == (0x701, b"\x7f")]
    assert beats[0] == 0  # heartbeats start when they are asked for
    assert beats[1:] == [100 * MS, 200 * MS, 300 * MS]


def test_only_what_every_listener_can_let_wait_is_patient():
    a, b = Scripted([]), Scripted([])
    a.patient, a.listens = frozenset({0x201, 0x202}), {0x201, 0x202, 0x80}
    b.patient, b.listens = frozenset(), {0x202}
    assert Exchange([a, b]).patient == {0x201}


def test_synchronous_rpdos_without_a_deadline_are_patient_in_operational(plant):
    node = make_drive_node(load_eds("puma260_joint", 1), 1, 0, plant)
    exchange = Exchange([node])
    exchange.start(0)
    assert exchange.patient == frozenset()
    step(exchange, [(0, b"\x01\x00", 0)], 0)
    assert exchange.patient == {0x201}
    step(exchange, [(0x601, bytes.fromhex("2b00140564000000"), 0)], 0)  # an event timer: its frame must be seen at once
    assert exchange.patient == frozenset()


def test_a_node_hears_the_heartbeat_of_its_neighbour(plant):
    nodes = [make_drive_node(load_eds("puma260_joint", i), i, i - 1, plant) for i in (1, 2)]
    exchange = Exchange(nodes)
    exchange.start(0)
    step(exchange, [(0x601, bytes.fromhex("23161001fa000200"), 0), (0x602, bytes.fromhex("2b17100064000000"), 0)], 0)
    for k in range(1, 4):
        step(exchange, [], k * 100 * MS)
    step(exchange, [(0x602, bytes.fromhex("2b17100000000000"), 300 * MS)], 300 * MS)
    assert step(exchange, [], 549 * MS) == []
    assert step(exchange, [], 550 * MS) == [(0x81, bytes.fromhex("3081110200000000"))]


def test_truth_recorder_columns(plant):
    recorder = TruthRecorder(plant)
    assert recorder.columns()["t_s"].shape == (0,)
    for k in range(3):
        assert recorder.receive(0x80, bytes((k + 7,)), k * CYCLE) == []
        assert recorder.receive(0x181, bytes(8), k * CYCLE + 1) == []
    columns = recorder.columns()
    assert columns["t_s"].tolist() == [0.0, 0.0025, 0.005]
    assert columns["sync_count"].tolist() == [0, 1, 2]
    assert columns["sync_counter"].tolist() == [7, 8, 9]
    assert columns["q_rad"].shape == (3, 6)
    assert columns["q_rad"][2, 0] == pytest.approx(0.005)
    assert columns["force_n"].tolist() == [2.0] * 3


def test_nobody_records_what_nobody_wants_to_know():
    plan = canprobe.plan(load_scene("press"))
    world = build.make_world(plan, plan.node_ids, truth=False)
    assert world.recorder is None
    assert world.participants == list(world.nodes)


def test_quirks_and_encoders_of_the_setup_are_those_of_its_drives():
    plan = canprobe.plan(load_scene("free"))
    assert plan.setup.arm is not None
    first, second, *others = plan.setup.arm.drives
    incremental = replace(second, zero=HomingParameters(35, 1, 0.0, 0.1, 0.1, 1.0, 10.0))
    drives = (replace(first, quirks=Quirks(boot_ns=5, refuse=(0x605A,))), incremental, *others)
    quirky = replace(plan, setup=plan.setup.changed("arm", drives=drives))
    nodes = build.make_world(quirky, plan.node_ids, homed=False).nodes
    assert [node.start(0) for node in nodes[:3]] == [[], [(0x702, b"\0")], [(0x703, b"\0")]]
    assert nodes[0].advance(5) == [(0x701, b"\0")]
    assert nodes[0].receive(0x601, bytes.fromhex("2b5a600006000000"), 6)[0][1].hex() == "805a600000000106"
    positions = [node.receive(0x600 + node.node_id, bytes.fromhex("4064600000000000"), 7)[0][1] for node in nodes[:3]]
    assert [data[4:] == bytes(4) for data in positions] == [False, True, False]
