"""A scan that loses its contact stops along the path, looks for the object, and goes on without overshoot."""

from dataclasses import replace

import numpy as np
import pytest
from wrapped import Wrapped

import canprobe
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.lab.studies.witnessed_run import Witness

TARGET = 2.0
AT_CYCLE = 500
MOVING_CYCLES = 60
"""Time in which the object moves: 0.15 s. One that is gone at once looks as a blind array does."""


class Disturbed(Wrapped):
    """A scan over the cylinder; from one cycle on the object moves down."""

    def __init__(self, move_mm):
        keys = {"task.duration_s": 2.0, "task.clearance_mm": 0.3, "bus.timed": False, "shape.also": []}
        self.session = Session(canprobe.load_scene("cylinder", keys))
        super().__init__(make_task(self.session.plan))
        self.move_mm = move_mm
        self.witness = Witness(self.session.buses.world.plant, 1_250_000)
        self.positions = []
        self.session.buses.world.participants.insert(0, self.witness)

    def step(self, measurement):
        gone = (measurement.cycle - AT_CYCLE) / MOVING_CYCLES
        if 0.0 <= gone <= 1.0:
            given = self.session.scene.object
            there = tuple(np.add(given.position_mm, np.multiply(gone, self.move_mm)))
            self.session.buses.world.plant.place(true_object(replace(given, position_mm=there)))
        command = self.task.step(measurement)
        self.positions.append((int(self.task.phase), *self.task._motion.pose.centre))
        return command

    def run(self):
        with self.session:
            self.session.run(self)
        times, forces = (np.array(column) for column in zip(*self.witness.rows, strict=True))
        return times * 1e-9, forces


def test_an_object_that_gives_way_is_found_again_without_overshoot():
    run = Disturbed((0.0, 0.0, -1.8))
    times, forces = run.run()
    (loss,) = run.task.losses
    lost_at = times[0] + AT_CYCLE * 2.5e-3
    gap = times[(forces == 0) & (times > lost_at) & (times < lost_at + 0.9)]
    assert loss.searched == pytest.approx(1.2e-3, abs=0.6e-3), "the rest it has followed"
    assert 0.2 < loss.regained_s < 0.9
    assert gap.size > 0, "contact was truly lost"
    after = forces[times > lost_at]
    assert after.max() < 1.5 * TARGET
    phases = np.array([row[0] for row in run.positions])
    assert (np.diff(phases[phases >= Phase.SCAN]) != 0).sum() >= 3, "scan, regain, scan, retreat"
    resumed = np.flatnonzero(phases == Phase.SCAN)[-1]
    assert resumed > AT_CYCLE + 200
    path = np.array([row[1:] for row in run.positions])
    searching = (phases == Phase.REGAIN) & (np.arange(len(phases)) < loss.cycle + loss.regained_s / 2.5e-3)
    sideways = path[searching][:, :2] - path[loss.cycle, :2]
    assert np.linalg.norm(sideways, axis=1).max() < 1.2e-3, "no further along the path"
