"""The bridges of a run: they start before its bus is opened, get its cycles, and end after its summary.

Nothing of `canprobe.lab.bridge` is imported unless a bridge is asked for, and then by name.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from canprobe.cell.master.controller import Controller
from canprobe.cell.planning.bridges import check_bridges
from canprobe.cell.planning.model import Plan
from canprobe.cell.tasks.free_and_listen import HoldTask


class Bridges:
    """All bridges that a scene asks for. A context manager: leaving ends those that still run.

    Args:
        plan: plan of the run.
        out: folder of the run; None where no files are written.
        virtual: whether the run is in virtual time.
        say: called with the address of each bridge.

    Attributes:
        observers: one observer of the cell for each bridge.
    """

    def __init__(
        self, plan: Plan, out: Path | None, *, virtual: bool, say: Callable[[str], None] = lambda _: None
    ) -> None:
        self.observers: list[Any] = []
        self._plan = plan
        self._out = out
        self._virtual = virtual
        self._say = say
        self._names = plan.scene.bridge.use if plan.scene.bridge is not None else ()

    def __enter__(self) -> Bridges:
        """Start every bridge.

        Raises:
            UsageError: when a bridge is not installed or cannot start; then no bridge runs.
        """
        if not self._names:
            return self
        check_bridges(self._names)
        start = importlib.import_module("canprobe.lab.bridge.process").BridgeProcess
        try:
            for name in self._names:
                self.observers.append(start(name, self._plan, self._out, virtual=self._virtual))
            for bridge in self.observers:
                self._say(f"bridge {bridge.name}: {bridge.await_ready()}")
        except BaseException:
            for bridge in self.observers:
                bridge.kill()
            self.observers = []
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.end(None)

    def open_to_requests(self, task: Controller | None, make: Callable[[], Controller] | None = None) -> Controller:
        """The task, which other tools may start, stop and change where the scene allows it.

        Args:
            task: the task; None holds the arm still.
            make: makes a new task at every start; None where the task runs once, from the beginning.
        """
        settings = self._plan.scene.bridge
        if settings is None or not settings.ros2_commands or not self.observers:
            return task if task is not None else HoldTask()
        from canprobe.cell.tasks.requested import RequestedTask

        requests = tuple(bridge.requests for bridge in self.observers)
        return RequestedTask(task, make, requests, self._plan.sync.period_ns * 1e-9, self._plan)

    def status(self) -> dict[str, dict[str, Any]] | None:
        """Entry of each bridge in the summary; None without bridges."""
        return {bridge.name: bridge.status() for bridge in self.observers} or None

    def end(self, summary: dict[str, Any] | None) -> dict[str, dict[str, Any]] | None:
        """Hand the summary to every bridge, and end them. Twice is allowed.

        Returns:
            Their final status, as `status`.
        """
        bridges, self.observers = self.observers, []
        text = None if summary is None else json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n"
        statuses: dict[str, dict[str, Any]] = {}
        try:
            while bridges:
                bridge = bridges.pop(0)
                statuses[bridge.name] = bridge.end(text)
        finally:
            for bridge in bridges:  # an interrupt has cut the end of one short
                bridge.kill()
        return statuses or None
