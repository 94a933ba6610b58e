"""What the caller of a run sets beside its scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canprobe.cell.master.observers import AnyObserver

if TYPE_CHECKING:
    from canprobe.cell.master.external_arm import ExternalArm

Say = Callable[[str], None]
"""Called with a line of text for each step."""


def quiet(_: str) -> None:
    """Report nothing."""


def unread(_: Mapping[str, Any]) -> None:
    """Read no summary."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Options of one run, made once by its caller; every layer below takes the same object.

    Attributes:
        out: folder of the files; None writes none.
        say: called with each step.
        observers: called after each cycle with its measurement, command and frames.
        rows_kept: cycles whose row of the log is kept, and no truth; None for all.
        early_summary: called with the summary of a completed run as soon as it holds the estimator in the loop: before
            others estimate again, and before pictures are drawn.
        to_home: the drives are about to be homed; else bring-up refuses one that is not.
        to_check: the link is about to be checked: nodes are not reset, nothing is enabled, and what bring-up changes in
            them is put back at the end.
        recover: a cell that has lost a node or its bus comes back; see `canprobe.cell.session.recovery`.
        rows_folder: folder of the rows while the run goes on, whose caller makes files of them at its end; None keeps
            them in memory.
        bus: a bus of python-can that its caller has opened, in the place of the scene's interface; it stays open.
        arm: external arm in the place of the scene's.
    """

    out: Path | None = None
    say: Say = quiet
    observers: Sequence[AnyObserver] = ()
    rows_kept: int | None = None
    early_summary: Callable[[Mapping[str, Any]], None] = unread
    to_home: bool = False
    recover: bool = False
    to_check: bool = False
    rows_folder: Path | None = None
    bus: Any = None
    arm: ExternalArm | None = None


DEFAULT_OPTIONS = RunOptions()
