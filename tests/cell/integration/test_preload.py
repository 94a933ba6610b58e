"""A run begun with the probe on an object: its tare would take the press for zero, so that nothing is enabled."""

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.supervision import Reaction
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import SafetyStop
from canprobe.fieldbus.protocol.cia402 import DriveState, state_of
from canprobe.fieldbus.protocol.frames import NmtState


def press_begun_pressed(**limits):
    """Reason of the stop, and the session: of a press where the object stands 0.3 mm in the way of the arm at rest."""
    scene = canprobe.load_scene("press", {"task.duration_s": 3.0, "cycle.rate_hz": 200.0})
    session = Session(replace(scene, limits=replace(scene.limits, **limits)))
    x, y, z = scene.object.position_mm
    raised = true_object(replace(scene.object, position_mm=(x, y, z + 8.3)))

    plant = session.buses.world.plant
    plant.place(raised)
    with pytest.raises(SafetyStop) as stopped, session:
        session.run(make_task(session.plan))
    return stopped.value.reason, session


def test_no_drive_is_enabled():
    reason, session = press_begun_pressed()
    assert BY_KEY["preload"].reaction is Reaction.STOP and "preload" in session.cell.supervisor.first
    force = float(reason.removeprefix("the array measures ").split(" N before the run")[0])
    assert force == pytest.approx(session.buses.truth["force_n"].max(), rel=0.15) and force > 0.5
    assert "limits.preload_max_n = 0.15" in reason and "free the probe" in reason
    assert np.ptp(session.buses.truth["q_rad"], axis=0).max() == 0.0
    words = session.cell.log.arrays()["statusword"]
    assert {state_of(int(word)) for word in words[np.isfinite(words)]} == {DriveState.SWITCH_ON_DISABLED}
    assert {node.state for node in session.buses.world.nodes} == {NmtState.PRE_OPERATIONAL}


def test_a_larger_limit_lets_an_array_with_offsets_begin():
    reason, session = press_begun_pressed(preload_max_n=3.0)
    assert "before the run" not in reason
    assert np.ptp(session.buses.truth["q_rad"], axis=0).max() > 1e-3, "it began to move"
