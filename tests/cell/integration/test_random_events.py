"""A cell in lockstep under random orders of motion and faults; its log is judged by tables from CiA 301 and 402.

The tables here are the test's own: they share no code with the drives nor with their master.
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

NODES = range(1, 7)
KINDS = (
    "reboot", "mute", "deaf", "freeze", "bus-off", "heartbeat-off", "nmt", "drive-fault", "sto", "emcy", "sync-lost",
    "encoder-frozen", "drop", "delay",
)  # fmt: skip
OFF, READY, ON, ENABLED, STOPPING, REACTING, FAULT = 0x40, 0x21, 0x23, 0x27, 0x07, 0x0F, 0x08
POWERED = {ENABLED, STOPPING, REACTING}
SHUTDOWN, SWITCH_ON, ENABLE, DISABLE, QUICK_STOP, RESET = range(6)
COMMANDS = {
    (OFF, SHUTDOWN): {READY},
    (READY, SWITCH_ON): {ON},
    (READY, ENABLE): {ON, ENABLED},
    (READY, DISABLE): {OFF},
    (READY, QUICK_STOP): {OFF},
    (ON, ENABLE): {ENABLED},
    (ON, SHUTDOWN): {READY},
    (ON, DISABLE): {OFF},
    (ON, QUICK_STOP): {OFF},
    (ENABLED, SWITCH_ON): {ON},
    (ENABLED, SHUTDOWN): {READY},
    (ENABLED, DISABLE): {OFF},
    (ENABLED, QUICK_STOP): {STOPPING},
    (STOPPING, DISABLE): {OFF},
    (FAULT, RESET): {OFF},
}
BY_ITSELF = {ENABLED: {STOPPING}, STOPPING: {OFF}, REACTING: {FAULT}}
LARGEST_STEP = 0.02
"""Most of a way that a target goes in one cycle here, rad: far above the swing's, far below a jump."""


def state_of(word):
    """The state of a statusword: bit 5 is free where power is off or a fault reacts."""
    return word & 0x6F if word & 0x6F in (READY, ON, ENABLED, STOPPING) else word & 0x4F


def command_of(word):
    if word & 0x80:
        return RESET
    if not word & 0x02:
        return DISABLE
    if not word & 0x04:
        return QUICK_STOP
    return {0x06: SHUTDOWN, 0x07: SWITCH_ON}.get(word & 0x0F, SHUTDOWN if word & 0x01 == 0 else ENABLE)


class Drive:
    """What the frames of the bus say of one drive."""

    def __init__(self):
        self.possible, self.reported, self.position, self.target, self.started = None, None, None, None, False

    def closed(self, states):
        found = set(states)
        while more := {new for state in found for new in BY_ITSELF.get(state, ())} - found:
            found |= more
        return found | {REACTING, FAULT}

    def boot(self):
        self.__init__()
        self.possible = {OFF, FAULT}

    def command(self, data):
        word, target = struct.unpack("<Hi", data)
        command = command_of(word)
        if self.possible is not None:
            self.possible |= {new for state in self.possible for new in COMMANDS.get((state, command), ())}
        if command == ENABLE:
            assert self.position is not None, "enabled before a position of this boot was reported"
            if self.reported not in POWERED and self.target is None:
                assert abs(target - self.position) <= 1, "the first target is not the reported position"
                self.target = target
            elif self.target is not None:
                assert abs(target - self.target) <= self.largest, "a target jumps"
                self.target = target
        else:
            self.target = None

    def report(self, data):
        word, self.position = struct.unpack_from("<Hi", data)
        self.reported = state_of(word)
        if self.possible is not None:
            allowed = self.closed(self.possible)
            assert self.reported in allowed, f"{self.reported:02X} is not in {sorted(allowed)}"
        self.possible = {self.reported}


def examine(frames, units_per_rad):
    """Judge every frame of a log: (identifier, data)."""
    drives = {node: Drive() for node in NODES}
    for node, drive in drives.items():
        drive.largest = math.ceil(LARGEST_STEP * units_per_rad[node - 1])
    for can_id, data in frames:
        node, service = can_id & 0x7F, can_id & 0x780
        if node not in drives:
            continue
        if service == 0x700 and data == b"\0":
            drives[node].boot()
        elif service == 0x200:
            drives[node].command(data)
        elif service == 0x180:
            drives[node].report(data)


def read_frames(path):
    for line in path.read_text().splitlines():
        can_id, data = line.split()[2].split("#")
        if not data.startswith("R") and len(can_id) == 3:
            yield int(can_id, 16), bytes.fromhex(data)


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
                state = state_of(node.dictionary.number(0x6041))
                assert state not in POWERED, f"node {node_id} is left with power on: {state:02X}"
            examine(
                read_frames(self.folder / "bus.log"), np.abs(self.session.plan.setup.arm.model.units_per_q).sum(axis=1)
            )
        finally:
            shutil.rmtree(self.folder)


TestCellUnderFaults = CellUnderFaults.TestCase
TestCellUnderFaults.settings = hypothesis.settings(max_examples=6, stateful_step_count=15)
