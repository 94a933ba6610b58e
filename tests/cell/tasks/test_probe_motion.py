"""A probe led by arms of three to seven joints: it keeps the rows that its arm can hold."""

import numpy as np
import pytest
from serial_arms import five, gantry, scara, seven

from canprobe.cell.scene.setup import Arm, Probe, SafetyLimits
from canprobe.cell.tasks.probing import ProbeMotion
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset
from canprobe.mechanics.robot.inverse import task_rows
from canprobe.mechanics.touch.servo import ProbePose

TOOL = tool_z_offset(80.0)
START = {
    "gantry": (0.3, 0.3, 0.3),
    "scara": (0.3, 0.8, 0.1, 0.5),
    "five": (0.3, 0.9, -1.2, 0.6, 0.2),
    "seven": (0.2, 0.5, 0.1, -1.2, 0.3, 0.8, 0.4),
}


def motion_of(model, q, margin=0.0):
    safety = SafetyLimits(5.0, 0.15, margin, 1.0, 0.1, None)
    return ProbeMotion(Arm(model, (), q, 5, False), Probe(TOOL, 0.04, 1e8, 0.3), safety, 2.5e-3, q)


@pytest.mark.parametrize("model", [gantry(), scara(), five(), seven()], ids=lambda model: model.name)
def test_a_line_is_followed_in_the_rows_of_the_arm(model):
    q = np.array(START[model.name])
    motion, T = motion_of(model, q, 0.02), forward(model.chain, q) @ TOOL
    along, lean = np.array((0.6, -0.3, 0.2)), np.array((0.3, 0.2, -0.1)) if task_rows(model) > 3 else np.zeros(3)
    for k in range(400):
        pole = T[:3, 2] + k / 400 * lean
        target = motion.step(ProbePose(T[:3, 3] + 0.04 * k / 400 * along, pole / np.linalg.norm(pole)))
    reached = forward(model.chain, target) @ TOOL
    assert reached[:3, 3] == pytest.approx(T[:3, 3] + 0.04 * 399 / 400 * along, abs=2e-5)
    if task_rows(model) > 3:
        assert reached[:3, 2] == pytest.approx(pole / np.linalg.norm(pole), abs=1e-4)
    assert motion.limit is None and motion.slowed == 0


def test_seven_joints_stay_near_the_posture_that_they_began_with():
    model, q = seven(), np.array(START["seven"])
    motion, T = motion_of(model, q), forward(seven().chain, q) @ TOOL
    for k in range(2400):
        turn = 2 * np.pi * k / 800
        offset = 0.02 * np.array((np.cos(turn) - 1.0, np.sin(turn), 0.0))
        target = motion.step(ProbePose(T[:3, 3] + offset, T[:3, 2]))
    assert target == pytest.approx(q, abs=0.01), "three circles later"


def test_a_slide_stops_at_its_end_in_mm():
    model = gantry()
    q = np.array((0.59, 0.3, 0.3))
    motion, T = motion_of(model, q, 0.01), forward(model.chain, q) @ TOOL
    for k in range(200):
        motion.step(ProbePose(T[:3, 3] + 1e-4 * k * np.array((1.0, 0.0, 0.0)), T[:3, 2]))
        if motion.limit is not None:
            break
    assert motion.limit == "joint 1 at 590.1 mm, its stop"
    assert motion.q[0] == pytest.approx(0.6 - 0.01)
