"""The touch task's own reasons to stop: each retreats first, names the reason, and leaves the cell safe."""

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import SafetyStop

QUICK = {"task.duration_s": 3.0, "task.clearance_mm": 0.05, "cycle.rate_hz": 200.0}


def run_until_stopped(session, at_cycle=None, action=None):
    controller = make_task(session.plan)

    def step(measurement):
        if measurement.cycle == at_cycle:
            action(session)
        return controller.step(measurement)

    step.retreat = controller.retreat
    with pytest.raises(SafetyStop) as stopped, session:
        session.run(step)
    return stopped.value.reason, session.buses.truth


def press_session(**changes):
    scene = canprobe.load_scene("press", QUICK)
    for section, values in changes.items():
        scene = replace(scene, **{section: replace(getattr(scene, section), **values)})
    return Session(scene)


def test_no_object_where_it_was_expected():
    scene = canprobe.load_scene("press")
    below = tuple(np.array(scene.object.position_mm) - (0, 0, 1.5))
    session = press_session(object={"position_mm": below}, task={"search_mm": 2.0})
    session.scene = session.plan.scene

    def sink(session):
        plant = session.buses.world.plant
        plant.place(None)

    reason, truth = run_until_stopped(session, at_cycle=60, action=sink)
    assert "no object found up to 2 mm beyond" in reason
    assert truth["force_n"].max() == 0.0


def test_sensor_lives_but_never_sends_a_frame():
    session = press_session()
    frames = {pdo.cob_id for pdo in session.plan.pdos_of(16, "tpdo")}

    (sensor,) = [node for node in session.buses.world.nodes if node.node_id == 16]
    original = sensor.receive
    sensor.receive = lambda can_id, data, t_ns: [f for f in original(can_id, data, t_ns) if f[0] not in frames]
    reason, truth = run_until_stopped(session)
    assert "no tactile frame for" in reason
    assert truth["force_n"].max() == 0.0


@pytest.mark.slow(reason="a whole touch")
def test_samples_that_say_they_are_old_do_not_move_the_surface():
    """A sample older than the one before would turn the correction of the servo's surface round."""
    session = press_session()
    controller = make_task(session.plan)

    def step(measurement):
        sample = measurement.tactile
        if sample is not None and 200 < measurement.cycle < 400 and measurement.cycle % 4 == 2:
            measurement = replace(measurement, tactile=replace(sample, t_sample_ns=sample.t_sample_ns - 60_000_000))
        return controller.step(measurement)

    with session:
        session.run(step)
    assert controller.record().unplaced > 20
    assert session.buses.truth["force_n"].max() < 3.0


def test_joint_at_its_stop():
    session = press_session()
    controller = make_task(session.plan)

    def step(measurement):
        command = controller.step(measurement)
        if measurement.cycle == 200:
            motion = controller._motion
            motion._high = motion.q + 1e-6  # the stops close in on the posture
            motion._low = motion.q - 1e-6
            motion._range = list(zip(motion._low.tolist(), motion._high.tolist(), strict=True))
        return command

    step.retreat = controller.retreat
    with pytest.raises(SafetyStop, match=r"joint \d at .* deg, its stop"), session:
        session.run(step)


def test_a_run_that_is_stopped_leaves_its_summary_with_the_error():
    scene = canprobe.load_scene("press", QUICK | {"limits.force_max_n": 2.1})
    with pytest.raises(SafetyStop) as stopped:
        canprobe.run(scene, files=False)
    summary = stopped.value.summary
    assert (summary["completed"], summary["stop_reason"]) == (False, stopped.value.reason)
