"""A short run on the lockstep bus before a real one, so that nothing happens for the first time in a 2.5 ms cycle.

The first call of everything is slow: libraries are paged in, tables filled, the interpreter specialises its code.
On one slow processor first cycles took 3 to 10 ms each, and the drives stopped by themselves for want of SYNC.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace

from canprobe.cell.build import make_task
from canprobe.errors import CanprobeError
from canprobe.scene import Scene
from canprobe.session import LOCKSTEP, Session

REHEARSED_S = 0.6
"""Length of the scene's phase in a rehearsal."""


def rehearse(scene: Scene) -> None:
    """Run the scene's beginning with every node emulated; what goes wrong in it is of no interest here.

    Args:
        scene: the scene that is about to run on a real bus.
    """
    rehearsed = replace(
        scene,
        bus=replace(scene.bus, interface=LOCKSTEP),
        task=replace(scene.task, duration_s=min(scene.task.duration_s, REHEARSED_S)),
        arm=replace(scene.arm, emulated=True) if scene.arm is not None else None,
        sensor=replace(scene.sensor, emulated=True) if scene.sensor is not None else None,
    )
    with contextlib.suppress(CanprobeError), Session(rehearsed) as session:
        session.run(make_task(session.plan))
