"""A cell whose array has the calibration of another one: it says so once, and is less certain from there on."""

import re

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.monitor import Monitor
from canprobe.cell.master.options import RunOptions
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.cell.scene.load import load_scene
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_shape_tracker, make_task
from canprobe.mechanics.touch.pad import Pad

SCAN = {
    "task.duration_s": 4.0,
    "task.clearance_mm": 0.3,
    "shape.also": [],
    "outputs.figures": False,
    "bus.interface": "direct",
    "cycle.rate_hz": 200.0,
}
SAID = "the array is not as its calibration says"


def said(faults):
    return [fault for fault in faults if fault.startswith(SAID)]


def test_a_harder_layer_is_said_once_and_widens_the_force_alone():
    result = canprobe.run(load_scene("cylinder", SCAN | {"plant.stiffness_n_m3": 1.9e8}), files=False)
    (line,) = said(result.summary["faults"])
    assert "its layer has 1.9" in line and "(calibration: 1.24e+08)" in line
    assert ": forces are stated wider from here on; type `canprobe calibrate array CELL`" in line
    assert result.text().count(SAID) == 1
    sigma, force = result.log["force_sigma_n"], result.log["force_n"]
    rows = np.flatnonzero(result.log["phase"] == 3)
    first, last = rows[: len(rows) // 10], rows[-len(rows) // 10 :]
    assert np.nanmedian(sigma[first] / force[first]) < 0.03
    assert np.nanmedian(sigma[last] / force[last]) == pytest.approx(0.22, abs=0.04)  # ½ ln 1.53, and 5 %
    covariance = np.array([record.estimate.covariance for record in result.estimates["recursive"]])
    steps = covariance[1:, 0, 0] / covariance[:-1, 0, 0]
    assert np.nanmax(steps[len(steps) // 4 :]) < 2.0  # the stiffness is known by then


def test_images_that_contradict_the_motion_are_left_out_and_regions_are_wider():
    """A scan of a cylinder of 36 mm with an array that blurs more than its calibration says."""
    plan, frames = canprobe.plan("cylinder", SCAN | {"bus.interface": "lockstep"}), []
    watch = RunOptions(observers=(lambda observation: frames.extend(observation.frames),))
    session, task = Session(plan, watch), make_task(plan)
    session.buses.world.plant.array = TaxelArray(TaxelConfig(blur_pitch=1.0), np.random.default_rng(3), pad=Pad())
    with session:
        session.run(task)
    (line,) = said(session.cell.notes.lines())
    assert re.search(r"blurred by 1\.[5-8]. mm", line)
    assert ": forces and regions are stated wider from here on" in line
    monitor = Monitor(plan)
    monitor.push(frames)
    assert monitor.view(frames[-1][2]).array.startswith(f"{SAID}: its images are blurred by")
    answers = [record.estimate for record in task.shape.records]
    withheld, last = [answer.rank for answer in answers[20:60]], answers[-1]
    assert max(withheld) == 0 and last.rank == 3 and "patch" not in last.method
    assert np.linalg.eigvalsh(last.K) == pytest.approx([0.0, 1e3 / 36.0], abs=1.0)
    sure, doubted = make_shape_tracker(plan.setup), make_shape_tracker(plan.setup)
    doubted.doubted = True
    for tracker in (sure, doubted):
        for contact in task.shape.samples:
            tracker.add(contact)
            tracker.answer_at_once(contact.t_s)
    a, b = sure.records[-1].estimate, doubted.records[-1].estimate
    assert b.covariance == pytest.approx(4.0 * a.covariance) and pytest.approx(a.K) == b.K
