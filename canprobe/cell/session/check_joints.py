"""`canprobe up --check-joints`: the first motion of an arm, joint by joint, and the pose that its zeros make."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from canprobe.cell.master.options import RunOptions, Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.joint_record import JointRecord
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import ROWS_OF_UP
from canprobe.cell.tasks.joint_check import JointCheck
from canprobe.errors import NodeError, ResultsError, UsageError
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.tasks.joint_finding import JointFinding, Operator
    from canprobe.mechanics.robot.model import ArmModel


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
    assert plan.setup.arm is not None
    arm, check, record = plan.setup.arm, JointCheck(plan, operator), JointRecord(plan)
    serials: dict[int, int] = {}
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
