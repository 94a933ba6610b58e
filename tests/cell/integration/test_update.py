"""A controller's `update`: called when the commands of its step are out, and guarded as the step is."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from injected import HOLD_CYCLE, Injected
from wrapped import Wrapped

import canprobe
from canprobe.cell.master.controller import Command, Controller, as_controller
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.probing import Phase


class Working(Controller):
    """Holds the joints; notes when it is called, and how many frames had been sent by then."""

    def __init__(self, session):
        self._session, self.calls = session, []

    def _note(self, what):
        cell = self._session.cell
        self.calls.append((what, cell.cycle.number, cell.port.counters.sent))

    def step(self, measurement):
        self._note("step")
        return Command(done=len(self.calls) >= 40)

    def update(self):
        self._note("update")


def test_it_is_called_once_a_step_when_the_rpdos_are_out():
    session = Session(canprobe.load_scene("free"))
    controller = Working(session)
    with session:
        session.run(controller)
    calls = controller.calls
    assert [what for what, _, _ in calls] == ["step", "update"] * (len(calls) // 2)
    for (_, asked, before), (_, worked, after) in zip(calls[::2], calls[1::2], strict=True):
        assert worked == asked
        assert after - before in (6, 7), "six RPDOs, and now and then the master's heartbeat"


def test_what_it_raises_ends_the_run_off_the_object():
    class Failing(Injected):
        def _run(self):
            task, failing = self.task, self

            class Late(Wrapped):
                def step(self, measurement):
                    return failing.step(measurement)

                def update(self):
                    if failing.session.cell.cycle.number == failing.at + 1:
                        raise ZeroDivisionError("in update")

            with self.session, pytest.raises(ZeroDivisionError, match="in update"):
                self.session.run(Late(task), progress=self._progress)

    run = Failing("press", HOLD_CYCLE, lambda _: None)
    run.assert_drives_off()
    assert run.session.buses.truth["force_n"][run.at] == pytest.approx(2.0, abs=0.2)
    assert run.session.buses.truth["force_n"][-1] == 0.0
    np.testing.assert_allclose(np.diff(run.session.cell.log.arrays()["t_s"]), 5e-3, rtol=1e-6)


def test_a_scan_carries_its_learning_one_step_a_cycle_and_none_where_an_image_is_read():
    """The steps: updates of the filter and its answers, pieces of the map, images for the check of the calibration.

    Stopped in mid-scan, the task has in its record every answer that was due.
    """
    overrides = {"bus.interface": "direct", "task.duration_s": 1.0, "task.clearance_mm": 0.5}
    session = Session(canprobe.load_scene("cylinder", overrides))
    task, steps, images = make_task(session.plan), Counter(), set()
    motion, surface_map, check = task.shape._estimator._motion, task.shape._map, task.learned.check
    for owner, name in ((motion, "_step"), (motion, "estimate"), (surface_map, "add_samples"), (check, "work")):
        call = getattr(owner, name)

        def noted(*args, call=call, name=name):
            found = call(*args)
            if name != "work" or found:
                steps[session.cell.cycle.number] += 1
            return found

        setattr(owner, name, noted)

    def step(measurement):
        if measurement.tactile is not None:
            images.add(measurement.cycle)
        if task.phase is Phase.SCAN and len(task.shape.samples) == 153:  # an answer is due at 152
            return Command(done=True)
        return task.step(measurement)

    with session:
        controller = as_controller(step)
        controller.update = task.update
        session.run(controller)
    assert max(steps.values()) == 1 and len(steps) > 60
    assert images.isdisjoint(steps)
    due = [sample.t_s for sample in list(task.shape.samples)[7::8]]
    assert task.shape.records[-1].t_s == due[-2]
    assert task.record().shape.records[-1].t_s == due[-1]
