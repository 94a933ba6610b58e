"""What a node costs per frame, against canopen-python's `LocalNode` in the same run. Run with --benchmark-only.

Both nodes are made from `puma260_joint.eds`. "alone" calls them without a bus: frames in by `receive` or `notify`, and
out into a list. "on its bus" adds the way from and to a master: ours on the lockstep bus, `LocalNode` on python-can's
virtual bus, without the threads that its users have. Goals: at most a fifth of `LocalNode` on its bus; seven nodes at
400 Hz under 15 % of a core.

Both get the same frames. `LocalNode` neither applies RPDOs to its dictionary nor answers a SYNC; its TPDO is packed and
sent by hand, as its users have to. So the two do the same work on SDO only; on PDOs ours does more.
"""

from __future__ import annotations

import gc
from statistics import median
from time import process_time

import can
import canopen
import pytest

from canprobe.bus.lockstep import LockstepBus
from canprobe.bus.port import VirtualClock
from canprobe.eds.packaged import eds_path, load_eds
from canprobe.emulator.array import make_tactile_node
from canprobe.emulator.drive.drive import make_drive_node
from canprobe.emulator.node.slave_node import SlaveNode

CYCLE_NS = 2_500_000
UPLOAD = 0x601, bytes.fromhex("4000100000000000")
DOWNLOAD = 0x601, bytes.fromhex("2367600007000000")  # 6067h, an UNSIGNED32 that nothing hangs on
SYNC, RPDO, FOREIGN = (0x80, b"\x01"), (0x201, bytes.fromhex("0f0010270000")), (0x305, bytes(8))
BOOT = [(0x601, bytes.fromhex("2f191000f0000000")), (0, b"\x01\x01")]  # counter overflow 240, start
ROUNDS, TURNS = 15, 1000


class Alone:
    """canopen's slave, called without a bus."""

    def __init__(self):
        self.sent = sent = []

        class Network(canopen.Network):
            def send_message(self, can_id, data, remote=False):
                sent.append((can_id, bytes(data)))

        self._network = Network()
        self._add(self._network)

    def _add(self, network):
        node = canopen.LocalNode(1, str(eds_path("puma260_joint")))
        network.add_node(node)
        node.tpdo.read(from_od=True)
        node.rpdo.read(from_od=True)
        self._tpdo, self._position = node.tpdo[1], node.tpdo[1]["Position actual value"]

    def __call__(self, frame):
        self._network.notify(frame[0], bytearray(frame[1]), 0.0)
        return self.taken()

    def transmit(self):
        """What its user does at a SYNC."""
        self._position.raw = 1234
        self._tpdo.transmit()
        return self.taken()

    def taken(self):
        sent = self.sent.copy()
        self.sent.clear()
        return sent


class OnVirtualBus(Alone):
    """The same on python-can's virtual bus, with a master at its other end."""

    def __init__(self):
        self._network = canopen.Network()
        self._network.bus = can.Bus(interface="virtual", channel="bench")
        self._master = can.Bus(interface="virtual", channel="bench")
        self._add(self._network)

    def __call__(self, frame):
        self._master.send(can.Message(arbitration_id=frame[0], data=frame[1], is_extended_id=False))
        for listener in self._network.listeners:
            listener.on_message_received(self._network.bus.recv(0))
        return self.taken()

    def taken(self):
        found = []
        while (message := self._master.recv(0)) is not None:
            found.append((message.arbitration_id, bytes(message.data)))
        return found

    def close(self):
        self._network.bus.shutdown()
        self._master.shutdown()


def alone():
    """Our slave in operational; the drive's application is left out, as `LocalNode` has none."""
    node = SlaveNode(load_eds("puma260_joint", 1), 1)
    node.start(0)
    for frame in BOOT:
        node.receive(*frame, 0)
    return lambda frame: node.receive(*frame, 0)


def on_lockstep_bus():
    """The same on the lockstep bus."""
    bus = LockstepBus(VirtualClock(), "bench")
    bus.attach(SlaveNode(load_eds("puma260_joint", 1), 1))
    port = bus.port()

    def exchange(frame):
        port.send_batch((frame,))
        return [(can_id, data) for can_id, data, _ in port.drain()]

    for frame in BOOT:
        exchange(frame)
    return exchange


CASES = ("SDO upload", "SDO download", "RPDO in", "SYNC in, TPDO out", "RPDO and SYNC in, TPDO out", "foreign")


def measure(ours, theirs):
    """Median µs of CPU time a call of each, taken in turn so that the machine's moods hit both."""
    times = {ours: [], theirs: []}
    gc.disable()
    try:
        for _ in range(ROUNDS):
            for call in (ours, theirs):
                start = process_time()
                for _ in range(TURNS):
                    call()
                times[call].append((process_time() - start) / TURNS * 1e6)
    finally:
        gc.enable()
    return median(times[ours]), median(times[theirs])


@pytest.mark.parametrize("what", CASES)
@pytest.mark.parametrize("where", ["alone", "on its bus"])
def test_bench_against_local_node(benchmark, what, where):
    ours, theirs = (alone(), Alone()) if where == "alone" else (on_lockstep_bus(), OnVirtualBus())

    def both_ours():
        ours(RPDO)
        return ours(SYNC)

    def sync_theirs():
        theirs(SYNC)  # comes in all the same
        return theirs.transmit()

    def both_theirs():
        theirs(RPDO)
        return sync_theirs()

    def same(frame):
        return lambda: ours(frame), lambda: theirs(frame)

    mine, its = {
        "SDO upload": same(UPLOAD),
        "SDO download": same(DOWNLOAD),
        "RPDO in": same(RPDO),
        "SYNC in, TPDO out": (lambda: ours(SYNC), sync_theirs),
        "RPDO and SYNC in, TPDO out": (both_ours, both_theirs),
        "foreign": same(FOREIGN),
    }[what]
    answers = mine(), its()
    assert answers[0] == answers[1] or ("TPDO" in what and [len(found) for found in answers] == [1, 1])
    mine_us, its_us = benchmark.pedantic(measure, (mine, its), rounds=1)
    benchmark.extra_info |= {"ours_us": mine_us, "local_node_us": its_us, "share": mine_us / its_us}
    print(f"\n{where}, {what}: {mine_us:.2f} µs, LocalNode {its_us:.2f} µs: {mine_us / its_us:.2f}")
    if where != "alone":
        theirs.close()


class Still:
    """A plant without physics."""

    def advance(self, t_ns):
        pass

    def motor_counts(self, axis):
        return 0.0

    def torque_permille(self, axis):
        return 0

    def set_ramp(self, axis, start_counts, end_counts, t0_ns, t1_ns):
        pass

    def sample_image(self, t_ns):
        return self.image


def test_bench_seven_nodes_at_400_hz_in_lockstep(benchmark):
    """Six drives and the tactile window on a lockstep bus, SYNC and six RPDOs a cycle, as a share of one core."""
    import numpy as np

    plant = Still()
    plant.image = np.full((16, 16), 7, np.uint8)
    bus = LockstepBus(VirtualClock(), "bench")
    nodes = [make_drive_node(load_eds("puma260_joint", i), i, i - 1, plant) for i in range(1, 7)]
    for node in (*nodes, make_tactile_node(load_eds("tactile_array", 16), 16, plant)):
        bus.attach(node)
    port = bus.port()
    for node_id in (1, 2, 3, 4, 5, 6, 16):
        texts = ("2f191000f0000000", "23061000c4090000", "2f60600008000000")
        port.send_batch([(0x600 + node_id, bytes.fromhex(text)) for text in texts])
    port.send_batch([(0, b"\x01\x00")])
    count = 0

    def cycle(word=0x0F):
        nonlocal count
        count += 1
        port.send_batch([(0x80, bytes(((count - 1) % 240 + 1,)))])
        got = len(port.drain())
        port.wait(count * CYCLE_NS - CYCLE_NS // 2)
        data = word.to_bytes(2, "little") + b"\0\0\0\0"
        port.send_batch([(0x200 + i, data) for i in range(1, 7)])
        bus.clock.sleep_until_ns(count * CYCLE_NS)
        return got

    for word in (6, 7, 15, 15):
        cycle(word)
    assert [cycle() for _ in range(4)] in ([6, 15, 6, 15], [15, 6, 15, 6])
    start = process_time()
    benchmark.pedantic(cycle, rounds=2000, iterations=1)
    share = (process_time() - start) / 2000 / (CYCLE_NS * 1e-9)
    benchmark.extra_info["share_of_a_core"] = share
    print(
        f"\nseven nodes at 400 Hz: {share:.1%} of one core, median {benchmark.stats.stats.median * 1e6:.0f} µs a cycle"
    )
