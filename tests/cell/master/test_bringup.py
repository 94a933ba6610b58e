"""Bring-up in lockstep: side by side, with retries, kept configurations, and a report of what failed where."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from canopen.sdo.exceptions import SdoCommunicationError
from makes import write_eds
from scenes import without_torque
from undrawn import undrawn_run

import canprobe
from canprobe.cell.emulated.world import make_world
from canprobe.cell.master.controller import Command
from canprobe.cell.master.options import RunOptions
from canprobe.cell.session.session import Session
from canprobe.errors import BusError, InterfaceError, NodeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.bus.sdo import read_value, upload
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.eds.packaged import eds_path, load_eds
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort
from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault

MS = 1_000_000


def open_session(tmp_path, *, faults=(), change=None, nodes=None, beside=(), scene="free", rate_hz=400.0, **bring_up):
    """A session in lockstep; `beside` are participants besides its nodes."""
    loaded = canprobe.load_scene(scene)
    loaded = replace(loaded, cycle=replace(loaded.cycle, rate_hz=rate_hz))
    said = []
    session = Session(replace(loaded, bring_up=replace(loaded.bring_up, **bring_up)), RunOptions(tmp_path, said.append))
    session.said = said
    world = session.buses.world
    for node in world.nodes:
        if nodes is not None:
            if node.node_id in nodes:
                node.store.saved = nodes[node.node_id]
            nodes[node.node_id] = node
        if change is not None:
            change(node)
    world.make_faulty(faults)
    world.participants[:0] = beside
    return session


def differing(acts):
    """For `change`: something is done to some nodes, by their ids."""
    return lambda node: acts.get(node.node_id, lambda _: None)(node)


def at_node(node_id, act):
    return differing({node_id: act})


def done_to(session):
    """What bring-up says of each node, in their order."""
    return [line.split(") ", 1)[1] for line in session.said if re.match(r"node \d+: \(.*\) configur", line)]


def frames(tmp_path):
    return [(t, can_id, data) for t, _, can_id, data in read_candump(tmp_path / "bus.log")]


def writes_to(log, node_id):
    return [(d[1] | d[2] << 8, d[3]) for _, i, d in log if i == 0x600 + node_id and d[0] >> 5 == 1]


class Somebody(Participant):
    """Does something 100 ms after the cell's port was opened, while it listens; or at a frame of the cell's."""

    next_deadline_ns = None

    def __init__(self, act, at=None):
        self.next_deadline_ns = 100 * MS if at is None else None
        self._act, self._at = act, at

    def receive(self, can_id, data, t_ns):
        if self._at is not None and self._at(can_id, data):
            self._at = None
            return self._act()
        return []

    def advance(self, t_ns):
        self.next_deadline_ns = None
        return self._act()


def sending(can_id, data):
    return lambda: [(can_id, bytes.fromhex(data))]


def raising(error):
    def act():
        raise error

    return act


def is_reset(can_id, data):
    return can_id == 0 and data[0] == 0x81


def is_write(can_id, data):
    return can_id == 0x603 and data[0] >> 5 == 1


REFUSED = {
    "a heartbeat of our own id": (sending(0x77F, "05"), BusError),
    "Ctrl-C": (raising(KeyboardInterrupt()), KeyboardInterrupt),
    "the interface is lost": (raising(InterfaceError("can0: lost")), InterfaceError),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_did_not_take_over_the_nodes_sends_nothing(tmp_path, what):
    act, kind = REFUSED[what]
    with pytest.raises(kind) as refused:
        open_session(tmp_path, beside=[Somebody(act)]).__enter__()
    assert kind is not BusError or str(refused.value).endswith("another master is at work here; stop it first")
    sent = [frame for frame in frames(tmp_path) if frame[0] < 100 * MS or frame[1] != 0x77F]
    assert sorted(i for _, i, _ in sent) == [0x700 + n for n in range(1, 7)], "the nodes' boot-ups and nothing else"
    assert len(frames(tmp_path)) - len(sent) == (kind is BusError)


FAILED = {
    "Ctrl-C at the reset": ({"beside": [Somebody(raising(KeyboardInterrupt()), is_reset)]}, KeyboardInterrupt),
    "Ctrl-C while they are configured": ({"beside": [Somebody(raising(KeyboardInterrupt()), is_write)]}, BaseException),
    "SYNC after the reset": ({"beside": [Somebody(sending(0x080, ""), is_write)]}, BusError),
}


@pytest.mark.parametrize("what", FAILED)
def test_what_took_over_the_nodes_leaves_them_pre_operational(tmp_path, what):
    """Another device, a drive that does not start and a pressed probe: see below, and `test_preload`."""
    options, kind = FAILED[what]
    with pytest.raises(kind):
        open_session(tmp_path, **options).__enter__()
    assert_left_pre_operational(tmp_path)


def assert_left_pre_operational(tmp_path, before=(0x81,)):
    """The last that each node was told; and what they were told before."""
    commands = [d for _, i, d in frames(tmp_path) if i == 0]
    assert commands[-6:] == [bytes((0x80, n)) for n in range(1, 7)]
    assert {d[0] for d in commands[:-6]} == set(before)


def test_the_nodes_are_configured_side_by_side(tmp_path):
    with open_session(tmp_path) as session:
        assert done_to(session) == ["configured, software 1.0"] * 6
    assert [line for line in session.said if not line.startswith("node ")] == [
        *("listen for another master", "reset nodes 1, 2, 3, 4, 5, 6"),
        *("identify and configure the nodes", "start all nodes"),
    ]
    asked = [i - 0x600 for _, i, _ in frames(tmp_path) if 0x600 < i < 0x680]
    for part in range(1, 6):
        so_far = asked[: len(asked) * part // 6]
        counts = [so_far.count(node_id) for node_id in range(1, 7)]
        assert max(counts) - min(counts) <= 2


def test_a_node_that_does_not_answer_is_named_with_the_entry(tmp_path):
    mute = Fault(BUS_FAULTS["drop"], 3, 300 * MS, 9000 * MS)
    with pytest.raises(NodeError, match=r"node 3: \(joint 3\) read of 1018h:01 failed: No SDO response") as failed:
        open_session(tmp_path, faults=[replace(mute, incoming=True)]).__enter__()
    assert failed.value.node_id == 3
    times = [t for t, i, d in frames(tmp_path) if i == 0x603 and d[0] == 0x40]
    assert [b - a for a, b in pairwise(times)] == [pytest.approx(500 * MS, rel=0.01)] * 2, "two retries"
    others = [t for t, i, _ in frames(tmp_path) if i == 0x601]
    assert len([t for t in others if t < times[1]]) > 20, "the others did not wait for node 3"


def lacking(index, subindex=0):
    return lambda node: node.dictionary.entries.pop(index << 8 | subindex)


def holding(index, value):
    """It holds another value than is written."""
    return lambda node: node.dictionary.on_write(index, lambda sub, _: node.dictionary.put(index, sub, value))


def of_identity(subindex, number):
    return lambda node: node.dictionary.set_default(0x1018, subindex, number)


def with_interpolation(subindex, value, fits):
    """60C2h as delivered; what is written to it is refused unless it fits."""

    def refuse(*written):
        if not fits(*written):
            raise SdoAbort(Abort.VALUE)

    def change(node):
        node.dictionary.set_default(0x60C2, subindex, value)
        node.dictionary.on_check(0x60C2, refuse)

    return change


def never(*_):
    return False


def with_bit_30(node):
    """TPDOs whose COB-IDs have bit 30: the device refuses to clear it, or holds it whatever is written."""
    rtr_off = 1 << 30

    def refuse(subindex, value):
        if subindex == 1 and not value & rtr_off:
            raise SdoAbort(Abort.VALUE)

    def keep(index):
        return lambda sub, value: node.dictionary.put(index, sub, value | rtr_off * (sub == 1))

    for index in range(0x1800, 0x1804):
        node.dictionary.set_default(index, 1, node.dictionary.number(index, 1) | rtr_off)
    node.dictionary.on_check(0x1800, refuse)
    node.dictionary.on_write(0x1801, keep(0x1801))


ACCEPTED = {
    1: (
        of_identity(3, 0x1_0004),
        "has revision 00010004h, puma260_joint.eds describes 00010000h: the same major revision, taken",
    ),
    2: (
        lacking(0x1016, 1),
        "write of 1016h:01 = 0x7f00fa failed: Code 0x06090011, Subindex does not exist: left as the device has it"
        " (the node notices a dead master): the device will not notice a dead master",
    ),
    3: (with_bit_30, None),
    4: (
        holding(0x6066, 7),
        "6066h:00 reads back 0x7 after 0x32 was written: left as the device has it (following error time-out): a drive"
        " that lags is given as long as the device has it",
    ),
    5: (
        with_interpolation(2, -3, lambda subindex, value: (subindex, value) != (2, -4)),
        "takes 60C2h:01 = 250, 60C2h:02 = -5, which means the same as what it refused",
    ),
    6: (with_interpolation(1, 25, never), None),
}


def test_what_a_device_has_otherwise_and_may_is_remarked_and_taken(tmp_path):
    nodes = {}
    acts = {node_id: act for node_id, (act, _) in ACCEPTED.items()}
    with open_session(tmp_path, change=differing(acts), nodes=nodes) as session:
        assert done_to(session) == ["configured, software 1.0"] * 6
        held = {n: tuple(node.dictionary.number(0x60C2, sub) for sub in (1, 2)) for n, node in nodes.items()}
        assert [nodes[3].dictionary.number(index, 1) >> 30 & 1 for index in (0x1800, 0x1801)] == [1, 1]
    assert held == {n: (25, -4) if n != 5 else (250, -5) for n in range(1, 7)}
    assert session.cell.notes.lines() == []
    remarks = [line for line in session.said if re.match(r"node \d: \(joint \d\) (?!configur)", line)]
    assert remarks == [f"node {i}: (joint {i}) {remark}" for i, (_, remark) in ACCEPTED.items() if remark]


FAILING = {
    1: (holding(0x1017, 7), "1017h:00 reads back 0x7 after 0x64 was written"),
    2: (lacking(0x6060), "write of 6060h:00 = 0x8 failed: Code 0x06090011, Subindex does not exist"),
    3: (of_identity(3, 0x2_0000), "1018h:03 revision number expected 0x10000, got 0x20000"),
    4: (of_identity(3, 0xFFFF), "1018h:03 revision number expected 0x10000, got 0xffff"),
    5: (with_interpolation(1, 0, never), "it holds 0x0"),
    # 2.5 ms lie between 3 ms and 2 ms
    6: (
        with_interpolation(2, -3, lambda subindex, value: subindex == 1 or value == -3),
        "it counts in 10^-3 s: cycle.rate_hz = 333.333 or cycle.rate_hz = 500 fits it",
    ),
}


def test_all_that_failed_is_told(tmp_path):
    with pytest.raises(NodeError) as failed:
        open_session(tmp_path, change=differing({node_id: act for node_id, (act, _) in FAILING.items()})).__enter__()
    assert failed.value.node_id == 1
    told = re.split(r"(?:^|; )node \d: \(joint \d\) ", str(failed.value))[1:]
    assert [text.endswith(FAILING[i][1]) for i, text in enumerate(told, 1)] == [True] * 6, told
    assert_left_pre_operational(tmp_path)


def test_a_drive_that_keeps_its_interpolation_time_is_told_with_the_rate_that_fits_it(tmp_path):
    told = r"^node 5: \(joint 5\) write of 60C2h:01 = 0x32 failed.* keeps 25 · 10\^-4 s: cycle.rate_hz = 400 fits it$"
    change = at_node(5, with_interpolation(1, 25, never))
    with pytest.raises(NodeError, match=told):
        open_session(tmp_path, change=change, rate_hz=200.0).__enter__()


def test_a_quotient_of_units_without_sense_is_no_statement(tmp_path):
    acts = {
        1: lambda node: node.dictionary.set_default(0x6092, 1, 0),
        2: lambda node: node.dictionary.set_default(0x6092, 2, 0),
        3: lacking(0x6092, 2),
    }
    with open_session(tmp_path, change=differing(acts)) as session:
        assert done_to(session) == ["configured, software 1.0"] * 6
    assert not any("units a motor turn" in line for line in session.said)


def test_a_drive_in_another_mode_is_not_enabled(tmp_path):
    def stay(node):
        node.dictionary.on_read(0x6061, lambda sub: node.dictionary.put(0x6061, 0, 1))

    told = r"^node 2: \(joint 2\) is in mode 1 \(6061h\) after 6060h = 8 was written"
    with open_session(tmp_path, change=at_node(2, stay), enable_s=0.3) as session, pytest.raises(NodeError, match=told):
        session.cell.run(lambda _: Command())
    words = {d[:2] for _, i, d in frames(tmp_path) if 0x201 <= i <= 0x206}
    assert words == {bytes(2)}, "no drive was switched on"


def test_a_drive_that_changes_its_mode_late_is_waited_for(tmp_path):
    """As one that does so only while SYNC runs."""
    answers = []

    def change(node):
        node.dictionary.on_read(0x6061, lambda _: node.dictionary.put(0x6061, 0, answer()))

    def answer():
        answers.append(8 if session.buses.lockstep.clock.now_ns() > began + 200 * MS else 1)
        return answers[-1]

    with open_session(tmp_path, change=at_node(2, change), enable_s=0.3) as session:
        began = session.buses.lockstep.clock.now_ns()
        session.cell.run(lambda _: Command(done=True))
    assert answers.count(1) == len(answers) - 1 > 3


def test_a_kept_configuration_is_not_written_again_unless_the_scene_or_somebody_has_changed_it(tmp_path):
    def brought_up(saved, **options):
        """Which nodes kept their configuration, what they have stored, and what was sent."""
        nodes = dict(saved)
        with open_session(tmp_path, nodes=nodes, scene="press", store=True, **options) as session:
            kept = ["kept" in done for done in done_to(session)]
        assert session.cell.notes.lines() == []
        return kept, {node_id: node.store.saved for node_id, node in nodes.items()}, frames(tmp_path)

    kept, saved, log = brought_up({})
    assert kept == [False] * 7 and len(writes_to(log, 2)) > 25
    kept, saved, log = brought_up(saved)
    assert kept == [True] * 7 and writes_to(log, 2) == [(0x1016, 1)], "the heartbeat consumer's end"
    assert writes_to(log, 16) == [(0x2003, 0), (0x1016, 1)], "and the tare, which is a command"
    assert brought_up(saved, rate_hz=200.0)[0] == [False] * 7
    saved[3] = {**saved[3], 0x102001: 0}
    assert brought_up(saved)[0] == [True, True, False, True, True, True, True]


def test_any_write_over_sdo_takes_the_date_back():
    nodes = {}
    session = open_session(None, nodes=nodes, store=True)
    with session:
        drive = nodes[1]
        date = session.plan.nodes[0].configuration_date
        assert {sub: drive.dictionary.number(0x1020, sub) for sub in (1, 2)} == date and min(date.values()) > 0
        drive.receive(0x601, bytes.fromhex("2b6660001e000000"), drive.core.now_ns)
        assert [drive.dictionary.number(0x1020, sub) for sub in (1, 2)] == [0, 0]


def test_a_node_that_boots_late_is_reset_again(tmp_path):
    dark = Fault(BUS_FAULTS["freeze"], 2, 200 * MS, 400 * MS)
    with open_session(tmp_path, faults=[dark], boot_up_s=0.2, retries=3):
        pass
    resets = [d for _, i, d in frames(tmp_path) if i == 0 and d[0] == 0x81]
    assert [d[1] for d in resets].count(2) >= 2 and [d[1] for d in resets].count(1) == 1


def deaf_to_starts(number):
    """For `change`: node 3 does not hear its first NMT starts."""

    def deafen(node):
        hear, left = node.receive, [number]

        def receive(can_id, data, t_ns):
            if can_id == 0 and data == b"\x01\x03" and left[0]:
                left[0] -= 1
                return []
            return hear(can_id, data, t_ns)

        node.receive = receive

    return at_node(3, deafen)


def test_a_lost_start_is_sent_again(tmp_path):
    with open_session(tmp_path, change=deaf_to_starts(2)):
        pass
    starts = [d[1] for _, i, d in frames(tmp_path) if i == 0 and d[0] == 0x01]
    assert starts == [1, 2, 3, 4, 5, 6, 3, 3]


def answered(place, *answers):
    """What is read of an object of the drive by these answers."""
    index, subindex = place
    talk = read_value(load_eds("puma260_joint", 3)[index][subindex])
    next(talk)
    with pytest.raises(StopIteration) as ended:
        for answer in answers:
            talk.send(bytes.fromhex(answer))
    return ended.value.value


@pytest.mark.parametrize(
    "answers",
    [
        ["42c26002fc555555"],
        ["43c26002fc000000"],
        ["43c26002fcffffff"],
        ["41c2600204000000", "07fcffffff000000"],
    ],
    ids=["without a size", "zeros", "sign", "segments"],
)
def test_an_answer_of_another_length_is_read_in_the_objects_own(answers):
    """CiA 301, SDO upload initiate: an expedited answer need not tell its size. 60C2h:02 is -4, an INTEGER8."""
    assert answered((0x60C2, 2), *answers) == -4


@pytest.mark.parametrize(
    ("place", "answer", "told"),
    [
        ((0x60C2, 1), "43c2600119010000", "expected 1 byte, got 4: 19 01 00 00"),
        ((0x60C2, 2), "43c2600219ffffff", "expected 1 byte, got 4: 19 ff ff ff"),
        ((0x1A00, 1), "4f001a0132000000", "expected 4 bytes, got 1: 32"),
    ],
)
def test_a_value_that_does_not_fit_its_object_is_refused(place, answer, told):
    with pytest.raises(SdoCommunicationError, match=told):
        answered(place, answer)


silent = at_node(3, lambda node: setattr(node, "receive", lambda *_: []))


@pytest.mark.parametrize("change", [deaf_to_starts(9), silent, at_node(3, of_identity(2, 7))])
def test_a_failure_ends_with_the_last_emcy_of_the_node(tmp_path, change):
    """Whatever it fails in; the EMCY came before anybody had spoken to it."""
    reports = Somebody(sending(0x083, "0050810000000000"))
    with pytest.raises(NodeError, match=r"^node 3: .*; node 3: EMCY 5000h, device hardware$"):
        open_session(tmp_path, beside=[reports], change=change, boot_up_s=0.2).__enter__()


def test_a_node_that_does_not_start_is_named_with_what_it_sent_before_we_listened(tmp_path):
    def remember(node):
        deaf_to_starts(9)(node)
        if node.node_id == 3:
            node.dictionary.on_read(0x1003, lambda _: node.dictionary.put(0x1003, 1, 0x12345000))

    told = (
        r"node 3: \(joint 3\) is not operational 1 s after NMT start, 3 times: PRE_OPERATIONAL;"
        r" its error history \(1003h\) begins with 5000h, device hardware$"
    )
    with pytest.raises(NodeError, match=told):
        open_session(tmp_path, change=remember).__enter__()


def late(by_s, **bring_up):
    """Each answer of node 3 comes late."""
    fault = Fault(BUS_FAULTS["delay"], 3, 0, 9000 * MS, values={"ms": 1e3 * by_s})
    return {"faults": [fault], "sdo_s": 0.05, "retries": 2, **bring_up}


def test_late_answers_are_taken_for_what_they_answer(tmp_path):
    """A write is read back from the same entry: a late answer to the one is none to the other."""
    with open_session(tmp_path, **late(0.06)) as session:
        done = done_to(session)
    assert int(re.fullmatch(r"configured, software 1.0, (\d+) requests repeated", done[2])[1]) > 20
    assert "repeated" not in done[1]


def test_a_late_answer_is_no_segment():
    talk = upload(0x100A, 0)
    begin, text = bytes.fromhex("410a100006000000"), b"9.8.76"
    assert next(talk) == bytes.fromhex("400a100000000000")
    assert talk.send(begin) == bytes.fromhex("6000000000000000")
    assert talk.send(begin) is None, "asked twice, answered twice"
    with pytest.raises(StopIteration) as ended:
        talk.send(b"\x03" + text + b"\0")
    assert ended.value.value == text


def test_answers_that_come_far_too_late_are_told_with_the_way_out(tmp_path):
    told = r"failed: No SDO response received within 0.05 s, 3 times; .* a larger bring_up.sdo_s$"
    with pytest.raises(NodeError, match=told):
        open_session(tmp_path, **late(1.0)).__enter__()


def boots_twice(node):
    hear = node.receive

    def receive(can_id, data, t_ns):
        answers = list(hear(can_id, data, t_ns))
        return answers * 2 if answers == [(0x703, b"\0")] else answers

    node.receive = receive


def test_a_node_that_boots_twice_is_brought_up(tmp_path):
    with open_session(tmp_path, change=at_node(3, boots_twice)) as session:
        assert "node 3: (joint 3) sent 2 boot-ups after its reset" in session.said


def test_two_nodes_with_one_id_are_told_from_one_that_boots_twice(tmp_path):
    plan = canprobe.plan(canprobe.load_scene("free"))
    (twin,) = make_world(plan, (3,)).nodes
    told = r"node 3: \(joint 3\) answered .* 2 boot-ups and a request with 2 answers: the node id is in use twice"
    with pytest.raises(NodeError, match=told):
        open_session(tmp_path, beside=[twin]).__enter__()
    assert_left_pre_operational(tmp_path)


def test_a_node_that_boots_again_ends_bring_up(tmp_path):
    """It would run with its defaults. On this bus, full of SDOs, its boot-up comes through after them."""
    booting = Somebody(sending(0x703, "00"), is_write)
    with pytest.raises(NodeError, match=r"node 3: \(joint 3\) booted again after it was configured: check its power"):
        open_session(tmp_path, beside=[booting]).__enter__()
    assert_left_pre_operational(tmp_path, before=(0x81, 0x01))


def test_drives_that_cannot_say_what_they_have_stored_are_configured_each_time(tmp_path):
    scene = canprobe.load_scene("free")
    scene = replace(scene, arm=replace(scene.arm, eds=str(write_eds("bare", tmp_path))))
    session = Session(
        replace(scene, bring_up=replace(scene.bring_up, store=True)), RunOptions(tmp_path, (tell := []).append)
    )
    with session:
        pass
    assert not any("kept" in line for line in tell)
    assert not any(index == 0x1010 for index, _ in writes_to(frames(tmp_path), 2))


def test_drives_that_send_no_torque_are_run_and_logged_without(tmp_path):
    scene = without_torque(canprobe.load_scene("free"), tmp_path, fixed=True)
    result = undrawn_run(scene, out=tmp_path / "out", duration_s=0.1)
    assert result.summary["completed"] and result.summary["faults"] == []
    assert {"q_rad", "statusword"} <= set(result.log) and "torque_permille" not in result.log
    assert any(line.startswith("motor torque (torque_permille of log.npz): ") for line in result.summary["left_out"])


def test_a_drive_without_60c2h_follows_the_period_of_sync(tmp_path):
    """1006h alone tells it the period, so the write of it is required, and the emulated drive takes it."""
    eds = tmp_path / "follower.eds"
    eds.write_text(re.sub(r"(?s)\[60C2(sub\d)?\].*?(?=\n\[)", "", eds_path("puma260_joint").read_text()))
    scene = canprobe.load_scene("free")
    scene = replace(scene, arm=replace(scene.arm, eds=str(eds)))
    plan = canprobe.plan(scene)
    (write,) = [one for one in plan.nodes[0].writes if one.index == 0x1006 and one.value]
    assert (write.value, write.absence, plan.nodes[0].interpolation) == (2500, None, ())
    told = undrawn_run(canprobe.load_scene("free"), out=tmp_path / "told", duration_s=0.3)
    result = undrawn_run(scene, out=tmp_path / "out", duration_s=0.3)
    assert result.summary["completed"] and result.summary["faults"] == []
    assert np.ptp(result.truth["q_rad"][:, 5]) > 0.01
    assert np.array_equal(result.truth["q_rad"], told.truth["q_rad"]), "as the drive that is given 60C2h"
