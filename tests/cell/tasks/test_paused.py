"""A task in a cell that has come back: it is held until motion is asked for, by a call, a bridge, or a key."""

from __future__ import annotations

import os
from collections import deque

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.tasks.paused import LastPlace, PausedController
from canprobe.cell.tasks.requested import Request, RequestedTask
from canprobe.cli.operator import LetterKey


class Mine(Controller):
    def __init__(self):
        self.steps, self.went_on = 0, 0

    def step(self, measurement):
        self.steps += 1
        return Command(q_target=np.zeros(6))

    def go_on(self, measurement):
        assert not self.steps, "it prepares before its next step"
        self.went_on += 1


def test_a_hold_lasts_until_motion_is_asked_for():
    """The first cycle of a hold takes no word for motion; none of those after it begins motion without one."""
    asked, mine, resumed = [True], Mine(), []
    held = PausedController(mine, None, lambda: bool(asked), lambda: resumed.append(1))
    for cycle in range(50):
        assert held.step(Measurement(cycle, cycle * 2_500_000)) == Command() and held.held
        assert not held.retreats_itself
        asked.clear()
    assert (mine.went_on, mine.steps) == (0, 0)
    asked.append(True)
    assert held.step(Measurement(50, 50 * 2_500_000)).q_target is not None and not held.held
    assert (mine.went_on, mine.steps, resumed) == (1, 1, [1])
    held.step(Measurement(51, 51 * 2_500_000))
    assert mine.went_on == 1
    assert not held.retreats_itself, "a controller that does not let go leaves that to the cell after the hold, too"


def test_a_held_task_does_no_work_between_cycles_and_is_let_go_by_the_cell():
    asked, done = [], []

    class Working(Mine):
        retreats_itself, restarts, trail = True, 3, "the way that it came"

        def update(self):
            done.append("update")

        def retreat(self, reason):
            done.append(reason)

    held = PausedController(Working(), None, lambda: bool(asked))
    held.update()
    assert done == [] and not held.retreats_itself and held.restarts == 3
    assert held.trail is None, "the way that the arm came before it was lost is no way back"
    held.step(Measurement(0, 0))
    asked.append(True)
    held.step(Measurement(1, 0))
    held.update()
    held.retreat("the force")
    assert done == ["update", "the force"] and held.retreats_itself and held.trail == Working.trail
    assert PausedController(Working(), None, None).retreats_itself, "a controller that is new begins at once"


def test_a_bridge_asks_for_motion_and_what_came_before_is_dropped():
    queue, made = deque(), []
    task = RequestedTask(None, lambda: made.append(Mine()) or made[-1], [queue], 0.0025)
    held = PausedController(task, None, lambda: False)
    queue += [Request("resume"), Request("start")]
    held.step(Measurement(0, 0))
    assert held.held, "what was asked for while the cell was lost does not count"
    queue.append(Request("resume"))
    held.step(Measurement(1, 2_500_000))
    assert not held.held and not made, "the start that came in the hold is dropped"
    queue.append(Request("start"))
    held.step(Measurement(2, 5_000_000))
    assert len(made) == 1 and made[0].steps == 1


def test_a_key_is_a_line_of_its_letter(monkeypatch):
    reader, writer = os.pipe()

    class Terminal:
        @staticmethod
        def isatty():
            return True

        @staticmethod
        def fileno():
            return reader

    monkeypatch.setattr("sys.stdin", Terminal())
    key = LetterKey("r")
    found = []
    for typed in (b"", b"x\n", b"R\n"):
        os.write(writer, typed)
        found.append(any([key.pressed() for _ in range(25)]))
    os.close(writer)
    found.append(any([key.pressed() for _ in range(45)]))
    os.close(reader)
    assert found == [False, False, True, False]


@pytest.mark.parametrize(("stands_deg", "elsewhere"), [(65.0, False), (66.0, False), (66.1, True), (-65.0, True)])
def test_an_arm_is_compared_with_where_it_stood_and_not_with_its_zero(stands_deg, elsewhere):
    """As far as the tolerance goes, and no further; the mirrored posture is elsewhere."""
    joints = canprobe.plan("free").setup.arm.model.joints
    place = LastPlace(joints, np.radians([90.0, 65.0, 15.0, 0.0, 100.0, 0.0]), np.full(6, np.radians(1.0) + 1e-12))
    held = PausedController(Mine(), place, lambda: False)
    found = held.inspect(np.radians([90.0, stands_deg, 15.0, 0.0, 100.0, 0.0]))
    if elsewhere:
        assert found.startswith(f"joint 2 reports {stands_deg:.2f} deg, and reported 65.00 deg before the loss")
    else:
        assert found is None
