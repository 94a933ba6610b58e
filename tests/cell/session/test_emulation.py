"""`canprobe emulate --store DIR`: what a master stored is there when the nodes are started again."""

from __future__ import annotations

import pytest

from canprobe.cell.planning.warnings import LOCAL_GROUP
from canprobe.cli import main
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.eds.packaged import load_eds

SAVE_ALL = bytes.fromhex("2310100173617665")


@pytest.fixture
def served(monkeypatch):
    """Runs `canprobe emulate free` up to its serving, with a function that gets the nodes instead; the exit status."""

    def emulate(act, *options, what=("free", "--channel", "vcan0", "--nodes", "1,2")):
        bus = LockstepBus(VirtualClock())
        monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", lambda *_, **__: bus.port())
        monkeypatch.setattr("canprobe.cell.session.emulation.rehearse", lambda plan: None)
        monkeypatch.setattr(
            "canprobe.cell.session.emulation.ask_for_processor", lambda: False
        )  # not for the tests' own process
        monkeypatch.setattr("canprobe.fieldbus.node.serve.serve", lambda buses, stop: act(buses[0][0]))
        return main(["emulate", *what, *options])

    return emulate


def ask(node, text):
    return node.receive(0x600 + node.node_id, bytes.fromhex(text), 0)[0][1].hex()


def change(participants):
    for node in participants[:2]:
        node.start(0)
        assert ask(node, f"23676000{node.node_id:02x}020000") == "6067600000000000"  # 6067h
        assert node.receive(0x600 + node.node_id, SAVE_ALL, 0)[0][1][0] == 0x60


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
    ("channel", "wide"), [("239.74.163.2", True), ("ff15::1", True), (LOCAL_GROUP, False), ("ff01::2", False)]
)
@pytest.mark.parametrize("what", [("free", "--nodes", "1"), ("--eds", "puma260_joint", "--node-id", "1")])
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
