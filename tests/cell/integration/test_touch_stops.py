"""The touch task's own reasons to stop: each retreats first, names the reason, and leaves the cell safe."""

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import SafetyStop

QUICK = {"task.duration_s": 3.0, "task.clearance_mm": 0.05, "cycle.rate_hz": 200.0}


def run_until_stopped(scene, at_cycle, action):
    """The reason of the stop, and the truth; something is done to the session and its task at a cycle."""
    session = Session(scene)
    task = make_task(session.plan)

    def step(measurement):
        command = task.step(measurement)
        if measurement.cycle == at_cycle:
            action(session, task)
        return command

    step.retreat = task.retreat
    with pytest.raises(SafetyStop) as stopped, session:
        session.run(step)
    return stopped.value.reason, session.buses.truth


def test_no_object_where_it_was_expected():
    scene = canprobe.load_scene("press", QUICK | {"task.search_mm": 2.0})
    below = tuple(np.array(scene.object.position_mm) - (0, 0, 1.5))
    scene = replace(scene, object=replace(scene.object, position_mm=below))
    reason, truth = run_until_stopped(scene, 60, lambda session, _: session.buses.world.plant.place(None))
    assert "no object found up to 2 mm beyond" in reason
    assert truth["force_n"].max() == 0.0


def test_joint_at_its_stop():
    def close_in(session, task):
        """The stops of the joints close in on the posture."""
        motion = task._motion
        motion._high, motion._low = motion.q + 1e-6, motion.q - 1e-6
        motion._range = list(zip(motion._low.tolist(), motion._high.tolist(), strict=True))

    reason, _ = run_until_stopped(canprobe.load_scene("press", QUICK), 200, close_in)
    assert "deg, its stop" in reason


def test_a_run_that_is_stopped_leaves_its_summary_with_the_error():
    scene = canprobe.load_scene("press", QUICK | {"limits.force_max_n": 2.1})
    with pytest.raises(SafetyStop) as stopped:
        canprobe.run(scene, files=False)
    summary = stopped.value.summary
    assert (summary["completed"], summary["stop_reason"]) == (False, stopped.value.reason)
