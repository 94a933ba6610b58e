"""A cell in lockstep that loses something in a run and comes back, and what its drives did meanwhile."""

from __future__ import annotations

import canprobe
from canprobe.cell.master.controller import Command, Controller
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.cia402 import DriveState, known_state
from canprobe.fieldbus.protocol.frames import SYNC_ID

LOSS_CYCLE = 120
"""Cycle of the loss: the arm moves."""
HELD_CYCLES = 40
"""Cycles of the hold before motion is asked for."""


class Way(Controller):
    """Moves every joint on at a constant rate, from where it is; it can go on after a loss."""

    resumable = True

    def __init__(self, cycles=120):
        self.left, self.q, self.went_on = cycles, None, []

    def step(self, measurement):
        if measurement.q is not None:
            self.q = measurement.q if self.q is None else self.q + 2e-5
        self.left -= measurement.cycle >= LOSS_CYCLE
        return Command(q_target=self.q, done=self.left <= 0)

    def go_on(self, measurement):
        self.q = None
        self.went_on.append(measurement.cycle)


class Enabled(Participant):
    """Looks at the drives after each SYNC: distance of target and position in the first SYNCs after they were enabled.

    Attributes:
        distances: the largest distance, counts, of each time that a drive was enabled, by (node id, number).
    """

    name = "watcher"
    hears_every_sync = True
    listens = frozenset((SYNC_ID,))

    def __init__(self, nodes):
        self._drives = [node for node in nodes if node.node_id < 10]
        self._age = dict.fromkeys((node.node_id for node in self._drives), -1)
        self.times = dict.fromkeys(self._age, 0)
        self.distances = {}

    def receive(self, can_id, data, t_ns):
        for node in self._drives:
            number, i = node.dictionary.number, node.node_id
            if known_state(number(0x6041)) is not DriveState.OPERATION_ENABLED:
                self._age[i] = -1
                continue
            self._age[i] += 1
            self.times[i] += self._age[i] == 0
            if self._age[i] < 8:
                distance = abs(number(0x607A) - number(0x6064))
                key = i, self.times[i]
                self.distances[key] = max(distance, self.distances.get(key, 0))
        return []


class Returning:
    """A run with `open_cell(…, recover=True)` in which something happens at `LOSS_CYCLE`.

    Args:
        action: function of this object that makes it happen; or faults as text, by ``;``.
        scene: scene.
        controller: controller; `Way` by default.
        again: whether a second controller of the same kind runs after the first.
    """

    def __init__(self, action, scene="free", *, controller=Way, again=False, **options):
        self.said, self.errors, self.controllers = [], [], []
        scene = canprobe.load_scene(scene, {"bus.timed": False, "outputs.figures": False})
        self.opened = canprobe.open_cell(scene, say=self.say, recover=True, **options)
        self.session = self.opened.session
        self.faulty = self.session.buses.world.make_faulty()
        self.nodes = {node.node_id: node.node for node in self.faulty.nodes}
        self.enabled = Enabled(self.session.buses.world.nodes)
        self.session.buses.world.participants.append(self.enabled)
        self._action, self._first, self._held = action, None, 0
        self.held_targets = []
        with self.opened:
            self._first = self.session.cell
            for _ in range(1 + again):
                self.controllers.append(controller())
                try:
                    self.opened.run(self.controllers[-1], self._progress)
                except CanprobeError as error:
                    self.errors.append(error)
        self.summary = self.opened._result.summary

    def say(self, text):
        self.said.append(text)

    def now(self):
        return self.session.buses.lockstep.clock.now_ns()

    def inject(self, text):
        for one in text.split(";"):
            self.faulty.inject(one, self.now())

    def _progress(self, measurement):
        if measurement.cycle == LOSS_CYCLE:
            self.inject(self._action) if isinstance(self._action, str) else self._action(self)
        if self.session.cell is not self._first and not self.controllers[-1].went_on:
            self._held += 1
            self.held_targets.append([n.dictionary.number(0x607A) for i, n in self.nodes.items() if i < 10])
            if self._held == HELD_CYCLES:
                self.opened.resume()

    def steps(self, word):
        """The steps that begin with a word."""
        return [line for line in self.said if line.startswith(word)]

    def assert_came_back(self):
        """It came back once, held without a jump until motion was asked for, and ran to its end."""
        assert not self.errors, self.errors
        assert len(self.steps("the cell is back")) == len(self.steps("lost: ")) == 1, self.said
        assert len(self.held_targets) == HELD_CYCLES
        assert all(row == self.held_targets[0] for row in self.held_targets)
        assert len(self.controllers[-1].went_on) == 1
        after = {key: distance for key, distance in self.enabled.distances.items() if key[1] > 1}
        assert {i for i, _ in after} == {i for i in self.nodes if i < 10}
        assert max(after.values()) <= 1
        return self
