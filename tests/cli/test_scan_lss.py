"""`canprobe scan --lss` on nodes of `canprobe emulate --without-id`, over a lockstep bus in the place of a real one."""

from __future__ import annotations

import json

import pytest

from canprobe.cell.scene.load import scenes_folder
from canprobe.cli import main
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant

CHANNEL = ("--bus", "socketcan", "--channel", "can0")
DRIVE = "0xca5e:0x260:0x10000"


@pytest.fixture
def bus(monkeypatch):
    """A bus that every command of the test opens."""
    bus = LockstepBus(VirtualClock())
    monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", lambda *_, **__: bus.port())
    return bus


@pytest.fixture
def serve(bus, monkeypatch):
    """Runs `canprobe emulate`; its nodes live on the bus afterwards."""
    monkeypatch.setattr("canprobe.cell.session.bus_tools.rehearse", lambda plan: None)
    monkeypatch.setattr("canprobe.cell.session.served.ask_for_processor", lambda: False)
    nodes = []

    def attach(buses, stop, **_):
        ((participants, _),) = buses
        inner = (getattr(one, "node", one) for one in participants)  # without the wrapping for faults
        nodes[:] = [one for one in inner if hasattr(one, "lss")]
        for node in nodes:
            bus.attach(node)

    monkeypatch.setattr("canprobe.fieldbus.node.serve.serve", attach)

    def emulate(*words):
        assert main(["emulate", *words, "--channel", "can0"]) == 0
        return nodes

    return emulate


def ids(nodes):
    return [node.node_id for node in nodes]


def scan(*words):
    return main(["scan", *words, *CHANNEL])


class Answering(Participant):
    """A node that answers reads with given values, late, on request also from a second device; or only beats."""

    def __init__(self, node_id, values=None, *, late_s=0.0, serials=(9,), beats=b""):
        self.node_id, self.values, self.late_ns, self.serials = node_id, values, round(late_s * 1e9), serials
        self.beats, self.unsent, self.later = beats, b"", []

    @property
    def next_deadline_ns(self):
        return min((t_ns for t_ns, _ in self.later), default=None)

    def start(self, t_ns):
        if self.beats:
            self.later.append((t_ns + 900_000_000, (0x700 + self.node_id, self.beats)))
        return ()

    def advance(self, t_ns):
        due = [frame for at_ns, frame in self.later if at_ns <= t_ns]
        self.later = [entry for entry in self.later if entry[0] > t_ns]
        if (0x700 + self.node_id, self.beats) in due:
            self.start(t_ns)
        return due

    def receive(self, can_id, data, t_ns):
        if can_id != 0x600 + self.node_id or self.values is None or data[0] == 0x80:
            return ()
        frames = [(0x580 + self.node_id, answer.ljust(8, b"\0")) for answer in self.answers(data)]
        self.later += [(t_ns + self.late_ns, frame) for frame in frames if self.late_ns]
        return () if self.late_ns else frames

    def answers(self, data):
        place = data[1:4]
        if data[0] & 0xE0 == 0x60:
            piece, self.unsent = self.unsent[:7], self.unsent[7:]
            return [bytes((data[0] & 0x10 | 7 - len(piece) << 1 | (not self.unsent),)) + piece.ljust(7, b"\0")]
        value = self.values.get((place[0] | place[1] << 8, place[2]))
        if place == b"\x18\x10\x04":
            return [b"\x43" + place + serial.to_bytes(4, "little") for serial in self.serials]
        if value is None:
            return [b"\x80" + place + 0x06020000.to_bytes(4, "little")]
        if len(value) <= 4:
            return [bytes((0x43 | 4 - len(value) << 2,)) + place + value.ljust(4, b"\0")]
        self.unsent = value
        return [b"\x41" + place + len(value).to_bytes(4, "little")]


IDENTITY = {(0x1018, sub): number.to_bytes(4, "little") for sub, number in ((1, 0x2E), (2, 0x77), (3, 0x10001))}


def scanned(capsys, *words):
    assert scan("--json", *words) == 0
    return {node["node_id"]: node for node in json.loads(capsys.readouterr().out)}


def test_a_scan_lists_nodes_that_are_late_short_doubled_or_only_beat(bus, capsys):
    """Right values: 49 µ in Latin-1 is B5h, in UTF-8 C2h B5h; 1018h has numbers of four bytes; 4 is stopped."""
    names = {10: "µDrive, long".encode(), 11: "µDrive, long".encode("latin-1")}
    for node_id, name in names.items():
        bus.attach(Answering(node_id, {**IDENTITY, (0x1008, 0): name}))
    bus.attach(Answering(13, IDENTITY, late_s=0.4))
    bus.attach(Answering(14, IDENTITY, serials=(9, 10), beats=b"\x7f"))
    bus.attach(Answering(20, {**IDENTITY, (0x1018, 1): b"\x2e\0"}))
    bus.attach(Answering(22, beats=b"\x04"))
    bus.attach(Answering(23, beats=b"\x05"))
    found = scanned(capsys)
    assert list(found) == [10, 11, 13, 14, 20, 22, 23]
    assert [found[n]["device_name"] for n in (10, 11, 13)] == ["µDrive, long", "µDrive, long", None]
    assert {found[n]["serial_number"] for n in (10, 11, 13, 14, 20)} == {9}
    assert (found[20]["vendor_id"], found[20]["product_code"]) == (None, 0x77)
    assert {n: (node["devices"], node["state"]) for n, node in found.items()} == {
        **dict.fromkeys((10, 11, 13, 20), (1, None)),
        14: (2, "PRE_OPERATIONAL"),
        22: (0, "STOPPED"),
        23: (0, "OPERATIONAL"),
    }
    assert found[14]["serial_numbers"] == [9, 10]
    assert scan() == 0
    out = capsys.readouterr().out
    assert "node 14: 2 devices answer with this id, serial numbers 0x9 and 0xa: disconnect one" in out
    assert "node 22: sends heartbeats (STOPPED), but answers no SDO request; a stopped node answers none" in out


@pytest.mark.parametrize(
    ("words", "serials"),
    [((), {13: 9, 15: None}), (("--timeout", "0.3"), {13: None}), (("--timeout", "2"), {13: 9, 15: 9})],
)
def test_a_scan_waits_as_long_as_bring_up_or_as_asked(bus, capsys, words, serials):
    bus.attach(Answering(13, IDENTITY, late_s=0.45))
    bus.attach(Answering(15, IDENTITY, late_s=1.9))
    assert {node_id: node["serial_number"] for node_id, node in scanned(capsys, *words).items()} == serials


def test_a_user_finds_the_blank_nodes_names_them_and_scans_again(serve, capsys):
    nodes = serve("free", "--without-id", "3,5")
    assert ids(nodes) == [1, 2, 255, 4, 255, 6]
    said = capsys.readouterr().err
    assert f"serving nodes 1, 2, 4, 6, and without an id {DRIVE}:0x3, {DRIVE}:0x5 on can0" in said
    assert scan("--lss") == 0
    out = capsys.readouterr().out
    assert f"without an id: {DRIVE}:0x3 " in out and f"without an id: {DRIVE}:0x5 " in out
    assert scan("--lss", "--assign", "3=3", "--assign", f"{DRIVE}:0x5=15", "--no-store") == 0
    out = capsys.readouterr().out.splitlines()
    assert out[:2] == [
        f"{DRIVE}:0x3 is node 3 now; until its power goes",
        f"{DRIVE}:0x5 is node 15 now; until its power goes",
    ]
    assert [line.split()[0] for line in out[3:]] == ["1", "2", "3", "4", "6", "15"]
    assert ids(nodes) == [1, 2, 3, 4, 15, 6]
    assert scan("--lss") == 0
    assert "no node without an id answers on can0" in capsys.readouterr().out


def test_the_only_blank_node_needs_no_name(serve, capsys):
    nodes = serve("--eds", "tactile_array.eds", "--node-id", "255", "--serial", "0x4711")
    assert scan("--lss", "--assign", "16", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [(one["node_id"], one["serial_number"], one["stored"]) for one in document["assigned"]] == [
        (16, 0x4711, True)
    ]
    assert document["unconfigured"] == [] and [node["node_id"] for node in document["nodes"]] == [16]
    assert ids(nodes) == [16]


def test_a_scene_gives_its_nodes_their_ids(serve, capsys, tmp_path):
    """Serial numbers in the scene: ids as they stand there, whoever had which before; bring-up then checks them."""
    text = (scenes_folder() / "free.toml").read_text()
    scene = tmp_path / "mine.toml"
    scene.write_text(text + "".join(f"\n[joints.joint_{n}]\nserial_number = {1000 + n}\n" for n in range(1, 7)))
    nodes = serve(str(scene), "--without-id", "1-6")
    assert ids(nodes) == [255] * 6
    nodes[0].lss.pending = 21  # one has an id of its own already
    nodes[0].start(0)
    assert scan(str(scene), "--lss") == 0
    assert "0xca5e:0x260:0x10000:0x3e9 is node 1 now, before 21" in capsys.readouterr().out
    assert ids(nodes) == [1, 2, 3, 4, 5, 6]


def test_a_scene_without_serial_numbers_places_the_one_that_is_missing(serve, capsys):
    nodes = serve("listen", "--without-id", "16")
    assert scan("listen", "--lss") == 0
    assert "is node 16 now" in capsys.readouterr().out
    assert ids(nodes)[-1] == 16


def test_drives_that_only_a_serial_number_could_tell_apart_are_refused(serve, capsys):
    nodes = serve("free", "--without-id", "2,3")
    assert scan("free", "--lss") == 3
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("canprobe: node 2: (joint 2) 2 devices could be meant:") and "--assign 0x2=2" in line
    assert ids(nodes) == [1, 255, 255, 4, 5, 6]


def test_an_id_is_stored_with_its_device(serve, tmp_path):
    serve("free", "--nodes", "1-2", "--without-id", "2", "--store", str(tmp_path))
    assert scan("--lss", "--assign", "2=9") == 0
    assert json.loads((tmp_path / "serial00000002.json").read_text())["node_id"] == 9


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("--assign", "3"), "--assign goes with --lss"),
        (("free",), "SCENE goes with --lss"),
        (("--no-store",), "--no-store goes with --lss"),
        (("free", "--lss", "--assign", "3"), "--assign or SCENE, not both"),
        (("--lss", "--assign", "1=3", "--assign", "2=3"), "--assign gives id 3 to more than one device"),
        (("--lss", "--assign", "1:2=3"), "expected SERIAL=ID or VENDOR:PRODUCT:REVISION:SERIAL=ID"),
        (("--lss", "--assign", "=3"), "expected a number of 32 bits"),
        (("--lss", "--assign", "0x100000000=3"), "expected a number of 32 bits"),
        (("--lss", "--assign", "1=0"), "expected an integer from 1 to 127"),
    ],
)
def test_a_wrong_command_line_is_one_clear_line(words, what, capsys):
    assert scan(*words) == 2
    assert what in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "what"),
    [
        (("free", "--serial", "3"), "--serial belongs to --eds"),
        (("free", "--without-id", "9"), "--without-id: [9] is not among the nodes to serve"),
        (("--eds", "puma260_joint.eds", "--node-id", "5", "--without-id", "5"), "--without-id belongs to a scene"),
        (("--eds", "puma260_joint.eds", "--node-id", "5", "--serial", "1", "--serial", "2"), "2 --serial, but 1 --eds"),
        (("--eds", "puma260_joint.eds", "--node-id", "255") * 2, "two nodes without an id are the device"),
        (("--eds", "puma260_joint.eds", "--node-id", "128"), "expected an integer from 1 to 127"),
    ],
)
def test_a_wrong_emulate_line_is_one_clear_line(words, what, capsys):
    assert main(["emulate", *words, "--channel", "vcan0"]) == 2
    assert what in capsys.readouterr().err
