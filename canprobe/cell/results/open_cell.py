"""A cell for controllers, from its bring-up to its results."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy.typing as npt

from canprobe.cell.master.array import make_patch_reader
from canprobe.cell.master.cell import Cell
from canprobe.cell.master.controller import Command, Controller, Measurement, as_controller
from canprobe.cell.master.log import since_first_sync
from canprobe.cell.master.observers import Observers
from canprobe.cell.master.options import RunOptions, Say
from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.result import RunResult
from canprobe.cell.results.run_data import RunData
from canprobe.cell.results.run_files import LOG, TACTILE
from canprobe.cell.results.scores import methods_table, score_shape
from canprobe.cell.results.summary import summarise, truth_of, without_nan, write_summary, writers_of
from canprobe.cell.rows import ROWS_FOLDER
from canprobe.cell.session.children import Bridges
from canprobe.cell.session.joint_record import warned
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import estimates_of
from canprobe.cell.tasks.shape import ShapeRecord, on_run_clock
from canprobe.cell.tasks.task import USUAL_SPEED, record_of
from canprobe.errors import CanprobeError, ResultsError, UsageError
from canprobe.fieldbus.bus.real.interrupts import interrupts_held, interrupts_repeated
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.master.patch_reader import PatchReader
    from canprobe.cell.tasks.hand_way import HandWay
    from canprobe.mechanics.touch import Patch

MOST_REPLAYED = 40
"""Answers of an estimator that computes after the run. Its scores need no more: in a scan that is long enough for them,
answers that are nearer to each other than a memory rest on the same contacts."""

REPORT = "report.png"
PICTURES = (REPORT, "surface.png")
"""Pictures of a run of at least one cycle."""
READ_S = 0.1
"""Time of cycles until each drive has said where it stands, s."""
READ_IMAGES = 3
"""Longest wait for an image of the array, in their periods."""


class OpenCell:
    """A cell for controllers: its block brings it up at the beginning, and at the end stops it and makes the results.

    One block is one run with one log, one summary and one folder, even if it runs several controllers in turn. The
    summary's contact and shape are those of the controller that ran last.

    Args:
        plan: plan of the scene.
        options: options of the run.
        task: task whose contact and shape the summary has, whatever controllers run.

    Attributes:
        plan: plan of the scene.
        session: the cell with everything round it.
    """

    def __init__(self, plan: Plan, options: RunOptions, *, task: Controller | None = None) -> None:
        self.plan = plan = warned(plan)
        folder = None if options.out is None or options.rows_kept is not None else options.out / ROWS_FOLDER
        self.session = Session(plan, replace(options, rows_folder=folder))
        if task is None and plan.setup.arm is not None and not self.session.virtual:
            # for `move` and `home`: they take longer to load than a node waits for its master's heartbeat
            from canprobe.cell.session import up  # noqa: F401
            from canprobe.cell.tasks import hand_motion  # noqa: F401
        self._out, self._say, self._early_summary = options.out, options.say, options.early_summary
        self._bridges = Bridges(plan, options.out, virtual=self.session.virtual, say=options.say)
        self._task = task
        self._patch_reader: PatchReader | None = make_patch_reader(plan.setup)
        self._last: Controller | None = task
        self._result = RunResult()

    @property
    def cell(self) -> Cell:
        """The master's side of the cell, while the block is open or afterwards."""
        return self.session.cell

    def __enter__(self) -> Self:
        self.session.refuse_reentry()
        self._bridges.__enter__()
        try:
            if self._bridges.observers:
                self.session.observers = Observers((*self.session.options.observers, *self._bridges.observers))
            self.session.__enter__()
        except BaseException as error:
            self._finish(error)
            raise
        return self

    def __exit__(self, _kind: object, error: BaseException | None, _trace: object) -> None:
        failure = error
        try:
            self.session.__exit__()
        except BaseException as late:
            failure = late
            raise
        finally:
            self._finish(failure)

    def patch(self, sample: TactileSample) -> Patch:
        """The contact in a tactile sample: force, N, place on the pad, m, and what makes them doubtful.

        Args:
            sample: sample of a measurement, `measurement.tactile`.

        Raises:
            UsageError: the scene has no array.
        """
        if self._patch_reader is None:
            raise UsageError(f"{self.plan.setup.name}: expected a scene with an array; got one without")
        return self._patch_reader.read(sample)

    def probe(self, q: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Pose of the probe at joint positions, and its Jacobian there.

        Args:
            q: joint positions (n,), rad or m.

        Returns:
            Pose of the probe's centre in the base frame (4, 4), m, whose z axis is the pole; and its Jacobian (6, n):
            velocity (rows 0-2) and angular velocity (3-5) in the base frame, per rate of each joint.

        Raises:
            UsageError: the scene has no arm.
        """
        from canprobe.mechanics.robot.chain import forward_jacobian

        setup = self.plan.setup
        return forward_jacobian(setup.needed_arm().model.chain, q, setup.probe.T_flange_probe)

    def run(
        self,
        controller: Controller | Callable[[Measurement], Command],
        progress: Callable[[Measurement], None] = lambda _: None,
    ) -> RunResult:
        """Run a controller until it is done.

        Args:
            controller: a `Controller`, or a function of the measurement that returns a `Command`.
            progress: called with the measurement of each cycle.

        Returns:
            The result of the whole block, the same from every call; it is complete when the block is left.

        Raises:
            UsageError: when it is no controller, its step returned no command, or the cell was stopped for safety and
                `resume` was not called.
            BusError: when the interface or a node failed.
            SafetyStop: when the cell was stopped for safety, or the controller gave a `stop_reason`.
        """
        runs = as_controller(controller)
        if self._task is None:
            self._last = runs
        self.session.run(runs, progress)
        return self._result

    def read(self) -> Measurement:
        """The state of the cell, with its drives disabled and a new image of the array; nothing moves.

        Raises:
            BusError: the bus fails, or another master has come.
        """
        measurement = self.cell.idle(READ_S)
        array, rate_hz = self.plan.setup.array, self.plan.setup.rate_hz
        left = 0 if array is None else round(READ_IMAGES * rate_hz / array.rate_hz)
        while measurement.tactile is None and left > 0:
            measurement, left = self.cell.idle(1.0 / rate_hz), left - 1
        return measurement

    def way_to(self, to: str | npt.ArrayLike, speed: float = USUAL_SPEED) -> HandWay:
        """The way from where the arm stands to a posture, which was looked at as a whole.

        Args:
            to: name of a posture, or joint positions (n,), rad or m.
            speed: share of the speed limits of the joints.

        Raises:
            UsageError: there is no such posture, or the way leads through a limit or what the arm keeps out of.
        """
        from canprobe.cell.tasks.hand_way import goal_of, joint_way, share_of_speed

        return joint_way(self.plan, self._stands(), goal_of(self.plan, to), share_of_speed(speed)).whole()

    def move(
        self,
        to: str | npt.ArrayLike | HandWay,
        speed: float = USUAL_SPEED,
        *,
        wanted: Callable[[], bool] = lambda: True,
        progress: Callable[[Measurement], None] = lambda _: None,
    ) -> str | None:
        """Move to a posture, straight in joints and as fast as speed, acceleration and jerk allow, or along a way.

        Ctrl-C brakes, then ends. A force from `limits.jog_force_n` on ends the motion, and the probe goes back a few
        millimetres.

        Args:
            to, speed: as for `way_to`; or a way of `way_to` that was not gone yet.
            wanted: asked in each cycle; where it says no, the motion brakes.
            progress: called with the measurement of each cycle.

        Returns:
            Why the motion ended before its end; None where it did not.

        Raises:
            UsageError: as `way_to`; or the cell was stopped for safety and `resume` was not called.
            SafetyStop: the arm has touched something, or the cell was stopped.
            BusError: as in `run`.
        """
        from canprobe.cell.tasks.hand_motion import HandMotion
        from canprobe.cell.tasks.hand_way import HandWay

        way = to if isinstance(to, HandWay) else self.way_to(to, speed)
        motion = HandMotion(self.plan, way, wanted)
        self.run(motion, progress)
        return motion.ended_by

    def jog(
        self,
        joint: int | None = None,
        *,
        velocity: float,
        for_s: float,
        along: npt.ArrayLike | None = None,
        about: npt.ArrayLike | None = None,
        in_probe_frame: bool = False,
        wanted: Callable[[], bool] = lambda: True,
    ) -> str | None:
        """Move one joint, or the probe along or about a direction, for a time.

        In a cell with an array the probe is so slow that it can stop at what it touches.

        Args:
            joint: number of the joint, from 1.
            velocity: of the joint, rad/s or m/s, or of the probe, m/s along or rad/s about.
            for_s: time, s; the motion ends before at a limit of the joint.
            along, about: direction (3,) of the probe instead of a joint, in base.
            in_probe_frame: the direction is in the frame of the probe, whose z points to the object.
            wanted: as for `move`.

        Returns:
            As `move`.

        Raises:
            UsageError: not one of joint, along and about, or as `way_to`.
            SafetyStop, BusError: as `move`.
        """
        from canprobe.cell.tasks.hand_way import Jog, jog_speed, jog_way
        from canprobe.mechanics.touch.checks import checked

        length = float(checked("jog: velocity", velocity, ())) * float(checked("jog: for_s", for_s, ()))
        if velocity == 0.0 or for_s <= 0.0:
            raise UsageError(f"jog: expected a velocity and a time above 0, got {velocity:g} for {for_s:g} s")
        start = self._stands()  # refuses a cell without an arm
        jog = Jog(joint, along, about, in_probe_frame)
        speed = min(1.0, abs(velocity) / jog_speed(self.plan, jog))
        return self.move(jog_way(self.plan, start, jog, length, speed).whole(), wanted=wanted)

    def tare(self) -> None:
        """Take what the array shows for zero: nothing may touch it.

        Raises:
            UsageError: there is no array on a bus, or its file states the unloaded value.
            BusError: it does not answer.
        """
        self.cell.tare()

    def home(self, joints: Sequence[int] | None = None) -> None:
        """Home the joints that have `zero = "homing"`, one after the other; ``open_cell(..., to_home=True)``.

        Args:
            joints: their numbers, from 1; by default all.

        Raises:
            UsageError: one of them is not homed.
            NodeError: a drive did not find its home position; it is stopped and disabled.
        """
        from canprobe.cell.session.up import home_joints

        home_joints(self.plan, self.cell, joints, say=self._say)

    def _stands(self) -> Floats:
        """Joint positions (n,), rad or m."""
        self.plan.setup.needed_arm()
        measurement = self.cell.idle(READ_S)
        assert measurement.q is not None
        return measurement.q

    def resume(self) -> None:
        """A person's word that the arm may move again.

        After a `SafetyStop`, and after any other stop by the supervision, `run` is refused before this was called. In a
        cell that was opened with ``recover=True`` it asks for motion after a loss, from which such a cell comes back.
        A controller that is held goes on in the next cycle. May be called from any thread, an observer, or `progress`.
        Where no controller is held, as after one that the loss has ended, the cell is brought up again for the next.

        Raises:
            UsageError: nothing was stopped, and the cell was not opened with ``recover=True``; or the cell is closed.
            BusError, SafetyStop: the cell cannot be brought up again.
        """
        self.session.resume()

    def open_to_requests(self, task: Controller) -> Controller:
        """The task, which other tools may start, stop and change where the scene allows it."""
        return self._bridges.open_to_requests(task)

    def _finish(self, failure: BaseException | None) -> None:
        """Make the results once the bus is closed, if it was opened, and end the bridges."""
        try:
            if self.session.started:
                self._conclude(failure)
        finally:
            self._bridges.end(None)

    def _conclude(self, failure: BaseException | None) -> None:
        files, cell = self.session.files, self.cell
        with interrupts_held():
            log, tactile = files.keep(LOG, cell.log), files.keep(TACTILE, cell.tactile_log)
            data = self._score(log, tactile, failure)
            self._result.complete(data)
            summary, lines = data.summary, files.unwritten
            if isinstance(failure, CanprobeError):
                failure.summary = summary
            for write in writers_of(data):
                self._write(write)
        if failure is None:
            self._early_summary(summary)
        _estimate_again(self.session, data, self._say)
        summary["bridges"] = self._bridges.end(summary)
        self._write(lambda out: write_summary(summary, out))
        for name in PICTURES if len(data.log["t_s"]) else ():
            if self._out is not None and name in data.plan.outputs:
                self._say(f"draw {name}")
                files.note_unwritten(_draw(data, self._out / name))
        summary["faults"] += [line for line in lines if line not in summary["faults"]]
        if lines and failure is None:
            unwritten = ResultsError("\n".join(lines))
            unwritten.summary = summary
            raise unwritten
        for line in lines:  # the reason of the stop comes first
            if failure is not None and line != str(failure):
                failure.add_note(line)

    def _score(
        self, log: Mapping[str, Floats], tactile: Mapping[str, npt.NDArray[Any]], failure: BaseException | None
    ) -> RunData:
        """The data of the run with the estimator in the loop, scored by the plan that it ran with."""
        record, start_s, setup = record_of(self._last), self.cell.cycles.start_ns * 1e-9, self.plan.setup
        estimates: dict[str, list[ShapeRecord]] = {}
        if record.shape is not None and setup.shape is not None:
            estimates[setup.shape.method] = record.shape.records
        summary = summarise(
            self.session,
            record,
            estimates,
            None if failure is None else _reason(failure),
            log=log,
            bridges=self._bridges.status(),
        )
        return RunData(
            plan=self.plan,
            summary=summary,
            log=log,
            truth=self.session.buses.truth,
            estimates={name: on_run_clock(records, start_s) for name, records in estimates.items()},
            taxels=record.taxels,
            tactile=tactile,
            out=self._out,
            tracker=record.shape,
            start_s=start_s,
        )

    def _write(self, write: Callable[[Path], None]) -> None:
        """Write files into the run's folder; a failure is noted, and raised at the end."""
        if self._out is None:
            return
        try:
            with interrupts_held():
                write(self._out)
        except ResultsError as error:
            if str(error) not in self.session.files.unwritten:  # the summary is written twice
                self.session.files.note_unwritten(str(error))


def _estimate_again(session: Session, data: RunData, say: Say) -> None:
    """Add the answers of the scene's other estimators on the same contacts, and their scores."""
    setup = session.plan.setup
    if setup.shape is None or data.tracker is None:
        return
    for method in setup.shape.also:
        say(f"estimate again with {method}")
        found = estimates_of(setup, data.tracker.records, data.settled, [method], MOST_REPLAYED)
        if truth := truth_of(session):
            times = since_first_sync(data.log["t_s"], session.cell.log.start_s)
            scores = {name: score_shape(records, truth, times) for name, records in found.items()}
            data.summary["shape"]["methods"] |= without_nan(methods_table(scores))
        data.estimates.update({name: on_run_clock(records, data.start_s) for name, records in found.items()})


def _draw(data: RunData, path: Path) -> str | None:
    """Draw one picture; returns why that failed. Whatever a drawing library raises, the results are written."""
    try:
        with interrupts_repeated():
            if path.name == REPORT:
                from canprobe.cell.results.figures import draw_run as draw
            else:
                from canprobe.cell.results.surface_figure import draw_surface as draw
            draw(data, path)
    except (CanprobeError, OSError) as error:
        return str(error)
    except Exception as error:
        return f"{path.name}: cannot be drawn: {type(error).__name__}: {error}"
    return None


def _reason(failure: BaseException) -> str:
    """Why a run ended, in words."""
    if isinstance(failure, KeyboardInterrupt):
        return "interrupted"
    return str(failure) if isinstance(failure, CanprobeError) else f"{type(failure).__name__}: {failure}"
