"""How a summary tells of contact that a scan lost."""

import math
from collections import deque

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.results.text import losses_text
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.requested import Request, RequestedTask
from canprobe.cell.tasks.task import Loss
from canprobe.errors import UsageError
from canprobe.mechanics.touch.servo import TARGET_RATES

FOUND = {"searched_mm": 0.93, "regained_after_ms": 465.0}
GONE = {"searched_mm": 2.0, "regained_after_ms": None}


@pytest.mark.parametrize(
    ("losses", "text"),
    [
        ([FOUND], "contact lost 1 time: regained after 465 ms and 0.9 mm"),
        ([FOUND, GONE], "contact lost 2 times: regained after 465 ms and 0.9 mm, not regained within 2.0 mm"),
    ],
)
def test_each_loss_is_told(losses, text):
    assert losses_text(losses) == text


def test_a_loss_is_summed_up_in_the_units_of_the_summary():
    assert Loss(900, 0.93e-3, 0.465).summarised == pytest.approx(FOUND)
    assert Loss(1400, 2e-3).summarised == GONE


# A task under requests: it follows them without a step, and stops in its own orderly way.


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        ("start", 1.0),
        ("Start", None),
        (None, None),
        ("target_force_n", None),
        ("target_force_n", "3"),
        ("target_force_n", True),
        ("speed_m_s", math.nan),
        ("trajectory", None),
        ("trajectory", {"points": []}),
    ],
)
def test_what_is_no_command_cannot_be_requested(kind, value):
    with pytest.raises(UsageError, match="expected one of start, stop, resume, target_force_n"):
        Request(kind, value)


@pytest.fixture
def press():
    return Session(
        canprobe.load_scene(
            "press", {"task.duration_s": 3.0, "task.clearance_mm": 0.3, "cycle.rate_hz": 200.0, "bus.timed": False}
        )
    )


def test_the_force_follows_what_is_asked_for_and_a_stop_ends_it(press):
    """Asked for 3 N instead of 2 N during the hold, that is what is felt; then stop, long before the end.

    The true force is up to a twelfth higher: an array that was only pressed, and not yet rolled over, reads low.
    """
    queue, task = deque(), make_task(press.plan)
    controller = RequestedTask(task, None, (queue,), 2.5e-3)
    held = 0

    def step(measurement):
        nonlocal held
        held += task.phase == 3
        if held == 1:
            queue.append(Request("target_force_n", 3.0))
        elif held == 480:  # 1.2 s of 3 s
            queue.append(Request("stop"))
        return controller.step(measurement)

    with press:
        press.run(step)
    log = press.cell.log.arrays()
    target = log["target_force_n"][np.isfinite(log["target_force_n"])]
    assert target[-1] == 3.0
    assert np.abs(np.diff(target)).max() == pytest.approx(TARGET_RATES["target_force_n"] * 2.5e-3)  # no step
    first, last = task.record().scan_cycles
    assert last - first == pytest.approx(480, abs=2)
    assert log["force_n"][last - 60 : last].mean() == pytest.approx(3.0, abs=0.1)
    assert press.buses.truth["force_n"][last - 60 : last].mean() == pytest.approx(3.0, rel=1 / 12)
    assert task.reason is None and press.cell.notes.lines() == []


def test_a_stop_lets_a_calibration_go_of_its_ball():
    """Stopped in its second touch, it does not leave the probe pressing."""
    session = Session(
        canprobe.load_scene(
            "calibrate", {"bus.timed": False, "task.touches": 3, "task.clearance_mm": 1.0, "cycle.rate_hz": 200.0}
        )
    )
    queue, task = deque(), make_task(session.plan)
    controller = RequestedTask(task, None, (queue,), 2.5e-3)

    def step(measurement):
        if len(task.touches) == 1 and task.phase == 3 and not queue:
            queue.append(Request("stop"))
        return controller.step(measurement)

    with session:
        session.run(step)
    assert session.buses.truth["force_n"][-1] == 0.0 and session.cell.notes.lines() == []
    assert len(task.touches) == 1 and task.reason is None


def test_up_holds_until_a_start_and_holds_again_after_a_stop():
    """Two starts, two tasks; the first is stopped, nothing moves without one."""
    made, queue = [], deque()

    class Task(Controller):
        def __init__(self):
            made.append(self)

        def step(self, measurement):
            return Command(q_target=np.zeros(6), done=measurement.cycle == 60)

    controller = RequestedTask(None, Task, (queue,), 2.5e-3)
    asks = {10: "start", 20: "stop", 30: "start", 40: "start"}
    moved = []
    for cycle in range(80):
        if cycle in asks:
            queue.append(Request(asks[cycle]))
        command = controller.step(Measurement(cycle, cycle * 2_500_000))
        assert not command.done
        moved.append(command.q_target is not None)
    assert len(made) == 2
    assert [i for i, m in enumerate(moved) if m] == [*range(10, 21), *range(30, 61)]


def test_what_is_asked_before_the_start_holds_for_the_task_that_comes(press):
    queue = deque([Request("target_force_n", 2.5), Request("start")])
    controller = RequestedTask(None, lambda: make_task(press.plan), (queue,), 2.5e-3)
    columns = [controller.step(Measurement(i, i * 2_500_000, q=q0(), enabled=True)).columns for i in range(200)]
    assert columns[-1]["target_force_n"] == 2.5


def q0():
    return np.radians((90.0, 65.0, 15.0, 0.0, 100.0, 0.0))


def test_what_a_task_does_once_its_commands_are_out_is_passed_on():
    worked = []

    class Working(Controller):
        retreats_itself = True

        def update(self):
            worked.append("update")

        def retreat(self, reason):
            worked.append(reason)

    requested = RequestedTask(Working(), None, (), 2.5e-3)
    requested.update()
    assert requested.retreats_itself
    requested.retreat("enough")
    assert worked == ["update", "enough"]
    idle = RequestedTask(None, None, (), 2.5e-3)
    idle.update()
    assert not idle.retreats_itself
