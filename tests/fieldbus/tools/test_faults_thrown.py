"""Faults as text, thrown at nodes on a lockstep bus, from a block and over the control channel."""

from __future__ import annotations

import json
import os
import resource
import socket
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from canprobe.errors import InterfaceError, UsageError
from canprobe.fieldbus.protocol.cia402 import DriveState, state_of
from canprobe.fieldbus.tools.faults import BUS_FAULTS, inject, parse_fault
from canprobe.fieldbus.tools.faults.control import ControlServer, request_faults

MS, S = 1_000_000, 1_000_000_000


class Line:
    """Drive 5 on a lockstep bus, and a port that sends and hears hex."""

    def __init__(self, bus, node):
        self.clock, self.port, self.nodes, self.node = bus.clock, bus.port(), bus.faulty, node

    def heard(self, ms):
        self.clock.sleep_until_ns(self.clock.now_ns() + round(ms * MS))
        return [(can_id, data.hex()) for can_id, data, _ in self.port.drain()]

    def ask(self, can_id, text, ms=0.0):
        self.port.send_batch([(can_id, bytes.fromhex(text))])
        return self.heard(ms)

    def word(self, controlword):
        self.ask(0x605, f"2b406000{controlword:02x}000000")
        self.heard(5)
        return state_of(self.node.node.dictionary.number(0x6041))

    def enable(self):
        self.ask(0x605, "2f60600008000000")
        assert [self.word(word) for word in (0x06, 0x07, 0x0F)][-1] is DriveState.OPERATION_ENABLED


@pytest.fixture
def line(emulated_bus, emulated_nodes):
    (node,) = emulated_nodes("puma260_joint", first_id=5)
    return Line(emulated_bus, node)


def test_a_fault_as_people_write_it():
    fault = parse_fault("node 3: delay ms=2 share=0.5 seed=7 count=9 direction=in at 5 s for 200 ms", BUS_FAULTS, S)
    assert (fault.kind.name, fault.node_id, fault.start_ns, fault.duration_ns) == ("delay", 3, 6 * S, 200 * MS)
    assert (fault.value("ms"), fault.share, fault.seed, fault.hits, fault.hears) == (2, 0.5, 7, 9, True)
    aborted = parse_fault(" node 16 : sdo-abort index=0x6060 code=0x08000020 on enabled", BUS_FAULTS)
    assert str(aborted) == "sdo-abort index=0x6060 code=0x8000020 at node 16, on enabled, 100 %"
    assert str(fault) == "delay incoming ms=2 at node 3, 6.0000 s for 200.0 ms, 50 %"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("heartbeat-off", "expected node N: NAME"),
        ("node 3 mute", "expected node N: NAME"),
        ("node 3: heartbeat-of", "did you mean heartbeat-off?"),
        ("node 0: mute", "expected a node from 1 to 127, got 0"),
        ("node 3: mute at 5 h", "expected a time such as 5 s"),
        ("node 3: mute at -1 s", "expected a time such as 5 s"),
        ("node 3: mute on tuesday", "unknown event 'tuesday'"),
        ("node 3: delay s=2", "unknown parameter 's'"),
        ("node 3: delay ms=nan", "ms: expected delay, ms"),
        ("node 3: mute share=2", "share: expected share of the frames that it hits, 0 to 1, got '2'"),
        ("node 3: deaf direction=out", "has its own direction"),
        ("node 3: mute at 1 s on sync", "expected node N: NAME"),
    ],
)
def test_what_is_no_fault_is_refused_in_words(text, told):
    with pytest.raises(UsageError) as refused:
        parse_fault(text, BUS_FAULTS)
    assert told in str(refused.value)


def test_a_node_that_is_not_there_and_a_kind_that_needs_a_drive(line):
    with pytest.raises(UsageError, match="no node 6 is emulated here; nodes: 5"):
        line.nodes.inject("node 6: mute")


MEASURED = {0x100300, 0x100301, 0x603F00, 0x604100, 0x606400}
"""Keys of the error history, the error code, the statusword and the position."""
READ_1000 = "4000100000000000"


@pytest.mark.parametrize(
    ("fault", "request_text", "answers"),
    [
        ("sdo-silent", READ_1000, []),
        ("sdo-abort index=0x1000 code=0x06020000", READ_1000, [(0x585, "8000100000000206")]),
        ("sdo-abort index=0x1000", "4001100000000000", [(0x585, "4f01100000000000")]),
        ("sdo-wrong-object", READ_1000, [(0x585, "4301100092010200")]),
        ("sdo-size", READ_1000, [(0x585, "4700100092010200")]),
        ("mode-refused", "2f60600001000000", [(0x585, "8060600030000906")]),
    ],
)
def test_what_a_fault_makes_of_an_sdo_answer_while_the_block_lasts(line, fault, request_text, answers):
    before = line.ask(0x605, request_text)
    with inject(line.nodes, f"node 5: {fault}"):
        assert line.ask(0x605, request_text) == answers
    assert line.ask(0x605, request_text) == before != []


def test_a_slow_answer_a_wrong_toggle_bit_and_a_share(line):
    with inject(line.node, "node 5: sdo-slow ms=20"):
        assert line.ask(0x605, READ_1000, ms=19) == []
        assert line.heard(1)[0][1].startswith("43001000")
    line.ask(0x605, "4008100000000000")
    with inject(line.node, "node 5: sdo-toggle"):
        ((_, answer),) = line.ask(0x605, "6000000000000000")
    assert int(answer[:2], 16) & 0x10
    with inject(line.node, "node 5: sdo-silent count=2"):
        assert [len(line.ask(0x605, "8000000000000000" if i == 0 else READ_1000)) for i in range(3)] == [0, 0, 1]


def test_heartbeat_boot_up_and_state(line):
    line.ask(0x605, "2b1710000a000000")
    with inject(line.node, "node 5: heartbeat-off"):
        assert line.heard(50) == []
        assert line.ask(0, "8205") == [(0x705, "00")]
    line.ask(0x605, "2b1710000a000000")
    with inject(line.node, "node 5: heartbeat-state state=5"):
        assert set(line.heard(50)) == {(0x705, "05")}
    with inject(line.node, "node 5: no-boot-up"):
        assert line.ask(0, "8205") == []
    line.nodes.inject("node 5: nmt command=1 at 2 ms")
    line.heard(3)
    assert line.node.node.state == 5


def test_an_emcy_is_there_until_the_end_and_bus_off_is_reported(line):
    line.nodes.inject("node 5: emcy code=0x5000 at 1 ms for 5 ms")
    assert line.heard(3) == [(0x85, "0050010000000000")]
    assert line.heard(5) == [(0x85, "0000000000000000")]
    line.nodes.inject("node 5: bus-off for 5 ms")
    assert line.ask(0x605, READ_1000, ms=4) == []
    assert line.heard(5)[0] == (0x85, "4081110000000000")
    assert line.nodes.faults == []


def test_faults_of_a_drive(line):
    line.ask(0, "0105")
    line.enable()
    line.nodes.inject("node 5: drive-fault code=0x4310 resettable=0")
    line.heard(5)
    assert line.word(0x00) is DriveState.FAULT and line.node.node.dictionary.number(0x603F) == 0x4310
    assert line.word(0x80) in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
    line.nodes.clear()
    line.heard(5)
    line.word(0x00)
    assert line.word(0x80) is DriveState.SWITCH_ON_DISABLED
    with inject(line.node, "node 5: sto"):
        assert [line.word(word) for word in (0x06, 0x07, 0x0F)] == [DriveState.SWITCH_ON_DISABLED] * 3
    line.enable()


def test_faults_of_the_encoder_and_the_zero(line):
    def position():
        ((_, answer),) = line.ask(0x605, "4064600000000000", ms=1)
        return int.from_bytes(bytes.fromhex(answer)[4:], "little", signed=True)

    assert position() == 0
    with inject(line.node, "node 5: encoder-jump counts=500"):
        assert position() != 0
    assert position() == 0
    line.nodes.inject("node 5: zero-shift counts=70")
    assert position() == -70


@pytest.mark.parametrize("name", BUS_FAULTS)
def test_no_value_of_a_parameter_makes_the_node_raise_and_the_end_leaves_it_as_it_was(line, name):
    line.ask(0, "0105")
    line.ask(0x605, "2f60600008000000")
    before = dict(line.node.node.dictionary.values)
    for bound in ("low", "high"):
        values = "".join(f" {key}={getattr(one, bound)}" for key, one in BUS_FAULTS[name].parameters.items())
        with inject(line.nodes, f"node 5: {name}{values} seed=3"):
            for request_text in (READ_1000, "4008100000000000", "6000000000000000", "2f60600008000000"):
                line.ask(0x605, request_text, ms=0.05)
                line.ask(0x80, "", ms=0.05)
            line.heard(2 if bound == "high" else 0.1)
        line.heard(0.1)
    line.ask(0, "0105", ms=2)
    assert line.nodes.faults == []
    if name not in ("zero-shift", "reboot", "drive-fault"):
        after = line.node.node.dictionary.values
        assert {key for key in before if before[key] != after[key]} <= MEASURED


def test_on_an_event_and_the_same_again_by_its_seed(line):
    line.nodes.inject("node 5: mute on operational for 5 ms")
    assert len(line.ask(0x605, READ_1000)) == 1
    line.ask(0, "0105")
    assert line.ask(0x605, READ_1000, ms=6) == []
    assert len(line.ask(0x605, READ_1000)) == 1

    def answered(seed):
        with inject(line.nodes, f"node 5: drop share=0.5 seed={seed}"):
            return [len(line.ask(0x605, READ_1000)) for _ in range(20)]

    assert answered(1) == answered(1) != answered(2)


def polled(server, client):
    """A client in a thread of its own, while the server looks."""
    thread = threading.Thread(target=client)
    thread.start()
    while thread.is_alive():
        server.poll(0)
    thread.join()


def test_faults_over_the_control_channel(line):
    with pytest.raises(InterfaceError, match="no process of this user serves nodes there"):
        request_faults("vcan7", ["node 5: mute"])
    with ControlServer("vcan7", line.nodes) as server:
        done = []

        def client():
            done.append(request_faults("vcan7", ["node 5: mute for 2 s"]))
            with pytest.raises(UsageError, match="unknown kind 'mut'"):
                request_faults("vcan7", ["node 5: mut"])
            done.append(request_faults("vcan7", [], clear=True))

        polled(server, client)
        assert done[0]["thrown"] == done[1]["ended"] == ["mute at node 5, 0.0000 s for 2000.0 ms, 100 %"]
    with pytest.raises(InterfaceError, match="no process of this user serves nodes there"):
        request_faults("vcan7", ["node 5: mute"])


def test_another_user_throws_no_faults(line, monkeypatch):
    """Root may reach the process, which hangs up; others do not see one of their own."""
    monkeypatch.setattr("canprobe.fieldbus.tools.faults.control._user", lambda _: 4711)
    said = []

    def client():
        with pytest.raises(InterfaceError, match="no process of this user serves nodes there"):
            request_faults("vcan8", ["node 5: mute"])
        said.append(True)

    with ControlServer("vcan8", line.nodes) as server:
        polled(server, client)
    assert said and line.nodes.faults == []


@pytest.fixture
def server(line):
    with ControlServer("vcan9", line.nodes) as server:
        yield server


@pytest.fixture
def connect():
    """Connects to the server of this process on vcan9."""
    with ExitStack() as stack:

        def connected():
            end = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK))
            end.connect(f"\0canprobe-inject-vcan9-{os.getpid()}")
            return end

        yield connected


MUTE = json.dumps({"faults": ["node 5: mute"], "clear": False}).encode()


def descriptors():
    return len(list(Path("/proc/self/fd").iterdir()))


def test_foreign_connections_are_closed_in_the_look_that_accepts_them(line, server, connect, monkeypatch):
    """In one look, also where each has sent a request, and one of the right user behind them is answered."""
    users = iter([4711] * 40)
    monkeypatch.setattr("canprobe.fieldbus.tools.faults.control._user", lambda _: next(users, os.getuid()))
    foreign, mine = [connect() for _ in range(40)], connect()
    for end in (*foreign[::2], mine):
        end.send(MUTE)
    before = descriptors()
    server.poll(line.clock.now_ns())
    assert descriptors() == before
    for end in foreign[1::2]:
        assert end.recv(100) == b""
    for end in foreign[::2]:  # hung up on with a request unread
        with pytest.raises(ConnectionResetError):
            end.recv(100)
    assert json.loads(mine.recv(1000))["nodes"] == [5]
    assert len(line.nodes.faults) == 1


def test_eight_connections_at_most_and_idle_ones_end_after_a_second(line, server, connect):
    before = descriptors()
    idle = [connect() for _ in range(12)]
    last = connect()
    last.send(MUTE)
    server.poll(0)
    assert descriptors() == before + 13 + 8
    server.poll(S - 1)
    assert descriptors() == before + 13 + 8 and line.nodes.faults == []
    server.poll(S)
    assert [end.recv(100) for end in idle[:8]] == [b""] * 8
    server.poll(S + 1)
    assert json.loads(last.recv(1000))["nodes"] == [5]
    assert descriptors() == before + 13 + 4
    server.poll(2 * S + 1)
    assert descriptors() == before + 13


def test_a_process_without_free_descriptors_goes_on_serving(line, server, connect):
    mine = connect()
    mine.send(MUTE)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with ExitStack() as held:
        resource.setrlimit(resource.RLIMIT_NOFILE, (descriptors() + 8, hard))
        try:
            while True:
                try:
                    held.enter_context(socket.socket())
                except OSError:
                    break
            server.poll(0)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert line.nodes.faults == []
    server.poll(1)
    assert json.loads(mine.recv(1000))["nodes"] == [5]


@pytest.mark.parametrize(
    "request_text", ["[" * 60_000, '{"faults": 3, "clear": false}', "{}", "\0", json.dumps({"faults": [7], "clear": 0})]
)
def test_a_request_that_is_none_ends_nothing(line, server, connect, request_text):
    mine = connect()
    mine.send(request_text.encode())
    server.poll(0)
    assert json.loads(mine.recv(1000)) == {"error": "the request is none: canprobe has another version there"}


def test_an_answer_that_is_too_long_ends_nothing(line, server, connect):
    """Four thousand faults fit into a request, their words into no datagram of this system's size."""
    mine = connect()
    mine.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    mine.send(json.dumps({"faults": ["node 5:mute"] * 4000, "clear": False}).encode())
    server.poll(0)
    assert len(line.nodes.faults) == 4000
    server.poll(1)
