"""`canprobe home`: the drives without absolute encoders find their zeros, joint by joint."""

from __future__ import annotations

from collections.abc import Sequence
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
    from canprobe.cell.master.cell import Cell
    from canprobe.cell.planning.model import Plan
    from canprobe.cell.tasks.joint_finding import Operator


def home(
    scene: Scene, joints: Sequence[int] | None = None, *, operator: Operator | None = None, say: Say = quiet
) -> None:
    """Bring the cell up, home joints that have `zero = "homing"` one after the other, and stop it safely.

    Args:
        scene: a scene with an arm.
        joints: their numbers, from 1; by default all.
        operator: asked before each joint; None leaves the questions out.
        say: called with each step, and with the result of each joint.

    Raises:
        UsageError: when the scene does not fit, or one of the joints is not homed.
        NodeError: when a drive did not find its home position; it is stopped and disabled.
        BusError, SafetyStop: as in :func:`canprobe.run`.
    """
    plan = make_plan(resolve(scene))
    homed_of(plan, joints)
    with Session(plan, RunOptions(say=say, rows_kept=ROWS_OF_UP, to_home=True)) as session:
        home_joints(plan, session.cell, joints, operator, say)


def homed_of(plan: Plan, joints: Sequence[int] | None) -> list[int]:
    """Indices of the joints that are to be homed, from 0, in the order of homing.

    Raises:
        UsageError: one of them, or all where none is given, has an absolute encoder or does not exist.
    """
    arm = plan.setup.arm
    homed = [i for i, drive in enumerate(arm.drives) if drive.zero] if arm is not None else []
    wanted = homed if joints is None else [joint - 1 for joint in joints]
    if not wanted or (others := set(wanted) - set(homed)):
        which = "no joint" if joints is None else f"joint {min(others) + 1}"
        known = f"; {', '.join(str(i + 1) for i in homed)} have" if homed else ""
        raise UsageError(f'home: {which} of {plan.setup.name} has zero = "homing"{known}')
    return wanted


def home_joints(
    plan: Plan, cell: Cell, joints: Sequence[int] | None = None, operator: Operator | None = None, say: Say = quiet
) -> None:
    """Home joints in a cell that is up; see `home`."""
    homing, wanted = cell.homing, homed_of(plan, joints)
    assert homing is not None
    for axis in homing.order:
        if axis not in wanted:
            continue
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
