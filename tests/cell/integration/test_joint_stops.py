"""A joint's stop that a touch would meet is refused by the plan; one beyond is not."""

from __future__ import annotations

import math

import numpy as np
import pytest

import canprobe
from canprobe.errors import PlanError

SCAN = {"task.duration_s": 2.0, "cycle.rate_hz": 200.0, "shape.also": []}


def test_a_stop_on_the_way_of_the_run_is_refused_and_one_beyond_it_is_not():
    run = canprobe.run("cylinder", SCAN, bus="direct", files=False)
    model, limits = run.plan.setup.arm.model, run.plan.setup.limits
    q = run.log["q_target_rad"]
    q = q[np.isfinite(q).all(axis=1)]
    i = int(np.argmax(np.ptp(q, axis=0)))
    joint, step = model.joints[i], math.radians(1.0)
    ends = [("min_deg", q[:, i].min(), -1.0), ("max_deg", q[:, i].max(), 1.0)]
    met = [end for end in ends if abs(end[1] - q[0, i]) > 2.0 * step]  # at the other one it begins
    assert met
    for end, extreme, out in met:
        stop = extreme + out * limits.joint_margin[i]
        before, beyond = (
            {f"joints.{joint.name}.{end}": joint.shown(stop + share * out * step)} for share in (-0.1, 3.0)
        )
        with pytest.raises(PlanError, match=f"joint {i + 1} would move"):
            canprobe.plan("cylinder", SCAN | before)
        canprobe.plan("cylinder", SCAN | beyond)
