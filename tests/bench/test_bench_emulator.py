"""What a node costs per frame, against canopen-python's `LocalNode` in the same run. Run with --benchmark-only.

Both nodes are made from `puma260_joint.eds` and called in process, without a bus between: frames in by `receive` or
`notify`, frames out into a list. Goal: at most a fifth of `LocalNode`, and seven nodes at 400 Hz under 15 % of a core.

`LocalNode` neither applies RPDOs to its dictionary nor answers a SYNC; its TPDO is packed and sent by hand, as its users
have to. So the two do the same work on SDO only; on PDOs ours does more.
"""

from __future__ import annotations

import gc
from statistics import median
from time import process_time

import canopen
import pytest

from canprobe.bus.clock import VirtualClock
from canprobe.bus.lockstep import LockstepBus
from canprobe.eds import eds_path, load_eds
from canprobe.emulator.drive import make_drive_node
from canprobe.emulator.node import SlaveNode
from canprobe.emulator.tactile import make_tactile_node

CYCLE_NS = 2_500_000
UPLOAD = bytes.fromhex("4000100000000000")
DOWNLOAD = bytes.fromhex("2b17100000000000")  # 1017h = 0
SYNC, RPDO = b"\x01", bytes.fromhex("0f0010270000")
ROUNDS, TURNS = 15, 400


class LocalNode:
    """canopen's slave; what it sends is kept."""

    def __init__(self):
        self.sent = sent = []

        class Network(canopen.Network):
            def send_message(self, can_id, data, remote=False):
                sent.append((can_id, bytes(data)))

        self.network = Network()
        self.node = canopen.LocalNode(1, str(eds_path("puma260_joint")))
        self.network.add_node(self.node)
        self.node.tpdo.read(from_od=True)
        self.node.rpdo.read(from_od=True)
        self.position = self.node.tpdo[1]["Position actual value"]

    def receive(self, can_id, data):
        self.network.notify(can_id, bytearray(data), 0.0)

    def send_tpdo(self):
        self.position.raw = 1234
        self.node.tpdo[1].transmit()


class Ours:
    """Our slave in operational; the drive's application is left out, as `LocalNode` has none."""

    def __init__(self):
        self.node = SlaveNode(load_eds("puma260_joint", 1), 1)
        self.node.start(0)
        self.receive(0x601, bytes.fromhex("2f191000f0000000"))
        self.receive(0, b"\x01\x01")

    def receive(self, can_id, data):
        return self.node.receive(can_id, data, 0)


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


CASES = ["SDO upload", "SDO download", "RPDO and SYNC against RPDO and TPDO", "RPDO received", "TPDO sent", "foreign frame"]


@pytest.mark.parametrize("what", CASES)
def test_bench_against_local_node(benchmark, what):
    ours, theirs = Ours(), LocalNode()

    def rpdo_and_sync():
        ours.receive(0x201, RPDO)
        ours.receive(0x80, SYNC)

    def rpdo_and_tpdo():
        theirs.receive(0x201, RPDO)
        theirs.send_tpdo()
        theirs.sent.clear()

    def both(can_id, data):
        def local():
            theirs.receive(can_id, data)
            theirs.sent.clear()

        return lambda: ours.receive(can_id, data), local

    def sent():
        theirs.send_tpdo()
        theirs.sent.clear()

    pairs = {
        "SDO upload": both(0x601, UPLOAD),
        "SDO download": both(0x601, DOWNLOAD),
        "RPDO and SYNC against RPDO and TPDO": (rpdo_and_sync, rpdo_and_tpdo),
        "RPDO received": both(0x201, RPDO),
        "TPDO sent": (lambda: ours.receive(0x80, SYNC), sent),
        "foreign frame": both(0x305, RPDO),
    }
    mine, its = benchmark.pedantic(measure, pairs[what], rounds=1)
    benchmark.extra_info |= {"ours_us": mine, "local_node_us": its, "share": mine / its}
    print(f"\n{what}: {mine:.2f} µs, LocalNode {its:.2f} µs: {mine / its:.2f}")


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
    print(f"\nseven nodes at 400 Hz: {share:.1%} of one core, median {benchmark.stats.stats.median * 1e6:.0f} µs a cycle")
