"""The example of an arm in MuJoCo, on a plant whose contact is MuJoCo's: alone, and as the arm of a cell that scans."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco_cell import Q_START, SCAN_S, Layer, felt, panda, scan

from canprobe.cell.plant.elastic_contact import depth_for_force, elastic_contact
from canprobe.mechanics.robot.denavit_hartenberg import tool_z_offset

RADIUS_M, STIFFNESS, FORCE_N = 0.040, 1.27e8, 2.0
KAPPA = 1 / 0.050, 1 / 0.050
DEPTH_M = depth_for_force(FORCE_N, KAPPA, RADIUS_M, STIFFNESS)
TOP = np.array((0.5, 0.0, 0.3))


@pytest.fixture
def arm_type(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[3] / "docs" / "example" / "arm"))
    from mujoco_arm import MujocoArm

    return MujocoArm


def pressed(arm_type: Any) -> tuple[np.ndarray, np.ndarray]:
    """A way down onto a ball and along it: depth and force of the contact, and where the flange is beside its goals."""
    ball = {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [1 / KAPPA[0], 0.0, 0.0]}
    ball["pos"] = (TOP - (0.0, 0.0, 1 / KAPPA[0])).tolist()
    model = panda(Layer(FORCE_N, DEPTH_M), tool_z_offset(80.0), RADIUS_M, ball)
    now_ns = 0
    arm = arm_type(model, "flange", lambda: now_ns, Q_START)
    goal = np.diag((1.0, -1.0, -1.0, 1.0))
    goal[:3, 3] = TOP[0], TOP[1], TOP[2] + RADIUS_M + 0.080 + 1e-3
    arm.place(goal)
    contacts, beside = [], []
    for k in range(600):
        now_ns += 4_000_000
        if k < 400:
            goal[2, 3] -= (1e-3 + 1.4 * DEPTH_M) / 400
        else:
            goal[0, 3] += 0.004 / 200
        arm.command(goal)
        T, t_ns = arm.read()
        assert t_ns == now_ns
        found = felt(model, arm.data)
        contacts.append((0.0, 0.0) if found is None else (found.depth_m, found.force_n))
        beside.append((T - goal)[:3, 3])
    return np.array(contacts), np.array(beside)


def test_near_the_working_force_the_contact_is_as_stiff_as_the_layer(arm_type: Any) -> None:
    contacts, beside = pressed(arm_type)
    depth, force = contacts[(contacts[:, 0] > 0.7 * DEPTH_M) & (contacts[:, 0] < 1.3 * DEPTH_M)].T
    assert len(depth) > 100
    layer = [elastic_contact(one, KAPPA, RADIUS_M, STIFFNESS).force for one in depth]
    assert force == pytest.approx(layer, rel=0.1)
    assert np.abs(beside).max() < 0.2e-3, "at these speeds the arm is nearly where it is sent, under load as well"
    again = pressed(arm_type)
    assert [one.tobytes() for one in again] == [contacts.tobytes(), beside.tobytes()]


@pytest.mark.slow(reason="the scan of a cell with 1000 steps of MuJoCo a second")
@pytest.mark.parametrize(("name", "kappa"), [("sphere", (20.0, 20.0)), ("cylinder", (1 / 0.036, 0.0))])
def test_a_scan_on_another_plant_finds_the_shape_and_keeps_the_force(
    name: str, kappa: tuple[float, float], arm_type: Any
) -> None:
    found = scan(name, arm_type, task__duration_s=SCAN_S)
    assert found.completed and found.contact_fraction == 1.0
    assert found.force_error < 0.1 and found.reading_error < 0.1
    assert found.held > 0.9, "the stated regions hold the curvature"
    assert found.kappa_per_m == pytest.approx(kappa, abs=3 * found.stated_per_m)
