"""The touch task's own reasons to stop: each retreats first, names the reason, and leaves the cell safe."""

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import SafetyStop


def run_until_stopped(session, at_cycle=None, action=None, target_n=None):
    controller = make_task(session.plan)
    if target_n is not None:
        controller.targets["target_force_n"] = target_n

    def step(measurement):
        if measurement.cycle == at_cycle:
            action(session)
        return controller.step(measurement)

    step.retreat = controller.retreat
    with pytest.raises(SafetyStop) as stopped, session:
        session.run(step)
    return stopped.value.reason, session.buses.truth


def press_session(**changes):
    scene = canprobe.load_scene("press", {"task.duration_s": 3.0})
    for section, values in changes.items():
        scene = replace(scene, **{section: replace(getattr(scene, section), **values)})
    return Session(scene)


def test_force_above_the_limit():
    reason, truth = run_until_stopped(press_session(limits={"force_max_n": 2.5}), target_n=4.0)
    assert "above the limit of 2.50 N" in reason
    assert np.count_nonzero(truth["force_n"] > 2.5) < 60  # 150 ms: approach until the sample is in, then retreat
    assert truth["force_n"][-1] == 0.0  # it let go


def test_no_object_where_it_was_expected():
    scene = canprobe.load_scene("press")
    below = tuple(np.array(scene.object.position_mm) - (0, 0, 7.5))
    session = press_session(object={"position_mm": below}, task={"search_mm": 8.0})
    session.scene = session.plan.scene

    def sink(session):
        plant = session.buses.world.plant
        plant.config = replace(plant.config, object=None)
        plant._solved = None

    reason, truth = run_until_stopped(session, at_cycle=60, action=sink)
    assert "no object found up to 8 mm beyond" in reason
    assert truth["force_n"].max() == 0.0


def test_contact_lost_in_the_hold():
    def vanish(session):
        plant = session.buses.world.plant
        plant.config = replace(plant.config, object=None)
        plant._solved = None

    reason, _ = run_until_stopped(press_session(), at_cycle=1100, action=vanish)
    assert "the measured force fell from 2.0" in reason and "or the object was taken away" in reason


def test_sensor_falls_silent_but_lives():
    session, silent = press_session(), []
    (sensor,) = [node for node in session.buses.world.nodes if node.node_id == 16]
    original = sensor.receive
    sensor.receive = lambda can_id, data, t_ns: [f for f in original(can_id, data, t_ns) if f[0] < 0x511 or not silent]
    reason, truth = run_until_stopped(session, at_cycle=1100, action=silent.append)
    assert "no tactile frame for 13 cycles" in reason
    assert truth["force_n"][-1] == 0.0


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
        if sample is not None and 900 < measurement.cycle < 1100 and measurement.cycle % 8 in (4, 5):
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
        if measurement.cycle == 1000:
            motion = controller._motion
            motion._high = motion.q + 1e-6  # the stops close in on the posture
            motion._low = motion.q - 1e-6
            motion._range = list(zip(motion._low.tolist(), motion._high.tolist(), strict=True))
        return command

    step.retreat = controller.retreat
    with pytest.raises(SafetyStop, match=r"joint \d at .* deg, its stop"), session:
        session.run(step)


def test_a_run_that_is_stopped_leaves_its_summary_with_the_error():
    scene = canprobe.load_scene("press")
    scene = replace(scene, limits=replace(scene.limits, force_max_n=2.1))
    with pytest.raises(SafetyStop) as stopped:
        canprobe.run(scene, files=False)
    summary = stopped.value.summary
    assert (summary["completed"], summary["stop_reason"]) == (False, stopped.value.reason)
