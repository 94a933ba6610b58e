"""One measurement of test_bench_growth.py, in a process: `python growth_child.py AXIS SIZE`, prints a line of JSON."""

from __future__ import annotations

import json
import resource
import sys
import tempfile
from pathlib import Path
from time import process_time

import numpy as np

import canprobe
from canprobe.cell.tasks.shape import MAPPED_AT_ONCE
from canprobe.fieldbus import LockstepBus, PortNetwork, VirtualClock, load_eds, make_eds_node
from canprobe.mechanics.touch.map.local_fits import PadLayer
from canprobe.mechanics.touch.map.noise import PAD_NOISE
from canprobe.mechanics.touch.map.surface_map import SurfaceMap
from canprobe.mechanics.touch.surface import SurfaceMatrix

JOINT = """
[joints.joint_{i}]
a_mm = 50
alpha_deg = {alpha}
d_mm = 0
min_deg = -170
max_deg = 170
speed_deg_s = 100
swing_deg = 5
node_id = {i}
counts_per_turn = 10000
gear = 100
"""
CHAIN = """
[scene]
name = "chain"
[cycle]
rate_hz = 200
[task]
kind = "free"
duration_s = 8
[arm]
convention = "standard"
eds = "puma260_joint.eds"
"""
SKIN = """
[scene]
name = "skin"
[cycle]
rate_hz = 50
[sensor]
rows = {n}
columns = {n}
pitch_mm = {pitch}
mount = "flat"
mode = "image"
full_scale_kpa = 100
rate_hz = 10
[wire]
kind = "frames"
ids = ["480h"]
frames = {frames}
unloaded_counts = 10
full_scale_counts = 240
sampling = "free"
[object]
kind = "sphere"
radius_mm = 50
[task]
kind = "listen"
duration_s = 10
"""


def of_cycles(scene: Path, bus: str) -> float:
    """Processor time of a cycle of a run, s."""
    marks: list[float] = []
    canprobe.run(scene, bus=bus, files=False, progress=lambda *_: marks.append(process_time()))
    return (marks[-1] - marks[10]) / (len(marks) - 11)


def joints(n: int, folder: Path) -> float:
    """A cycle of an arm of n joints."""
    file = folder / "chain.toml"
    file.write_text(CHAIN + "".join(JOINT.format(i=i, alpha=90 if i % 2 else -90) for i in range(1, n + 1)))
    return of_cycles(file, "direct")


def taxels(count: int, folder: Path) -> float:
    """An image of an array, with the cycles until the next."""
    n = round(count**0.5)
    frames = [f"{k:02X} aa bb cc dd ee ff gg" for k in range(count // 7)]
    if rest := count % 7:
        frames.append(f"{len(frames):02X} " + " ".join([2 * c for c in "abcdefg"[:rest]] + [".."] * (7 - rest)))
    file = folder / "skin.toml"
    file.write_text(SKIN.format(n=n, pitch=25.4 / n, frames=json.dumps(frames)))
    return 5 * of_cycles(file, "lockstep")


def nodes(n: int, folder: Path) -> float:
    """A SYNC on the lockstep bus, with the answers of n drives."""
    bus = LockstepBus(VirtualClock())
    for node_id in range(1, n + 1):
        bus.attach(make_eds_node(load_eds("puma260_joint", node_id), node_id))
    port = bus.port()
    network = PortNetwork(port)
    for node_id in range(1, n + 1):
        node = network.add_node(node_id, load_eds("puma260_joint", node_id))
        node.tpdo.read()
        node.tpdo[1].trans_type, node.tpdo[1].enabled = 1, True
        node.tpdo.save()
    network.nmt.send_command(1)
    network.pass_time(0.1)
    port.drain()
    heard, cycles, began = 0, 2000, process_time()
    for _ in range(cycles):
        port.send_batch([(0x80, b"")])
        port.clock.sleep_until_ns(port.clock.now_ns() + 20_000_000)
        heard += sum(0x180 < can_id < 0x200 for can_id, _, _ in port.drain())
    assert heard == n * cycles, (heard, n * cycles)
    return (process_time() - began) / cycles


def seconds(duration: int, folder: Path) -> tuple[float, float]:
    """A scan of some seconds, from its first cycle to its last file, and the share of that behind its last cycle."""
    times: list[float] = []
    canprobe.run(
        "cylinder", bus="direct", duration_s=float(duration), out=folder / "run",
        progress=lambda *_: times.append(process_time()) if len(times) < 2 else times.__setitem__(1, process_time()),
    )  # fmt: skip
    ended = process_time()
    return ended - times[0], (ended - times[1]) / (times[1] - times[0])


def contacts(n: int, folder: Path) -> float:
    """The map of n contacts over new ground, solved."""
    rng, surface = np.random.default_rng(0), SurfaceMatrix.from_curvature([[2.0, 0.0], [0.0, -1.5]])
    line, x = np.divmod(np.arange(n) * 0.125e-3, 0.1)
    x, y = np.where(line % 2 == 0.0, x, 0.1 - x) - 0.05, 3e-3 * (line - 0.5 * line[-1])
    points = np.stack([x, y, surface.height(x, y)], axis=1)
    normals = surface.normal(points) + 1e-3 * rng.normal(size=points.shape)
    points = points + 2e-5 * rng.normal(size=points.shape)
    found = SurfaceMap(PadLayer(0.04, 1.2e8), PAD_NOISE)
    began = process_time()
    for k in range(0, n, MAPPED_AT_ONCE):
        part = slice(k, min(k + MAPPED_AT_ONCE, n))
        found.add(points[part], normals[part], np.full(len(points[part]), 2.0))
    found.solved()
    return process_time() - began


def runs(n: int, folder: Path) -> float:
    """Runs of one scene in one worker, with its start."""
    began = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    scene = canprobe.load_scene("listen", {"task.duration_s": 0.1})
    assert len(canprobe.run_many(scene, seeds=n, bus="direct", workers=1, out=folder / "many", progress=False)) == n
    ended = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(b.ru_utime + b.ru_stime - a.ru_utime - a.ru_stime for a, b in zip(began, ended, strict=True))


if __name__ == "__main__":
    axis, size = sys.argv[1], int(sys.argv[2])
    with tempfile.TemporaryDirectory() as where:
        cost, *behind = np.atleast_1d(globals()[axis](size, Path(where))).tolist()
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(json.dumps({"s": cost, "behind": behind, "mib": peak / 1024}))
