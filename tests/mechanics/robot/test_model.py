"""Drive units of joints, prismatic and coupled ones among them; what is no model."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from published_puma import MODELS, UPENN
from serial_arms import gantry, scara, seven

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import (
    METRES_PER_RADIAN,
    ArmModel,
    joints_per_motor,
    joints_to_units,
    position_sigma,
    units_per_motor,
    units_to_joints,
)

ALL = {model.name: model for model in (*MODELS.values(), gantry(), scara(), seven())}
EACH = pytest.mark.parametrize("model", ALL.values(), ids=ALL)


@EACH
@given(data=st.data())
def test_units_round_trip(model, data):
    q = data.draw(st.lists(st.floats(-7, 7), min_size=model.n, max_size=model.n))
    assert units_to_joints(model, joints_to_units(model, q)) == pytest.approx(q, abs=1e-11)


@EACH
def test_motor_coordinates_are_drive_units_by_their_own_gear(model):
    q = np.random.default_rng(0).normal(size=model.n)
    motors = np.linalg.solve(joints_per_motor(model), q)
    assert motors * units_per_motor(model) == pytest.approx(joints_to_units(model, q) - model.zero_units)


def test_a_slide_counts_by_its_length():
    assert scara().radian == pytest.approx((1.0, 1.0, METRES_PER_RADIAN, 1.0))
    slide, turn = scara().joints[2], scara().joints[0]
    assert slide.text(0.1234) == "123.4 mm" and turn.text(np.pi / 2, "g") == "90 deg"


def test_position_sigma_is_the_scatter_of_a_tool_whose_drives_are_rounded():
    model, direction = UPENN, (0.6, 0.0, -0.8)
    tool = np.eye(4)
    tool[:3, 3] = 0.01, -0.02, 0.08
    rng = np.random.default_rng(4)
    middle = np.array([1.6, 1.1, 0.2, 0.1, 1.8, 0.1])
    errors = []
    for _ in range(2000):
        q = middle + rng.uniform(-0.01, 0.01, 6)
        seen = units_to_joints(model, np.round(joints_to_units(model, q)))
        error = (forward(model.chain, seen) @ tool)[:3, 3] - (forward(model.chain, q) @ tool)[:3, 3]
        errors.append(error @ np.array(direction))
    assert position_sigma(model, middle, tool, direction) == pytest.approx(np.std(errors), rel=0.06)
    assert abs(np.mean(errors)) < 0.1 * np.std(errors)


def changed(i, **values):
    return tuple(replace(joint, **values) if k == i else joint for k, joint in enumerate(UPENN.joints))


ALIKE = UPENN.units_per_q.copy()
ALIKE[1] = ALIKE[0]
ALIKE[:2, :2] = 5000.0
STILL = UPENN.units_per_q.copy()
STILL[2, 2] = 0.0


@pytest.mark.parametrize(
    ("joints", "units", "zero", "message"),
    [
        (UPENN.joints[:5], UPENN.units_per_q, np.zeros(6), "expected the joints joint_1"),
        (changed(2, prismatic=True), UPENN.units_per_q, np.zeros(6), "expected the joints joint_1"),
        (changed(2, q_min=5.0), UPENN.units_per_q, np.zeros(6), "joint_3: expected q_min below q_max, got 5 and 1.0"),
        (changed(2, qd_max=0.0), UPENN.units_per_q, np.zeros(6), "joint_3: expected a speed limit above 0"),
        (UPENN.joints, np.eye(5), np.zeros(6), r"units_per_q \(6, 6\)"),
        (UPENN.joints, UPENN.units_per_q, np.zeros(5), r"zero_units \(6,\)"),
        (UPENN.joints, STILL, np.zeros(6), "joint_3: its drive does not move it"),
        (UPENN.joints, ALIKE, np.zeros(6), "move the same joints alike"),
    ],
)
def test_what_is_no_model_is_refused(joints, units, zero, message):
    with pytest.raises(PlanError, match=message):
        ArmModel(UPENN.chain, joints, units, zero)
