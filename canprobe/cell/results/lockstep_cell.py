"""Runs of one cell in virtual time with faults, for tests of controllers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Command, Controller, Measurement
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.results.result import RunResult
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.target import LOCKSTEP
from canprobe.cell.tasks.from_plan import make_task
from canprobe.fieldbus.tools.faults import Fault
from canprobe.fieldbus.tools.faults.injection import PlannedFaults


class LockstepCell:
    """Runs of one cell in virtual time, each from bring-up to safe stop.

    Args:
        scene: packaged name or path of the scene.
        seed: seed of the emulation.
        folder: folder for the files of the runs.
        faults: faults of the test.

    Attributes:
        folder: folder of the run that is the last so far; its ``bus.log`` has the frames.
    """

    def __init__(self, scene: str | Path, seed: int, folder: Path, faults: PlannedFaults) -> None:
        self.folder = folder
        self._scene, self._seed, self._place, self._faults = scene, seed, folder, faults
        self._runs = 0

    def plan(self, overrides: Mapping[str, Any] | None = None) -> Plan:
        """The plan of a run, without running it; arguments and errors are those of `canprobe.plan`."""
        own = {"scene.seed": self._seed, "outputs.figures": False, "bus.interface": LOCKSTEP}
        return make_plan(resolve(load_scene(self._scene, {**own, **(overrides or {})})))

    def run(
        self,
        controller: Controller | Callable[[Measurement], Command] | None = None,
        overrides: Mapping[str, Any] | None = None,
    ) -> RunResult:
        """Bring the cell up, run a controller until it is done, and stop the cell.

        Args:
            controller: a controller, or a function of the measurement; None: the task of the scene.
            overrides: values that replace the scene's, such as ``{"task.force_n": 3}``.

        Returns:
            The complete result.

        Raises:
            CanprobeError: as for `canprobe.run`; ``error.summary`` is the summary.
        """
        plan = self.plan(overrides)
        self.folder = self._place / f"run{self._runs}"
        self._runs += 1
        cell = OpenCell(plan, RunOptions(self.folder))
        faulty = cell.session.buses.world.make_faulty()

        def throw(text: str) -> Fault:
            bus = cell.session.buses.lockstep
            return faulty.inject(text, 0 if bus is None else bus.clock.now_ns())

        self._faults.attach(throw, faulty.end, faulty.nodes)
        try:
            with cell:
                return cell.run(make_task(plan) if controller is None else controller)
        finally:
            self._faults.detach()
