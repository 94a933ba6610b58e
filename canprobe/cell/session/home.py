"""`canprobe up --home`: the drives without absolute encoders find their zeros, joint by joint."""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.cell.master.options import RunOptions, Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import ROWS_OF_UP
from canprobe.cell.tasks.joint_finding import Answer, SeenWay
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.cell.tasks.joint_finding import Operator


def home(scene: Scene, *, operator: Operator | None = None, say: Say = quiet) -> None:
    """Bring the cell up, home the joints that have `zero = "homing"` one after the other, and stop it safely.

    Args:
        scene: a scene with an arm.
        operator: asked before each joint; None leaves the questions out.
        say: called with each step, and with the result of each joint.

    Raises:
        UsageError: when the scene does not fit, or none of its joints is homed.
        NodeError: when a drive did not find its home position; it is stopped and disabled.
        BusError, SafetyStop: as in :func:`canprobe.run`.
    """
    plan = make_plan(resolve(scene))
    if plan.setup.arm is None or not any(drive.zero for drive in plan.setup.arm.drives):
        raise UsageError(f'up --home: no joint of scene {scene.name} has zero = "homing"')
    with Session(plan, RunOptions(say=say, rows_kept=ROWS_OF_UP, to_home=True)) as session:
        homing = session.cell.homing
        assert homing is not None
        for axis in homing.order:
            answer: Answer | SeenWay | None = Answer.YES
            if operator is None:
                say(homing.question(axis).removesuffix("?"))
            else:
                operator.ask(homing.question(axis))
                while (answer := operator.answer()) is None:
                    homing.link.keep_alive()
            if answer is Answer.QUIT:
                return
            say(homing.home(axis) if answer is Answer.YES else f"joint {axis + 1} is left as it is")
