"""The array's full scale: what the sensor computes by itself holds for it, and a wrong one is noticed in bring-up."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.session.session import Session
from canprobe.errors import NodeError
from canprobe.fieldbus.eds.packaged import FULL_SCALE


def press(full_scale_kpa, mode):
    scene = canprobe.load_scene("press", {"cycle.rate_hz": 200.0})
    return replace(
        scene,
        sensor=replace(scene.sensor, full_scale_kpa=full_scale_kpa, mode=mode),
        task=replace(scene.task, clearance_mm=0.2),
        bus=replace(scene.bus, timed=False),
    )


@pytest.mark.parametrize("mode", ["features", "window"])
def test_the_true_force_is_the_asked_one_whatever_the_full_scale(mode):
    result = canprobe.run(press(300.0, mode), bus="direct", files=False, duration_s=0.3)
    held = result.truth["force_n"][result.log["phase"] == 3]
    assert np.mean(held) == pytest.approx(2.0, rel=0.15)
    assert result.truth["force_n"].max() < 3.0


def test_an_array_of_another_full_scale_is_refused():
    session = Session(press(100.0, "window"))

    (sensor,) = [node for node in session.buses.world.nodes if node.node_id == 16]
    sensor.dictionary.set_default(FULL_SCALE, 0, 300_000)
    said = r"node 16: \(tactile array\) 2004h:00 expected 100000, as the scene's sensor.full_scale_kpa says, got 300000"
    with pytest.raises(NodeError, match=said):
        session.__enter__()
