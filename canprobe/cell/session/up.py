"""`canprobe up`: a cell that is held and supervised for days, or whose joints are checked one after the other."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from canprobe.cell.master.controller import Measurement
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.children import Bridges
from canprobe.cell.session.session import Say, Session, quiet, with_bridges
from canprobe.cell.session.target import need_real_bus
from canprobe.cell.tasks.free_and_listen import Answer
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import NodeError, UsageError

if TYPE_CHECKING:
    from canprobe.cell.tasks.free_and_listen import JointFinding, Operator, Vector
    from canprobe.mechanics.robot.model import ArmModel

ROWS_OF_UP = 4000
"""Cycles whose rows are kept: `up` runs for days."""


def up(scene: Scene, *, bridge: Sequence[str] = (), say: Say = quiet) -> None:
    """Bring the cell up, hold and supervise it until it is interrupted, then stop it safely.

    Args:
        scene: on a bus that other processes can reach.
        bridge: names of bridges to other tools, besides those of the scene.
        say: called with each step, and with each kind of fault when it is new and once more, counted, at the end.

    Raises:
        UsageError: the scene does not fit or is on a lockstep bus.
        BusError, SafetyStop: as :func:`canprobe.run`.
    """
    need_real_bus(scene, "up")
    plan = make_plan(resolve(with_bridges(scene, bridge)))
    with Bridges(plan, None, virtual=False, say=say) as bridges:
        session = Session(plan, None, say, bridges.observers, ROWS_OF_UP)
        with reporting_notes(session, say) as report_news:
            say(f"the cell is up: nodes {', '.join(map(str, plan.node_ids))}; Ctrl-C stops it")
            session.run(bridges.open_to_requests(None, lambda: make_task(plan)), report_news)


@contextlib.contextmanager
def reporting_notes(session: Session, say: Say) -> Iterator[Callable[[Measurement], None]]:
    """Open the session; at its end report the faults that did not stop it, each kind with its number.

    Yields:
        A function to be called after each cycle, which reports each kind when it is new.
    """
    said = 0

    def report_news(_: Measurement) -> None:
        nonlocal said
        notes = session.cell.notes
        if len(notes) > said:
            for line in notes.lines()[said:]:
                say(f"noted: {line}")
            said = len(notes)

    try:
        with session:
            yield report_news
    finally:
        for line in session.cell.faults if session.started else ():
            say(f"noted: {line}")


# `canprobe up --home`: the drives without absolute encoders find their zeros, joint by joint.


def home(scene: Scene, *, operator: Operator | None = None, say: Say = quiet) -> None:
    """Bring the cell up, home the joints that have `zero = "homing"` one after the other, and stop it safely.

    Args:
        scene: with an arm.
        operator: asked before each joint; None leaves the questions out.
        say: called with each step, and with what became of each joint.

    Raises:
        UsageError: the scene does not fit, or no joint of it is homed.
        NodeError: a drive did not find its home position; it is stopped and disabled.
        BusError, SafetyStop: as :func:`canprobe.run`.
    """
    plan = make_plan(resolve(scene))
    if plan.setup.arm is None or not any(drive.zero for drive in plan.setup.arm.drives):
        raise UsageError(f'up --home: no joint of scene {scene.name} has zero = "homing"')
    with Session(plan, None, say, (), ROWS_OF_UP, to_home=True) as session:
        homing = session.cell.homing
        assert homing is not None
        for axis in homing.order:
            answer = Answer.YES
            if operator is None:
                say(homing.question(axis).removesuffix("?"))
            else:
                operator.ask(homing.question(axis))
                while (given := operator.answer()) is None:
                    homing.keep_alive()
                answer = given
            if answer is Answer.QUIT:
                return
            say(homing.home(axis) if answer is Answer.YES else f"joint {axis + 1} is left as it is")


# `canprobe up --check-joints`: the first motion of an arm, joint by joint, and the pose that its zeros make.


def check_joints(scene: Scene, *, operator: Operator | None = None, say: Say = quiet) -> list[JointFinding]:
    """Bring the cell up, move each joint by 1 deg at 2 deg/s (3.5 mm at 7 mm/s) and back, and stop it safely.

    Args:
        scene: with an arm.
        operator: asked before and after each motion; None leaves the questions out.
        say: called with each step and each finding.

    Returns:
        One finding for each joint, all without a fault.

    Raises:
        UsageError: the scene does not fit or has no arm.
        NodeError: a joint has a fault; it names all of them.
        BusError, SafetyStop: as :func:`canprobe.run`.
    """
    if scene.arm is None:
        raise UsageError(f"up --check-joints: scene {scene.name} has no [arm]")
    from canprobe.cell.tasks.free_and_listen import JointCheck

    plan = make_plan(resolve(scene))
    assert plan.setup.arm is not None
    arm, check = plan.setup.arm, JointCheck(plan, operator)
    try:
        with Session(plan, None, say, (), ROWS_OF_UP) as session:
            session.run(check)
    finally:
        for finding in check.findings:
            say(str(finding))
        if check.start is not None:
            say(_zero_pose(arm.model, check.start))
    wrong = [finding for finding in check.findings if finding.fault is not None]
    if wrong:
        ids = arm.node_ids
        first, *others = [(ids[f.joint], f"(joint {f.joint + 1}) {f.fault}") for f in wrong]
        raise NodeError(first[0], "; ".join([first[1], *(f"node {node_id}: {text}" for node_id, text in others)]))
    return check.findings


def _zero_pose(model: ArmModel, start: Vector) -> str:
    """Where the arm has to be if its zeros are right, for a look at its marks."""
    from canprobe.mechanics.robot.chain import forward

    units = [joint.unit for joint in model.joints]
    each = [f"{joint.shown(q):.2f}" for joint, q in zip(model.joints, start, strict=True)]
    positions = f"{', '.join(each)} {units[0]}"
    if len(set(units)) > 1:
        positions = ", ".join(map(" ".join, zip(each, units, strict=True)))
    x, y, z = forward(model.chain, start)[:3, 3] * 1e3
    return (
        f"by its encoders the arm stands at {positions}, its flange at x {x:.1f}, y {y:.1f}, z {z:.1f} mm: compare"
        " that with its marks; where it differs, a zero is wrong"
    )
