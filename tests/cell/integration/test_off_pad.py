"""A contact that runs off the array: what lies beyond its edge is not felt, so that a servo would press ever harder."""

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.supervision import Reaction, limits_of
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.scene.model import ObjectSettings
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import SafetyStop

EDGE_M = 8 * 1.5875e-3


def test_the_probe_lets_go_before_the_force_has_grown():
    """A probe of 135 mm has a pad of 11 degrees, and the edge of the fillet turns by more than that within a second.

    The scene says a plane, as the plan would refuse the fillet.
    """
    scene = canprobe.load_scene("fillet", {"task.duration_s": 3.0, "bus.interface": "direct"})
    scene = replace(
        scene,
        task=replace(scene.task, strategy="straight", width_mm=9.0, wavelength_mm=12.0, rolling_share=0.36),
        probe=replace(scene.probe, radius_mm=135.0),
        shape=replace(scene.shape, also=()),
    )
    flat = replace(scene, object=ObjectSettings("plane", scene.object.position_mm, scene.object.rotation_deg))
    with pytest.raises(SafetyStop) as stopped, Session(flat) as session:
        plant = session.buses.world.plant
        plant.place(true_object(scene.object))
        session.run(make_task(session.plan))
    assert "the contact runs off the edge of the array" in stopped.value.reason
    truth = session.buses.truth
    outside = np.flatnonzero(np.abs(truth["pad_uv_m"]).max(axis=1) > EDGE_M)
    pressed = np.count_nonzero(truth["force_n"][outside] > 0.0) * session.plan.sync.period_ns
    assert BY_KEY["off_pad"].reaction is Reaction.RETREAT
    assert pressed <= BY_KEY["off_pad"].within(limits_of(session.plan)) + 100e6
    assert truth["force_n"].max() < 3.0  # of 5 N allowed; it grew to 160 N
    assert truth["force_n"][-1] == 0.0


def test_a_cylinder_across_a_flat_array_is_let_go():
    """It goes on beyond the array: triangles of ten taxels read 2 N where 8 N pressed.

    The way back is measured at the tip: about a centre 10 m away counts of the encoders alone made the 6 mm of it.
    """
    sensor = {"sensor.array": "icub-triangles", "sensor.channel": "can1"}
    scene = canprobe.load_scene("press", sensor | {"task.approach_mm_s": 2.1})
    with Session(scene) as session, pytest.raises(SafetyStop, match="the contact runs off the edge of the array"):
        session.run(make_task(session.plan))
    force = session.buses.truth["force_n"]
    assert force.max() < 1.2 * session.plan.setup.limits.force_max and force[-1] == 0.0
