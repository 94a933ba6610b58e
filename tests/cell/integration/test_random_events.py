"""A cell in lockstep under random orders of motion and faults; its log is judged by what a drive may be told.

The judge here is the test's own: it shares no code with the drives nor with their master.
"""

import math
import shutil
import struct
from pathlib import Path
from tempfile import mkdtemp

import hypothesis
import hypothesis.strategies as st
import numpy as np
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.master.options import RunOptions
from canprobe.cell.session.session import Session
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump

NODES = range(1, 7)
KINDS = (
    "reboot", "mute", "deaf", "freeze", "bus-off", "heartbeat-off", "nmt", "drive-fault", "sto", "emcy", "sync-lost",
    "encoder-frozen", "drop", "delay",
)  # fmt: skip
ENABLED, STOPPING, REACTING = 0x27, 0x07, 0x0F
"""States by their statuswords, in which power is on."""
LARGEST_STEP = 0.02
"""Most of a way that a target goes in one cycle here, rad: far above the swing's, far below a jump."""


def powered(word):
    return word & 0x6F in (ENABLED, STOPPING) or word & 0x4F == REACTING


class Drive:
    """What the frames of the bus say of one drive."""

    def __init__(self, largest):
        self.largest, self.reported, self.position, self.target = largest, None, None, None

    def command(self, data):
        word, target = struct.unpack("<Hi", data)
        if word & 0x8F != 0x0F:  # anything but enable operation
            self.target = None
            return
        assert self.position is not None, "enabled before a position of this boot was reported"
        if self.target is not None:
            assert abs(target - self.target) <= self.largest, "a target jumps"
            self.target = target
        elif not powered(self.reported):
            assert abs(target - self.position) <= 1, "the first target is not the reported position"
            self.target = target

    def report(self, data):
        self.reported, self.position = struct.unpack_from("<Hi", data)


def examine(path, units_per_rad):
    """Judge every frame of a log."""
    largest = [math.ceil(LARGEST_STEP * units) for units in units_per_rad]
    drives = {node: Drive(largest[node - 1]) for node in NODES}
    for _, _, can_id, data in read_candump(path):
        node, service = can_id & 0x7F, can_id & 0x780
        if can_id > 0x7FF or node not in drives:
            continue
        if service == 0x700 and data == b"\0":
            drives[node] = Drive(largest[node - 1])
        elif service == 0x200:
            drives[node].command(data)
        elif service == 0x180:
            drives[node].report(data)


class CellUnderFaults(RuleBasedStateMachine):
    """A free arm: it swings, holds, is struck by faults, runs on, and ends."""

    folder = session = None

    @initialize(seed=st.integers(0, 3))
    def bring_up(self, seed):
        self.folder, self.swing, self.ended, self.start, self.angle = Path(mkdtemp()), 0.0, False, None, 0.0
        scene = canprobe.load_scene("free", {"scene.seed": seed, "outputs.figures": False})
        self.session = Session(scene, RunOptions(out=self.folder))
        self.faulty = self.session.buses.world.make_faulty()
        self.nodes = {node.node_id: node.node for node in self.faulty.nodes}
        self.session.__enter__()
        self.attempt(lambda: self.session.cell.start(self.step))

    def step(self, measurement):
        if self.start is None:
            self.start, self.begin = np.array(measurement.q), measurement.cycle
        phase = 2 * math.pi * (measurement.cycle - self.begin) / 400
        self.angle += 0.01 * (self.swing * math.sin(phase) - self.angle)
        return Command(q_target=self.start + np.array([0, 0, 0, 0, self.angle, self.angle]))

    def attempt(self, action):
        """Do it, unless the cell has ended: an error ends it."""
        if self.ended:
            return
        try:
            action()
        except CanprobeError:
            self.ended = True

    @rule(cycles=st.integers(1, 60))
    def go_on(self, cycles):
        self.attempt(lambda: self.session.cell.advance(cycles))

    @rule(swing=st.floats(0, 0.1))
    def change_motion(self, swing):
        self.swing = swing

    @rule(kind=st.sampled_from(KINDS), node=st.sampled_from(NODES), ms=st.sampled_from((2, 5, 20, 100, 400)))
    def strike(self, kind, node, ms):
        self.faulty.inject(f"node {node}: {kind} seed=1 for {ms} ms", self.session.buses.lockstep.clock.now_ns())

    def teardown(self):
        if self.session is None:
            return
        try:
            self.faulty.clear()
            self.session.__exit__(None, None, None)
            for node_id, node in self.nodes.items():
                assert not powered(node.dictionary.number(0x6041)), f"node {node_id} is left with power on"
            examine(self.folder / "bus.log", np.abs(self.session.plan.setup.arm.model.units_per_q).sum(axis=1))
        finally:
            shutil.rmtree(self.folder)


TestCellUnderFaults = CellUnderFaults.TestCase
TestCellUnderFaults.settings = hypothesis.settings(max_examples=6, stateful_step_count=15)
