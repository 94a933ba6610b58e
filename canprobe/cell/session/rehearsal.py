"""The scene of a short run on a lockstep bus before a real one, so that no real cycle makes a first call.

A first call is slow: libraries are paged in, tables filled, the interpreter specialises its code. On a slow processor
first cycles took 3 to 10 ms each, and the drives stopped by themselves because SYNCs were missing.
"""

from __future__ import annotations

from dataclasses import replace

from canprobe.cell.scene.model import Scene
from canprobe.cell.session.target import LOCKSTEP

REHEARSED_S = 0.3
"""Length of the scene's phase in a rehearsal, s: an estimator answers several times in it."""
CLEARANCE_MM = 0.5
"""Longest way to the object, mm: its cycles are all alike."""
MAX_TOUCHES = 2


def shortened(scene: Scene) -> Scene:
    """The scene on a lockstep bus without bit times, with all parts of its cycles in as few cycles as possible."""
    task = replace(
        scene.task,
        duration_s=min(scene.task.duration_s, REHEARSED_S),
        clearance_mm=min(scene.task.clearance_mm, CLEARANCE_MM),
        touches=min(scene.task.touches, MAX_TOUCHES),
    )
    return replace(
        scene,
        bus=replace(scene.bus, interface=LOCKSTEP, timed=False, bit_error_rate=0.0),
        task=task,
        arm=replace(scene.arm, emulated=True) if scene.arm is not None else None,
        joints={name: replace(joint, emulated=None) for name, joint in scene.joints.items()},
        sensor=replace(scene.sensor, emulated=True) if scene.sensor is not None else None,
    )
