"""What `canprobe up` needs beside a session: the first motion of each joint, and what went wrong while it ran."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

from canprobe.cell.controller import Measurement
from canprobe.errors import NodeError, UsageError
from canprobe.planning.make import make_plan
from canprobe.scene.model import Scene
from canprobe.scene.resolve import resolve
from canprobe.session.session import Say, Session, quiet, resolve_scene

if TYPE_CHECKING:
    from canprobe.robot.model import ArmModel
    from canprobe.tasks.untouched import JointFinding, Operator, Vector


# `canprobe up --check-joints`: the first motion of an arm, joint by joint, and the pose that its zeros make.

ROWS_KEPT = 4000


def check_joints(
    scene: Scene,
    *,
    interface: str | None = None,
    channel: str | None = None,
    sensor_channel: str | None = None,
    bitrate: int | None = None,
    operator: Operator | None = None,
    say: Say = quiet,
) -> list[JointFinding]:
    """Bring the cell up, turn each joint by 1 deg at 2 deg/s and back, and stop it safely.

    Args:
        scene: with an arm.
        interface, channel, sensor_channel, bitrate: in the place of the scene's.
        operator: asked before and after each motion; None asks nobody.
        say: called with each step and each finding.

    Returns:
        What was found, a joint each; all of them are well.

    Raises:
        UsageError: the scene does not fit or has no arm.
        NodeError: a joint is not as it must be; it names all of them.
        BusError, SafetyStop: as :func:`canprobe.run`.
    """
    if scene.arm is None:
        raise UsageError(f"up --check-joints: scene {scene.name} has no [arm]")
    from canprobe.cell.assembly import limits_of
    from canprobe.robot.puma import MODELS
    from canprobe.tasks.untouched import JointCheck

    plan = make_plan(
        resolve(
            resolve_scene(scene, interface=interface, channel=channel, sensor_channel=sensor_channel, bitrate=bitrate)
        )
    )
    check = JointCheck(MODELS[scene.arm.model], limits_of(plan), plan.sync.period_ns * 1e-9, operator)
    try:
        with Session(plan.scene, None, say, (), ROWS_KEPT) as session:
            session.run(check)
    finally:
        for finding in check.findings:
            say(str(finding))
        if check.start is not None:
            say(_zero_pose(MODELS[scene.arm.model], check.start))
    wrong = [finding for finding in check.findings if finding.fault is not None]
    if wrong:
        ids = scene.arm.node_ids
        first, *others = [(ids[f.joint], f"(joint {f.joint + 1}) {f.fault}") for f in wrong]
        raise NodeError(first[0], "; ".join([first[1], *(f"node {node_id}: {text}" for node_id, text in others)]))
    return check.findings


def _zero_pose(model: ArmModel, start: Vector) -> str:
    """Where the arm has to be if its zeros are right, for a look at its marks."""
    from canprobe.robot.chain import forward

    angles = ", ".join(f"{joint.shown(q):.2f}" for joint, q in zip(model.joints, start, strict=True))
    x, y, z = forward(model.chain, start)[:3, 3] * 1e3
    return (
        f"by its encoders the arm stands at {angles} deg, its flange at x {x:.1f}, y {y:.1f}, z {z:.1f} mm: compare"
        " that with its marks; where it differs, a zero is wrong"
    )


# What goes wrong in a cell that runs for days, told when it first happens and once more, counted, at the end.


@contextlib.contextmanager
def telling_notes(session: Session, say: Say) -> Iterator[Session]:
    """Open the session; when it is over, tell what went wrong in it and was lived with."""
    try:
        with session:
            yield session
    finally:
        for line in session.cell.faults if session.started else ():
            say(f"noted: {line}")


def news_teller(session: Session, say: Say) -> Callable[[Measurement], None]:
    """A function to be called after each cycle, which tells each kind of note once."""
    notes, told = session.cell.notes, 0

    def tell(_: Measurement) -> None:
        nonlocal told
        if len(notes) > told:
            for line in notes.lines()[told:]:
                say(f"noted: {line}")
            told = len(notes)

    return tell
