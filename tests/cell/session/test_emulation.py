"""`canprobe emulate --store DIR`: what a master stored is there when the nodes are started again."""

from __future__ import annotations

import threading
from contextlib import nullcontext

import pytest

from canprobe.cli import main
from canprobe.fieldbus.bus.clock import MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.real.adapters import LOCAL_GROUP
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, LockstepPort
from canprobe.fieldbus.eds.packaged import load_eds

SAVE_ALL = bytes.fromhex("2310100173617665")


@pytest.fixture
def served(monkeypatch):
    """Runs `canprobe emulate free` up to its serving, with a function that gets the nodes instead; the exit status."""

    def emulate(act, *options, what=("free", "--channel", "vcan0", "--nodes", "1,2")):
        bus = LockstepBus(VirtualClock())
        monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", lambda *_, **__: bus.port())
        monkeypatch.setattr("canprobe.cell.session.bus_tools.rehearse", lambda plan: None)
        for name, stand_in in (("ask_for_processor", lambda: False), ("garbage_collection_paused", nullcontext)):
            monkeypatch.setattr(f"canprobe.cell.session.served.{name}", stand_in)  # not for the tests' own process

        def serve(buses, stop, **_):
            emulate.look = stop
            act(buses[0][0])

        monkeypatch.setattr("canprobe.fieldbus.node.serve.serve", serve)
        return main(["emulate", *what, *options])

    return emulate


def ask(node, text):
    return node.receive(0x600 + node.node_id, bytes.fromhex(text), 0)[0][1].hex()


def change(participants):
    for node in participants[:2]:
        node.start(0)
        assert ask(node, f"23676000{node.node_id:02x}020000") == "6067600000000000"  # 6067h
        assert node.receive(0x600 + node.node_id, SAVE_ALL, 0)[0][1][0] == 0x60


class RunningClock(MonotonicClock):
    """Real time for a port that waits for nothing."""

    def step(self, until_ns):
        return False


READ_1000 = bytes.fromhex("4000100000000000")


def test_faults_are_thrown_from_the_start_and_while_the_nodes_are_served(served, capsys, monkeypatch):
    answers = []

    def inject(*words):
        """`canprobe inject` in another thread, as the process serves meanwhile."""
        status = []
        thread = threading.Thread(target=lambda: status.append(main(["inject", "--channel", "lockstep", *words])))
        thread.start()
        while thread.is_alive():
            assert not served.look()
        return status[0]

    def act(participants):
        first, second = participants[:2]
        for node in (first, second):
            node.start(0)
        clock = MonotonicClock()

        def heard(node):
            return len(node.receive(0x600 + node.node_id, READ_1000, clock.now_ns()))

        answers.append((heard(first), heard(second)))
        answers.append(inject("node 1: mute"))
        answers.append((heard(first), heard(second)))
        answers.append(inject("node 3: mute"))
        answers.append(inject("--clear"))
        answers.append((heard(first), heard(second)))

    opened = LockstepPort.__init__

    def on_a_running_clock(port, bus):
        opened(port, bus)
        port.channel, port.clock = "lockstep", RunningClock()

    monkeypatch.setattr(LockstepPort, "__init__", on_a_running_clock)
    assert served(act, "--inject", "node 2: sdo-silent") == 0
    assert answers == [(1, 0), 0, (0, 0), 2, 0, (1, 1)]
    told = capsys.readouterr()
    assert "thrown: mute at node 1" in told.out and "ended: sdo-silent at node 2" in told.out
    assert "no node 3 is emulated here; nodes: 1, 2" in told.err
    assert served(act, "--inject", "node 2: sdo-silence") == 2
    assert "did you mean sdo-silent?" in capsys.readouterr().err


def test_stored_values_are_there_again_each_with_its_node(served, tmp_path):
    assert served(change, "--store", str(tmp_path / "nodes")) == 0
    assert sorted(path.name for path in (tmp_path / "nodes").iterdir()) == ["node001.json", "node002.json"]
    found = []

    def look(participants):
        for node in participants[:2]:
            node.start(0)
            found.append(ask(node, "4067600000000000")[8:])

    assert served(look, "--store", str(tmp_path / "nodes")) == 0
    assert found == ["01020000", "02020000"]
    assert served(look) == 0
    default = load_eds("puma260_joint", 1)[0x6067].default
    assert found[2:] == [default.to_bytes(4, "little").hex()] * 2 != found[:2]


@pytest.mark.parametrize(
    ("channel", "wide", "what"),
    [
        ("239.74.163.2", True, ("free", "--nodes", "1")),
        ("ff15::1", True, ("--eds", "puma260_joint", "--node-id", "1")),
        (LOCAL_GROUP, False, ("free", "--nodes", "1")),
    ],
)
def test_nodes_that_other_machines_reach_are_served_with_the_warning_of_a_run(served, capsys, what, channel, wide):
    assert served(lambda _: None, "--bus", "udp_multicast", "--channel", channel, what=what) == 0
    warned = (
        f"warning: bus.channel = {channel}: every machine on this network segment hears this bus and can command its"
        f" nodes; --channel {LOCAL_GROUP} keeps it on this machine"
    )
    assert (warned in capsys.readouterr().err) is wide


def test_a_file_that_cannot_be_used_is_told_in_one_line(served, tmp_path, capsys):
    (tmp_path / "node001.json").write_text("{}")
    assert served(change, "--store", str(tmp_path)) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "node001.json" in line]
    assert "no stored parameters of a node can be read from it" in line
