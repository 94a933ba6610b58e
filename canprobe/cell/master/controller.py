"""The input and the output of a controller in a cycle: `Measurement` and `Command`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from canprobe.cell.master.tactile_frame import TactileSample
from canprobe.errors import UsageError
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.master.patch_reader import PatchReader
    from canprobe.cell.master.trail import TakenWay
    from canprobe.mechanics.touch import SurfaceEstimate


@dataclass(frozen=True, slots=True)
class Measurement:
    """The state of the cell at one SYNC.

    Attributes:
        cycle: number of the cycle, from 0.
        t_ns: time of its SYNC, ns since the first one.
        q: joint positions at this SYNC (n,), rad or m; None in a scene without an arm.
        q_age: cycles since the last position report of each joint (n,); 0 everywhere when all TPDOs came.
        torque_permille: motor torque as reported (n,), NaN for a drive that does not report it; empty where none does.
        statuswords: CiA 402 statuswords (n,).
        enabled: every drive is in operation enabled.
        tactile: a tactile sample that became usable in this cycle, else None. A frame triggered at SYNC k comes in
            cycle k + 1 at the earliest, on every bus.
        tactile_age: cycles since the trigger of the newest tactile sample, or since the first SYNC where none has come;
            None without a sensor.
        carrier: position of the object's carrier at this SYNC, rad or m; None without one or its report.
    """

    cycle: int
    t_ns: int
    q: Floats | None = None
    q_age: tuple[int, ...] = ()
    torque_permille: tuple[float, ...] = ()
    statuswords: tuple[int, ...] = ()
    enabled: bool = False
    tactile: TactileSample | None = None
    tactile_age: int | None = None
    carrier: float | None = None


@dataclass(frozen=True, slots=True)
class Command:
    """The command of a controller for one cycle.

    Attributes:
        q_target: joint positions to reach two cycles later (n,), rad or m; None leaves the drives where they are.
        done: the controller has finished; the cell is stopped in an orderly way.
        stop_reason: set to stop the cell for safety, with the reason.
        columns: named numbers for the log; a controller uses the same names in every cycle.
        estimate: a new answer of its surface estimator, for observers; None in cycles without one.
    """

    q_target: Floats | None = None
    done: bool = False
    stop_reason: str | None = None
    columns: dict[str, float | Floats] = field(default_factory=dict)
    estimate: SurfaceEstimate | None = None


OWN_COLUMNS = frozenset(
    {"t_s", "q_rad", "q_m", "statusword", "torque_permille", "q_target_rad", "q_target_m", "carrier_rad", "carrier_m"}
)
"""Columns of the cell in the log; a controller's `Command.columns` have other names."""


def check_command(command: Command, *, arm: bool) -> None:
    """Check what a controller returned, but for the joint target of an arm: the supervision checks that.

    Args:
        command: command of this cycle.
        arm: the scene has one.

    Raises:
        UsageError: it is no command, a field of it has the wrong type, or a column has a name of the cell's.
    """
    if not isinstance(command, Command):
        raise UsageError(f"controller: expected its step to return a Command, got {command!r}")
    if not isinstance(command.done, bool | np.bool_):
        raise UsageError(f"controller: expected done to be True or False, got {command.done!r}")
    if command.stop_reason is not None and not (isinstance(command.stop_reason, str) and command.stop_reason.strip()):
        raise UsageError(f"controller: expected stop_reason to be a text or None, got {command.stop_reason!r}")
    if not isinstance(command.columns, dict):
        raise UsageError(f"controller: expected columns to be a dict of numbers by name, got {command.columns!r}")
    try:  # at once for all names: this is done in every cycle
        printable = "".join(command.columns).isprintable() and "" not in command.columns
    except TypeError:
        printable = False
    if not printable:
        raise UsageError(f"controller: expected the names of columns to be printable texts, got {[*command.columns]}")
    if command.q_target is not None and not arm:
        raise UsageError(f"controller: expected no q_target in a scene without an arm, got {command.q_target!r}")
    if command.estimate is not None:
        from canprobe.mechanics.touch import SurfaceEstimate

        if not isinstance(command.estimate, SurfaceEstimate):
            raise UsageError(f"controller: expected estimate to be a SurfaceEstimate, got {command.estimate!r}")
    if not OWN_COLUMNS.isdisjoint(command.columns):
        taken = ", ".join(sorted(OWN_COLUMNS.intersection(command.columns)))
        raise UsageError(f"controller: expected other columns than the cell's, got {taken}")


class Controller:
    """Base of everything that a cell can run: `step` decides a cycle, the other methods do nothing by default.

    Attributes:
        retreats_itself: True: the controller supervises its contact and takes the probe off the object when
            `retreat` is called. False, the default: the cell does both.
        resumable: True: after the cell has come back from a loss (``recover`` of `canprobe.open_cell`) the controller
            goes on from where the arm stands, once motion is asked for. False, the default: a loss ends it.
        compares_motion: True: the controller itself compares the motion of the joints with what it has asked for, and
            names what is wrong; False, the default: the cell does.
        array_alive: whether an image of the array has changed since bring-up; the cell sets it before each step.
        array_blind: why the controller does not believe the array any more; None while it does.
        remarks: what the controller has found to be wrong with the cell, a line each; more come, and none goes.
        reader: the reader of its tactile samples, which the supervision uses too; None: the cell has its own.
        restarts: how often the estimator of this controller diverged and started again.
    """

    retreats_itself: bool = False
    resumable: bool = False
    compares_motion: bool = False
    array_alive: bool = False
    array_blind: str | None = None
    remarks: Sequence[str] = ()
    reader: PatchReader | None = None
    restarts: int = 0

    def step(self, measurement: Measurement) -> Command:
        """Decide one cycle. Called when its TPDOs are in; the command is sent at once.

        Args:
            measurement: the state of the cell at the SYNC of this cycle.

        Returns:
            The joint targets of this cycle, or the end of the run.
        """
        raise NotImplementedError(f"{type(self).__name__} has no step(measurement)")

    def inspect(self, q: Floats) -> str | None:
        """Check the joint positions before the drives are enabled.

        Args:
            q: (n,) positions, rad or m.

        Returns:
            Why the drives must not be enabled here; None where they may.
        """
        return None

    def update(self) -> None:
        """Do work that the next step needs. Called once a cycle, after the commands of the cycle were sent."""

    def retreat(self, reason: str) -> None:
        """Take the probe off the object in the next steps, then end with this reason.

        Called once, and only where `retreats_itself` is True and the condition leaves time for it.

        Args:
            reason: reason for `Command.stop_reason`.
        """

    def brake(self, interrupt: KeyboardInterrupt) -> bool:
        """Come to rest, then raise the interrupt in a step; False: the cell stops at once.

        Args:
            interrupt: Ctrl-C, or a signal that ends the process. A second one stops the cell in any case.
        """
        return False

    def asks_to_go_on(self) -> bool:
        """Whether motion is asked for in a way that the controller knows. Called in each cycle of a hold."""
        return False

    def go_on(self, measurement: Measurement) -> None:
        """Prepare to go on after a loss, from where the arm stands. Called before the first step after it.

        Args:
            measurement: the state of the cell, whose time has gone on meanwhile.
        """

    @property
    def trail(self) -> TakenWay | None:
        """The way by which the probe has come, where a lift-off may go back on it; None: it goes along the pole."""
        return None


def _of_inner(name: str) -> Any:
    """An attribute that is the inner controller's; without one it is the default, and what is set is dropped."""

    def read(wrapping: WrappingController) -> Any:
        return getattr(Controller if wrapping.inner is None else wrapping.inner, name)

    def write(wrapping: WrappingController, value: object) -> None:
        if wrapping.inner is not None:
            setattr(wrapping.inner, name, value)

    return property(read, write)


class WrappingController(Controller):
    """Base of controllers that step another one: what the cell tells it of the array, and asks of it, passes through.

    Attributes:
        inner: the controller that is stepped; None while there is none.
    """

    inner: Controller | None = None
    retreats_itself: bool = _of_inner("retreats_itself")
    array_alive: bool = _of_inner("array_alive")
    array_blind: str | None = _of_inner("array_blind")
    reader: PatchReader | None = _of_inner("reader")
    remarks: Sequence[str] = _of_inner("remarks")
    restarts: int = _of_inner("restarts")

    def retreat(self, reason: str) -> None:
        if self.inner is not None:
            self.inner.retreat(reason)


class _Function(Controller):
    """A plain function as a controller."""

    def __init__(self, step: Callable[[Measurement], Command]) -> None:
        self._step = step

    def step(self, measurement: Measurement) -> Command:
        return self._step(measurement)


def as_controller(controller: object) -> Controller:
    """The controller, or a controller made of a function.

    Raises:
        UsageError: it is neither a controller nor a function.
    """
    if isinstance(controller, Controller):
        return controller
    if callable(controller) and not isinstance(controller, type):
        return _Function(controller)
    raise UsageError(
        f"controller: expected a function of the measurement or a canprobe.Controller, got {controller!r}; derive its"
        " class: class Mine(canprobe.Controller)"
    )
