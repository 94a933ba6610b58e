"""A scene becomes a setup in SI units in one place."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scenes import change

from canprobe.cell.scene.load import load_scene, packaged_files, parse_scene
from canprobe.cell.scene.model import ObjectSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Touch
from canprobe.errors import PlanError, SceneError


def test_millimetres_degrees_and_kilopascals_become_si():
    scene = change(
        load_scene("cylinder"),
        task={"start_mm": (-121.0, -122.0, 374.0), "clearance_mm": 2.5, "speed_mm_s": 20.0, "heading_deg": 90.0},
        sensor={"full_scale_kpa": 300.0},
        probe={"centre_offset_mm": 70.0, "centre_lateral_mm": (1.0, -2.0)},
        limits={"joint_margin_deg": 2.0, "workspace_min_mm": (-200.0, -200.0, 300.0)},
        shape={"memory_mm": 15.0, "every_ms": 50.0},
        cycle={"compute_us": 150.0},
    )
    setup = resolve(scene)
    task = setup.task
    assert isinstance(task, Touch) and task.scan is not None and task.shape is not None
    np.testing.assert_allclose(task.approach.start, (-0.121, -0.122, 0.374))
    np.testing.assert_allclose(task.approach.axes, ((0, 1, 0), (-1, 0, 0), (0, 0, 1)), atol=1e-15)
    assert (task.approach.clearance, task.scan.speed) == pytest.approx((2.5e-3, 0.020))
    assert (task.shape.memory, task.shape.every_s) == pytest.approx((0.015, 0.05))
    assert setup.arm.q_start[0] == pytest.approx(math.pi / 2)
    assert setup.array.pad.full_scale_pa == pytest.approx(300e3)
    np.testing.assert_allclose(setup.probe.T_flange_probe[:3, 3], (1e-3, -2e-3, 0.070))
    assert setup.limits.joint_margin == pytest.approx(math.radians(2.0))
    np.testing.assert_allclose(setup.limits.workspace, ((-0.2, -0.2, 0.3), (math.inf,) * 3))
    assert setup.compute_ns == 150_000


def test_what_is_no_object():
    rows = ((1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, -1.0))
    wrong = dataclasses.replace(load_scene("cylinder"), object=ObjectSettings("quadric", matrix=rows))
    with pytest.raises(PlanError, match="object: matrix must pass through the origin"):
        resolve(wrong)


def test_a_scene_starts_in_a_posture_of_its_cell(tmp_path):
    cell = tmp_path / "mine.toml"
    cell.write_text(packaged_files("cells")["puma260"].read_text() + "\n[postures]\nready = [80, 70, 10, 5, 90, 20]\n")
    text = 'cell = "mine.toml"\n[scene]\nname = "t"\n[arm]\n[task]\nkind = "free"\nstart_posture = "ready"\n'
    arm = resolve(parse_scene(text, folder=tmp_path)).arm
    np.testing.assert_allclose(np.degrees(arm.q_start), [80, 70, 10, 5, 90, 20])
    assert arm.postures["start"] is arm.q_start
    with pytest.raises(SceneError, match=r"task.start_posture: expected a posture of \[postures\] \(ready\), got redy"):
        parse_scene(text.replace('"ready"', '"redy"'), folder=tmp_path)
