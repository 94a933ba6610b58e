"""An array that is blind, frozen or reads too low: something else than the array bounds the true force.

The limit is 5 N everywhere. The truth is the emulator's; what the operator reads names the array.
"""

import functools

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.options import RunOptions
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.errors import SafetyStop

LIMIT_N = 5.0


@functools.cache
def run(scene, text, phase, after_s, **changes):
    """Throw a fault some time into a phase; highest true force, N, what stopped the cell, and the session."""
    overrides = {"task.duration_s": 3.0, "task.clearance_mm": 1.0} | {
        k.replace("__", "."): v for k, v in changes.items()
    }
    session = Session(canprobe.load_scene(scene, overrides), RunOptions())
    faulty, task, begun, thrown = session.buses.world.make_faulty(), None, [], []
    session.buses.world.participants[:] = faulty.nodes
    task = make_task(session.plan)
    forces = []

    def progress(measurement):
        if task.phase is phase and not begun:
            begun.append(measurement.t_ns)
        if begun and not thrown and measurement.t_ns >= begun[0] + after_s * 1e9:
            faulty.inject(text, session.buses.lockstep.clock.now_ns())
            thrown.append(measurement.t_ns)
        forces.append(session.buses.world.plant.truth()["force"])

    with pytest.raises(SafetyStop) as stopped, session:
        session.run(task, progress)
    assert thrown, "the fault was never thrown"
    return max(forces), stopped.value, session


@pytest.mark.parametrize(
    ("scene", "text", "phase", "after_s", "words"),
    [
        ("press", "node 16: stuck-image", Phase.SCAN, 0.3, "the array has sent the same image for"),
        ("press", "node 16: replayed-image", Phase.SCAN, 0.3, "depth in the surface that it touched before means 3."),
        ("press", "node 16: gain-lost", Phase.SCAN, 0.3, "the measured force fell from"),
        ("press", "node 16: replayed-image", Phase.SETTLE, 0.05, "depth in the surface that it touched before means"),
        ("press", "node 16: dead-rows first=0 rows=16", Phase.APPROACH, 0.05, "torques of the drives show a push of"),
        (
            "calibrate",
            "node 16: dead-rows first=0 rows=16",
            Phase.APPROACH,
            0.0,
            "torques of the drives show a push of",
        ),
    ],
)
def test_a_blind_array_presses_no_harder(scene, text, phase, after_s, words):
    highest, stop, session = run(scene, text, phase, after_s)
    assert words in stop.reason
    assert highest < (1.5 if phase is Phase.APPROACH else 1.2) * LIMIT_N
    assert session.buses.world.plant.truth()["force"] == 0.0, "the probe was taken off"
    assert not any(
        node.application.powered for node in session.buses.world.nodes if hasattr(node.application, "powered")
    )


def test_what_it_is_left_with_is_said_to_be_unknown():
    _, _, session = run("press", "node 16: stuck-image", Phase.SCAN, 0.3)
    (note,) = [line for line in session.cell.notes.lines() if "left pressing" in line]
    assert "with an unknown force: the array is not believed, as the array has sent the same image" in note


def test_an_approach_without_torques_goes_as_far_as_the_limit_presses_until_the_array_was_seen_alive():
    """The array is blind from the beginning, and the drives report no torque: the object is where it was expected."""
    highest, stop, _ = run("press", "node 16: dead-rows first=0 rows=16", Phase.MOVE, 0.0, arm__torque=False)
    assert "no object found up to 0.57 mm beyond the expected place" in stop.reason
    assert "the array may be blind" in stop.reason
    assert highest < 1.5 * LIMIT_N


@pytest.mark.parametrize(
    ("search_mm", "words", "most_n"), [(None, "up to 0.57 mm", 6.0), (8.0, "the torques of", 20.0)]
)
def test_a_slow_approach_presses_no_harder_though_it_adds_little_force_at_a_time(search_mm, words, most_n):
    """Turning slowly, the motors' friction may hide 13 N, so that the default search is as if no torque was reported.

    A torque of half a second before tells nothing of a force that grows for seconds: it was 437 N.
    """
    highest, stop, _ = run(
        *("press", "node 16: dead-rows first=0 rows=16", Phase.APPROACH, 0.05),
        task__approach_mm_s=1.0, task__search_mm=search_mm,
    )  # fmt: skip
    assert words in stop.reason and highest < most_n


def test_a_person_may_widen_the_search():
    plan = canprobe.plan("press", {"task.search_mm": 3.0, "arm.torque": False})
    assert plan.setup.task.approach.search == plan.setup.task.approach.blind_search == pytest.approx(3e-3)
    narrow = canprobe.plan("press", {"arm.torque": False}).setup.task.approach
    assert narrow.search == pytest.approx(8e-3)
    assert np.isclose(narrow.blind_search, 0.566e-3, rtol=0.02)  # what 5 N press into the layer on a plane
