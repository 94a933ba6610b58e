"""The example of an arm in MuJoCo, and the contact there: what they do before a cell has them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mujoco_cell import Q_START, Layer, panda, touch

from canprobe.cell.plant.elastic_contact import depth_for_force, elastic_contact
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset

ROOT = Path(__file__).parents[3]
RADIUS_M, STIFFNESS = 0.040, 1.27e8
KAPPA = 1 / 0.050, 1 / 0.050
T_FLANGE_PROBE = tool_z_offset(80.0)


@pytest.fixture
def mujoco_arm(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "example" / "arm"))
    from mujoco_arm import MujocoArm

    return MujocoArm


class Clock:
    t_ns = 0

    def __call__(self) -> int:
        return self.t_ns


def pressed(arm_type: Any) -> list[tuple[float, ...]]:
    """Depth, force, friction, and following errors on a way down onto a sphere, and over it."""
    import mujoco

    depth = depth_for_force(2.0, KAPPA, RADIUS_M, STIFFNESS)
    sphere = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [0.050, 0.0, 0.0], "pos": [0.5, 0.0, 0.3 - 0.050]}
    model = panda(Layer(2.0, depth), T_FLANGE_PROBE, RADIUS_M, sphere)
    clock = Clock()
    arm = arm_type(model, "flange", clock, Q_START)
    T, t_ns = arm.read()
    assert t_ns == 0
    top = T.copy()
    top[:3, :3] = np.diag((1.0, -1.0, -1.0))
    rows = []
    for k in range(1200):
        clock.t_ns += 4_000_000
        share = min(k / 400, 1.0)
        goal = top.copy()
        height = 0.3 + RADIUS_M + 0.080 + 2e-3 - min(max(k - 400, 0) / 400, 1.0) * (2e-3 + 1.5 * depth)
        goal[:3, 3] = (1 - share) * T[:3, 3] + share * np.array((0.5, 0.0, height))
        arm.command(goal)
        here, _ = arm.read()
        found = touch(model, arm.data)
        felt = (found.depth_m, found.force_n, found.friction_n) if found is not None else (0.0, 0.0, 0.0)
        rows.append((*felt, *(here - goal)[:3, 3]))
    return rows


def test_near_its_working_force_the_contact_is_as_stiff_as_the_layer(mujoco_arm: Any) -> None:
    rows = np.array(pressed(mujoco_arm))

    np.set_printoptions(linewidth=150, precision=6, suppress=True)
    print(rows[::50])
    depth, force = rows[:, 0], rows[:, 1]
    work = depth_for_force(2.0, KAPPA, RADIUS_M, STIFFNESS)
    near = (depth > 0.7 * work) & (depth < 1.4 * work)
    assert near.sum() > 20
    expected = [elastic_contact(d, KAPPA, RADIUS_M, STIFFNESS).force for d in depth[near]]
    assert force[near] == pytest.approx(expected, rel=0.1)
