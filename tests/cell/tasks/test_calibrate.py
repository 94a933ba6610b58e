"""The calibration's motion goes on by the time that has passed, not by the cycles that were kept."""

from __future__ import annotations

import pytest

import canprobe
from canprobe.cell.master.controller import Measurement
from canprobe.cell.tasks.from_plan import make_task

PERIOD_NS = 2_500_000


def seconds_to_give_up(periods):
    """Time until no ball is found, where every cycle takes so many periods."""
    plan = canprobe.plan("calibrate", {"task.touches": 2, "task.clearance_mm": 1.0, "task.search_mm": 1.0})
    task = make_task(plan)
    q = plan.setup.arm.q_start
    for cycle in range(20_000):
        t_ns = periods * cycle * PERIOD_NS
        command = task.step(Measurement(cycle, t_ns, q, tactile_age=0))
        if command.stop_reason is not None:
            assert "touch 1: no ball found up to 1 mm" in command.stop_reason
            return t_ns * 1e-9
    raise AssertionError("it never gave up")


@pytest.mark.parametrize("periods", [2, 4])
def test_a_slow_machine_takes_as_long_as_a_quick_one(periods):
    assert seconds_to_give_up(periods) == pytest.approx(seconds_to_give_up(1), abs=12 * periods * PERIOD_NS * 1e-9)
