"""`canprobe up`, `canprobe home`: a cell that holds its position, or whose joints are checked or homed one by one."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence

from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Measurement
from canprobe.cell.master.options import RunOptions, Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.children import Bridges
from canprobe.cell.session.joint_record import JointRecord, warned
from canprobe.cell.session.session import Session, with_bridges
from canprobe.cell.session.target import refuse_virtual
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.joint_check import Answer, JointCheck, JointFinding, Operator, SeenWay
from canprobe.errors import NodeError, ResultsError, UsageError
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.types import Floats

ROWS_OF_UP = 4000
"""Number of cycles whose rows are kept: `up` runs for days."""
EARLY_CYCLES = 25
"""Cycles after a return in which nobody lets motion go on: a key that is read then was pressed before it."""


def up(
    scene: Scene,
    *,
    bridge: Sequence[str] = (),
    say: Say = quiet,
    recover: bool = False,
    asked: Callable[[], bool] = lambda: False,
) -> None:
    """Bring the cell up, hold and supervise it until it is interrupted, then stop it safely.

    Args:
        scene: a scene on a bus that other processes can reach.
        bridge: names of bridges to other tools, besides those of the scene.
        say: called with each step, with each new kind of fault, and at the end with the number of each.
        recover: come back after a node or the bus was lost; see `canprobe.cell.session.recovery`.
        asked: called in each cycle; after a loss, True lets motion go on, but not in the first `EARLY_CYCLES`.

    Raises:
        UsageError: when the scene does not fit or is on a lockstep bus.
        BusError, SafetyStop: as in :func:`canprobe.run`.
    """
    refuse_virtual(scene.bus.interface, "up")
    plan = warned(make_plan(resolve(with_bridges(scene, bridge))))
    with Bridges(plan, None, virtual=False, say=say) as bridges:
        session = Session(plan, RunOptions(None, say, bridges.observers, ROWS_OF_UP, recover=recover))
        with reporting_notes(session, say) as report_news:
            resume = "; after a loss, r and Enter let motion go on" if recover else ""
            say(f"the cell is up: nodes {', '.join(map(str, plan.node_ids))}; Ctrl-C stops it{resume}")

            cell, age = session.cell, EARLY_CYCLES

            def after_cycle(measurement: Measurement) -> None:
                nonlocal cell, age
                report_news(measurement)
                age = age + 1 if session.cell is cell else 0
                cell = session.cell
                if asked() and age >= EARLY_CYCLES:
                    session.resume()

            task = bridges.open_to_requests(None, lambda: make_task(plan))
            session.run(task, after_cycle if recover else report_news)


@contextlib.contextmanager
def reporting_notes(session: Session, say: Say) -> Iterator[Callable[[Measurement], None]]:
    """Open the session, and at its end report the faults that did not stop it, each kind with its number.

    Yields:
        A function to call after each cycle; it reports each new kind of fault.
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
        for line in session.cell.notes.lines() if session.started else ():
            say(f"noted: {line}")


def check_joints(scene: Scene, *, operator: Operator | None = None, say: Say = quiet) -> list[JointFinding]:
    """Bring the cell up, move each joint by 1 deg and by 10 deg (3.5 and 35 mm) and back, and stop it safely.

    What the operator has seen of real drives is recorded; see `canprobe.cell.session.joint_record`.

    Args:
        scene: a scene with an arm; of one with an array, what presses on it stops the check.
        operator: asked before and after each motion; None leaves the questions out, and the larger motion.
        say: called with each step and each finding.

    Returns:
        One finding for each joint, all without a fault.

    Raises:
        UsageError: when the scene does not fit or has no arm.
        NodeError: when a joint has a fault; the message names all of them.
        BusError, SafetyStop: as in :func:`canprobe.run`.
    """
    if scene.arm is None:
        raise UsageError(f"up --check-joints: scene {scene.name} has no [arm]")
    plan = make_plan(resolve(scene))
    arm, check, record = plan.setup.needed_arm(), JointCheck(plan, operator), JointRecord(plan)
    serials: dict[int, int] = {}
    say(arm.left_alone)
    try:
        with Session(plan, RunOptions(say=say, rows_kept=ROWS_OF_UP)) as session:
            serials = session.cell.bring_up.serial_numbers(record.node_ids)
            session.run(check)
    finally:
        for finding in check.findings:
            say(str(finding))
        if check.start is not None:
            say(_zero_pose(arm.model, check.start))
        if record.path is not None:
            _keep(record, check.findings, serials, say)
    wrong = [finding for finding in check.findings if finding.fault is not None]
    if wrong:
        ids = arm.node_ids
        first, *others = [(ids[f.joint], f"(joint {f.joint + 1}) {f.fault}") for f in wrong]
        raise NodeError(first[0], "; ".join([first[1], *(f"node {node_id}: {text}" for node_id, text in others)]))
    return check.findings


def _keep(record: JointRecord, findings: Sequence[JointFinding], serials: Mapping[int, int], say: Say) -> None:
    """Record what was seen, and report it; a record that cannot be written only leaves the warnings of later runs."""
    try:
        for finding in findings:
            record.put(finding, serials)
    except ResultsError as error:
        say(f"warning: {error}")
    seen = [str(finding.joint + 1) for finding in findings if finding.seen and finding.fault is None]
    which = f"joint{'s' * (len(seen) > 1)} {', '.join(seen)}"
    say(f"recorded in {record.path}: {which}" if seen else "no joint is recorded: nobody has seen a larger way")


def _zero_pose(model: ArmModel, start: Floats) -> str:
    """Pose of the arm if its zeros are right, to compare with the marks on it."""
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
    say(plan.setup.needed_arm().left_alone)
    with Session(plan, RunOptions(say=say, rows_kept=ROWS_OF_UP, to_home=True)) as session:
        home_joints(plan, session.cell, joints, operator, say)


def homed_of(plan: Plan, joints: Sequence[int] | None) -> list[int]:
    """Indices of the joints that are to be homed, from 0, in the order of homing.

    Raises:
        UsageError: one of them, or all where none is given, has an absolute encoder or does not exist.
    """
    homed = [i for i, drive in enumerate(plan.setup.drives) if drive.zero]
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
