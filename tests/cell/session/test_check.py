"""`canprobe check`: nothing moves, nodes are left as they were found, and a bad link is named with its cause."""

from __future__ import annotations

import contextlib
import json

import pytest

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.check import measure_link, options_of_check
from canprobe.cell.session.session import FirstSecond, Session
from canprobe.cli import main
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState, pack_nmt
from canprobe.fieldbus.tools.link import Fitness
from canprobe.lab.studies.link_setups import SetUp, construct, scene_at


def session_of(scene="free", say=lambda _: None, **overrides):
    plan = make_plan(resolve(canprobe.load_scene(scene, {"bus.timed": True, **overrides})))
    return Session(plan, options_of_check(say))


def test_a_sound_cell_is_fit(capsys):
    assert main(["check", "press", "--seconds", "1", "--json", "--set", "bus.timed=true"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "fit" and report["rate_hz"] == 400.0 and report["cause"] is None
    assert report["fit_rate_hz"] >= 400.0 and report["machine"] is None
    assert [node["node_id"] for node in report["figures"]["nodes"]] == [1, 2, 3, 4, 5, 6]
    assert 0.5 < report["figures"]["load"] < report["figures"]["planned_load"]
    assert main(["check", "free", "--seconds", "1"]) == 0
    assert capsys.readouterr().out.startswith("free on can0: FIT for 400 Hz\n")


VOLATILE = {0x6041, 0x6064, 0x607A, 0x606C, 0x6077, 0x2006, 0x2120}
"""Objects that a device changes by itself, and the target, which follows the position of a disabled drive."""


class FoundCell:
    """A session of a check whose nodes are somebody's: other values than the plan's, node 3 operational."""

    def __init__(self, scene="press", **overrides):
        self.session = session_of(scene, **overrides)
        self.nodes = {node.node_id: node for node in self.session.buses.world.nodes}
        self.nodes[3].dictionary.put(0x1A01, 0, 0)
        self.found = {}
        self.session.around = self.around

    def around(self, port):
        port.send_batch([(0x603, bytes.fromhex("2b17100046000000")), pack_nmt(NmtCommand.START, 3)])
        port.clock.sleep_until_ns(port.clock.now_ns() + 5_000_000)
        port.drain()
        self.found = {i: dict(node.dictionary.values) for i, node in self.nodes.items()}
        return port

    def assert_left_as_found(self, but=frozenset()):
        for i, node in self.nodes.items():
            now, found = node.dictionary.values, self.found[i]
            changed = {key: (found.get(key), now.get(key)) for key in now if now.get(key) != found.get(key)}
            assert {key >> 8 for key in changed} <= VOLATILE | but, (i, {hex(k): v for k, v in changed.items()})
            assert state_of(node.dictionary.number(0x6041)) not in POWERED_STATES or i == 16
        assert self.nodes[3].state is NmtState.OPERATIONAL and self.nodes[2].state is NmtState.PRE_OPERATIONAL


def test_nodes_are_left_as_they_were_found_and_no_drive_is_enabled():
    cell = FoundCell()
    report = measure_link(cell.session, 0.5)
    assert report.fit and not report.remarks
    cell.assert_left_as_found()


def test_a_check_that_is_interrupted_leaves_the_nodes_as_they_were_found(monkeypatch):
    """Ctrl-C in a call of the port: while listening, reading, configuring, cycling, putting back."""
    monkeypatch.setattr("canprobe.cell.session.check.IDLE_S", 0.01)

    def calls_of_a_check(at=None):
        """Number of calls of the port; one of them is interrupted, and what is put back then ends all the same."""
        cell, calls = FoundCell("free", **{"bus.timed": False}), 0
        around = cell.session.around

        def counted(method):
            def call(*arguments):
                nonlocal calls
                calls += 1
                if calls == at:
                    raise KeyboardInterrupt
                return method(*arguments)

            return call

        def wrapped(port):
            port = around(port)
            for name in ("send_batch", "drain", "wait"):
                setattr(port, name, counted(getattr(port, name)))
            return port

        cell.session.around = wrapped
        with contextlib.suppress(KeyboardInterrupt):
            measure_link(cell.session, 0.05)
        cell.assert_left_as_found()
        return calls

    most = calls_of_a_check()
    for share in (0.2, 0.6, 0.8):
        calls_of_a_check(round(share * most))


def test_an_array_that_sends_no_image_is_not_fit():
    session = session_of("listen")
    session.buses.world.make_faulty().inject("node 16: sync-lost", 0)
    verdict = measure_link(session, 1.0).verdict
    assert verdict.fitness is Fitness.UNFIT and verdict.cause == "loss" and "the array sends no images" in verdict.why


def test_a_verdict_needs_a_second(capsys):
    assert main(["check", "free", "--seconds", "0.5"]) == 2
    assert "expected at least 1 s" in capsys.readouterr().err


def test_a_drive_under_power_is_refused_and_nothing_is_written():
    session = session_of()
    node = session.buses.world.nodes[2]

    def around(port):
        node.dictionary.put(0x6041, 0, 0x0237)
        return port

    session.around = around
    before = dict(node.dictionary.values)
    with pytest.raises(NodeError, match=r"node 3: \(joint 3\) is OPERATION_ENABLED: somebody works with this cell"):
        measure_link(session, 0.5)
    changed = {key >> 8 for key in before if node.dictionary.values[key] != before[key]}
    assert changed <= VOLATILE


@pytest.mark.parametrize(
    ("step", "frame"),
    [
        ("listen for another master", (0x77F, b"\5")),
        ("identify and configure the nodes", pack_nmt(NmtCommand.START, 3)),
        ("measure for", (0x080, b"\1")),
    ],
)
def test_another_master_is_refused_whenever_it_comes(step, frame):
    def say(text):
        if text.startswith(step):
            cell.session.buses.lockstep.port().send_batch([frame])

    cell = FoundCell("free", say=say, **{"bus.timed": False})
    with pytest.raises(BusError, match="another master is"):
        measure_link(cell.session, 0.5)
    cell.assert_left_as_found(but={0x1001, 0x1003})  # a SYNC of another length is an error of the nodes


def test_a_node_that_is_not_there_is_status_3(capsys, monkeypatch):
    def silent(*words):
        session = Session(*words)
        session.buses.world.make_faulty().inject("node 5: mute", 0)
        return session

    monkeypatch.setattr("canprobe.cell.session.check.Session", silent)
    assert main(["check", "free", "--seconds", "1"]) == 3
    assert "node 5: (joint 5)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("kind", "size", "fitness"),
    [
        ("delay", 0.7, Fitness.UNFIT),
        ("jitter", 0.1, Fitness.MARGINAL),
        ("loss", 0.01, Fitness.MARGINAL),
        ("load", 0.95, Fitness.UNFIT),
        ("node", 0.7, Fitness.UNFIT),
        ("queue", 0.7, Fitness.UNFIT),
        ("machine", 2.0, Fitness.UNFIT),
    ],
)
def test_a_bad_link_is_named_with_its_cause(kind, size, fitness):
    session = Session(make_plan(resolve(scene_at(100))), options_of_check())
    construct(session, SetUp(1, kind, 100, size, share=0.2, room=1, node_id=4), 0)
    verdict = measure_link(session, 3.0).verdict
    assert (verdict.fitness, verdict.cause) == (fitness, kind), verdict


def test_the_first_second_of_a_run_says_that_the_link_is_not_fit():
    session, said = Session(make_plan(resolve(scene_at(100)))), []
    construct(session, SetUp(1, "machine", 100, 0.8, share=0.06, room=1, node_id=4), 0)
    with session:
        first = FirstSecond(session.cell, session.plan, said.append)
        session.run(lambda measurement: Command(done=measurement.cycle > 250), first)
    (line,) = said
    assert line.startswith("warning: in its first second the link was") and "canprobe check free says why" in line
