"""What the encoders' counts leave open of the tool's position, against rounding at random."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.robot.kinematics import forward
from canprobe.robot.puma260 import MODELS, counts_to_joints, joints_to_counts
from canprobe.robot.resolution import count_sigma


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.6, 0.0, -0.8)])
@pytest.mark.parametrize("name", sorted(MODELS))
def test_it_is_the_scatter_of_a_tool_whose_joints_are_rounded(name, direction):
    model = MODELS[name]
    tool = np.eye(4)
    tool[:3, 3] = 0.01, -0.02, 0.08
    rng = np.random.default_rng(4)
    middle = np.array([1.6, 1.1, 0.2, 0.1, 1.8, 0.1])
    errors = []
    for _ in range(2000):
        q = middle + rng.uniform(-0.01, 0.01, 6)
        seen = counts_to_joints(model, np.round(joints_to_counts(model, q)))
        error = (forward(model, seen) @ tool)[:3, 3] - (forward(model, q) @ tool)[:3, 3]
        errors.append(error @ np.array(direction))
    assert count_sigma(model, middle, tool, direction) == pytest.approx(np.std(errors), rel=0.06)
    assert abs(np.mean(errors)) < 0.1 * np.std(errors)
