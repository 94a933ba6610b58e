"""One episode: a cell whose probe is in contact, led step by step, with the region that it touches and its reward."""

from __future__ import annotations

import gc
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.api import OpenCell
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.model import Plan
from canprobe.cell.session.session import Session
from canprobe.errors import BusError, SafetyStop
from canprobe.lab.gym.led import LedTask
from canprobe.mechanics.types import Floats

FORCE_SHARE = 0.5
"""Share of the wanted force by which an action moves the set-point up or down."""
TOLERANCE = 0.05
"""Error over the wanted force at which a touch counts exp(−½) of one without error."""
PENALTY_MM2 = 20.0
"""Cost of an episode that the supervision ends: the area of a few steps, mm²."""
CELL_M = 0.5e-3
"""Side of a cell of the grid, m."""
TOUCH_RADIUS_M = 1.5e-3
"""Radius round a contact within which the surface counts as touched, m: a third of the patch at 2 N on a plane."""
SECTORS = 8
"""Number of directions in which an agent sees the untouched part."""
SIGHT_RADIUS_M = 6e-3
"""Radius within which it sees, m."""


class Coverage:
    """A grid over the scan plane: a rectangle round the first contact, and the cells that were touched.

    Args:
        length, width: sides of the rectangle along the heading and across it, m.
    """

    def __init__(self, length: float, width: float) -> None:
        self._half = np.array((length, width)) / 2
        self._shape = math.ceil(length / CELL_M), math.ceil(width / CELL_M)
        # A border as wide as the sight, which counts as touched: nothing outside of the rectangle is worth a touch.
        reach = round(SIGHT_RADIUS_M / CELL_M)
        self._touched = np.pad(np.zeros(self._shape, dtype=bool), reach, constant_values=True)
        self._side = 2 * reach + 1
        i, j = np.indices((self._side, self._side)) - reach
        away = CELL_M * np.hypot(i, j)
        self._brush, self._sight = away <= TOUCH_RADIUS_M, (away > TOUCH_RADIUS_M) & (away <= SIGHT_RADIUS_M)
        angle = np.arctan2(j, i)[self._sight]
        self._sector = np.rint(angle * (SECTORS / (2 * math.pi))).astype(int) % SECTORS
        self._in_sector = np.bincount(self._sector, minlength=SECTORS)
        self._cells = 0

    @property
    def area(self) -> float:
        """Touched area so far, m²."""
        return self._cells * CELL_M**2

    @property
    def share(self) -> float:
        """Touched share of the rectangle so far."""
        return self._cells / (self._shape[0] * self._shape[1])

    def touch(self, place: Floats) -> float:
        """Touch the surface at a place (2,) along the heading and across it, m; returns the new area, m²."""
        window = self._window(place)
        if window is None:
            return 0.0
        new = int(np.count_nonzero(self._brush & ~window))
        window |= self._brush
        self._cells += new
        return new * CELL_M**2

    def left(self, place: Floats) -> Floats:
        """Untouched share within sight of a place (2,), m, by direction (`SECTORS`,).

        The first is round the heading; the others follow towards the side across.
        """
        window = self._window(place)
        if window is None:
            return np.zeros(SECTORS)
        left: Floats = np.bincount(self._sector, weights=~window[self._sight], minlength=SECTORS) / self._in_sector
        return left

    def _window(self, place: Floats) -> NDArray[np.bool_] | None:
        """The part of the grid within sight of a place, as a view; None outside of the rectangle."""
        i, j = np.floor((place + self._half) / CELL_M).astype(int).tolist()
        if not (0 <= i < self._shape[0] and 0 <= j < self._shape[1]):
            return None
        return self._touched[i : i + self._side, j : j + self._side]


class Episode:
    """Brings a cell up and touches the object; then `step` leads the probe.

    Args:
        plan: plan of a scan in virtual time.
        cycles: number of cycles in a step.
        record: folder for the files of the run; None writes nothing.

    Attributes:
        session: the open cell.
        task: task that the cell runs.
        origin: first contact (3,), base frame, m.
        coverage: touched part of the region.
        forces: measured force in each cycle of the last step, N.
        truth: true state of the plant after the last step.
        over: whether the episode has ended; `reason` says why, None where the time is over.

    Raises:
        SafetyStop, BusError: when nothing was touched; the cell is closed.
    """

    def __init__(self, plan: Plan, cycles: int, record: Path | None) -> None:
        task = self.task = LedTask(plan)
        self._cycles, self._period_s = cycles, plan.sync.period_ns * 1e-9
        self._opened = (
            OpenCell(plan, RunOptions(record), task=task) if record else Session(plan, RunOptions(rows_kept=1))
        )
        self.session = self._opened.session if isinstance(self._opened, OpenCell) else self._opened
        collecting = gc.isenabled()
        self._opened.__enter__()
        if collecting:
            gc.enable()  # a session pauses the collection, which a learner in this process may need
        try:
            self.session.cell.start(task)
            while not task.touching and not task.ended:
                self.session.cell.advance(1)
            if task.reason is not None:
                raise SafetyStop(task.reason)
        except BaseException:
            self.close()
            raise
        scan = plan.scene.task
        self.origin = task.last_contact.p_base
        self.coverage = Coverage(1e-3 * scan.length_mm, 1e-3 * scan.width_mm)
        self.coverage.touch(np.zeros(2))
        self.forces = [task.force]
        self.truth = self.session.buses.world.plant.truth()
        self.over = False
        self.reason: str | None = None
        self.well_mm2 = 0.0
        self._steps, self._most_steps = 0, max(1, round(scan.duration_s / (cycles * self._period_s)))

    def step(self, action: Floats) -> float:
        """Lead the probe by an action (3,) in [−1, 1] for one step; returns the reward, mm²."""
        task, forces = self.task, []
        velocity = action[:2] * task.top_speed / max(1.0, math.hypot(*action[:2]))
        task.lead(velocity, task.wanted_force * (1.0 + FORCE_SHARE * float(action[2])), self._cycles)
        try:
            self.session.cell.advance(self._cycles, lambda _: forces.append(task.force))
        except (SafetyStop, BusError) as error:
            self.reason = str(error)
        if task.ended and self.reason is None:
            self.reason = task.reason
        self._steps += 1
        self.over = self.reason is not None or self._steps == self._most_steps
        self.forces = forces or [task.force]
        self.truth = self.session.buses.world.plant.truth()
        place = task.axes[:2] @ (task.last_contact.p_base - self.origin)
        new_mm2 = 1e6 * self.coverage.touch(place) if task.touching else 0.0
        well_mm2 = new_mm2 * math.exp(-0.5 * (self._force_error() / (TOLERANCE * task.wanted_force)) ** 2)
        self.well_mm2 += well_mm2
        return well_mm2 - PENALTY_MM2 * (self.reason is not None)

    def _force_error(self) -> float:
        return float(self.truth["force"]) - self.task.wanted_force

    def info(self) -> dict[str, Any]:
        """The truth, with units; `reason` where the supervision has ended the episode."""
        truth = self.truth
        told = {
            "t_s": self._steps * self._cycles * self._period_s,
            "force_n": float(truth["force"]),
            "force_error_n": self._force_error(),
            "contact_mm": 1e3 * truth["contact_point"],
            "normal": truth["contact_normal"],
            "kappa_per_m": truth["kappa"],
            "touched_mm2": 1e6 * self.coverage.area,
            "touched_well_mm2": self.well_mm2,
        }
        return told if self.reason is None else told | {"reason": self.reason}

    def close(self) -> None:
        """Disable the drives and end the cell."""
        self._opened.__exit__(None, None, None)
