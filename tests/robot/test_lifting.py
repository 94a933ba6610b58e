"""Moving the tool with the motors that are left: against the forward kinematics, with the wrist's coupling."""

import numpy as np
import pytest

from canprobe.robot.kinematics import forward, forward_jacobian, tool_z_offset
from canprobe.robot.lifting import lifting_step
from canprobe.robot.puma260 import ELBOW_FORM, UPENN, counts_to_joints, joints_to_counts

TOOL = tool_z_offset(80.0)
MOVE = np.array((0.6, -0.5, 0.9)) * 1e-4


def stepped(free, move=MOVE, q=ELBOW_FORM):
    return lifting_step(forward_jacobian(UPENN, q, TOOL)[1][:3], UPENN.joints_per_count, move, np.array(free, bool))


def moved(counts, q=ELBOW_FORM):
    after = counts_to_joints(UPENN, joints_to_counts(UPENN, q) + counts)
    return (forward(UPENN, after) @ TOOL)[:3, 3] - (forward(UPENN, q) @ TOOL)[:3, 3]


@pytest.mark.parametrize("lost", [(), (0,), (1,), (2,), (3,), (4,), (5,), (0, 2), (3, 4, 5)])
def test_the_motors_that_are_left_make_the_move(lost):
    counts = stepped([i not in lost for i in range(6)])
    assert all(counts[i] == 0.0 for i in lost)
    assert moved(counts) == pytest.approx(MOVE, abs=2e-3 * np.linalg.norm(MOVE)), "the arc's second order is left"


def test_with_all_motors_no_other_step_turns_the_joints_less():
    counts = stepped([True] * 6)
    dq = UPENN.joints_per_count @ counts
    J = forward_jacobian(UPENN, ELBOW_FORM, TOOL)[1][:3]
    assert J @ dq == pytest.approx(MOVE, abs=1e-12)
    with_motors_4_to_6 = UPENN.joints_per_count @ stepped([True] * 3 + [False] * 3)
    assert np.linalg.norm(dq) < np.linalg.norm(with_motors_4_to_6)


@pytest.mark.parametrize("free", [(5,), (3, 4), (0, 3, 4, 5)])
def test_a_move_that_the_motors_cannot_make_is_none(free):
    assert stepped([i in free for i in range(6)]) is None


@pytest.mark.parametrize(("bent", "possible"), [(1e-3, False), (0.1, False), (0.4, True)])
def test_motors_that_are_badly_placed_for_a_move_are_not_asked(bent, possible):
    """Back along an arm that is nearly stretched out, without the wrist."""
    q = np.array((0.3, 0.4, bent - np.pi / 2, 0.0, 0.2, 0.0))
    x, y, _ = (forward(UPENN, q) @ TOOL)[:3, 3]
    back = -1e-4 * np.array((x, y, 0.0)) / np.hypot(x, y)
    counts = stepped([True] * 3 + [False] * 3, back, q)
    assert (counts is not None) is possible
    assert counts is None or moved(counts, q) == pytest.approx(back, abs=2e-6)
