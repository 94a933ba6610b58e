"""A short run on the lockstep bus before a real one, so that nothing happens for the first time in a 2.5 ms cycle.

The first call of everything is slow: libraries are paged in, tables filled, the interpreter specialises its code.
On one slow processor first cycles took 3 to 10 ms each, and the drives stopped by themselves for want of SYNC.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace

from canprobe.cell.build import make_task
from canprobe.errors import CanprobeError
from canprobe.planning import Plan
from canprobe.scene import Scene
from canprobe.scene_resolve import resolve
from canprobe.session import LOCKSTEP, Session

REHEARSED_S = 0.3
"""Length of the scene's phase in a rehearsal: time for some answers of an estimator."""
CLEARANCE_MM = 0.5
"""The way to the object is the same in every cycle."""
TOUCHES = 2


def rehearse(plan: Plan) -> None:
    """Run the beginning of a plan with every node emulated; what goes wrong in it is of no interest here.

    Args:
        plan: what is about to run on a real bus.
    """
    with (
        contextlib.suppress(CanprobeError),
        Session(replace(plan, setup=resolve(shortened(plan.scene)), choices=())) as session,
    ):
        session.run(make_task(session.plan))


def shortened(scene: Scene) -> Scene:
    """The scene on a lockstep bus that takes no time, with all that its cycles do in as few of them as will do."""
    task = replace(
        scene.task,
        duration_s=min(scene.task.duration_s, REHEARSED_S),
        clearance_mm=min(scene.task.clearance_mm, CLEARANCE_MM),
        touches=min(scene.task.touches, TOUCHES),
    )
    return replace(
        scene,
        bus=replace(scene.bus, interface=LOCKSTEP, timed=False, bit_error_rate=0.0),
        task=task,
        arm=replace(scene.arm, emulated=True) if scene.arm is not None else None,
        sensor=replace(scene.sensor, emulated=True) if scene.sensor is not None else None,
    )
