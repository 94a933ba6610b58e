"""Which tests run which lines of some modules: recorded once, so that a change of a line need meet only those."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any

import pytest


class Reach:
    """Which tests run which lines of some modules, and how long each test takes; a plugin of pytest.

    Args:
        modules: paths in the repository by the modules' names.

    Attributes:
        seconds: processor time of each test, with the recording; infinite where it did not pass.
        tests: tests by line, as ``module:line``.
    """

    def __init__(self, modules: Mapping[str, str]) -> None:
        self._paths = modules
        self.seconds: dict[str, float] = {}
        self.tests: dict[str, list[str]] = {}
        self._lines: set[tuple[str, int]] = set()
        self._module_of: dict[str, str | None] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Record the lines of a test."""
        self._lines, start = set(), time.process_time()
        sys.settrace(self._trace)
        try:
            return (yield)
        finally:
            sys.settrace(None)
            self.seconds.setdefault(item.nodeid, time.process_time() - start)
            for module, line in self._lines:
                self.tests.setdefault(f"{module}:{line}", []).append(item.nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Leave out a test that did not pass."""
        if not report.passed:
            self.seconds[report.nodeid] = math.inf

    def pytest_sessionfinish(self) -> None:
        """Write the record."""
        Path("reach.json").write_text(json.dumps({"seconds": self.seconds, "tests": self.tests}), encoding="utf-8")

    def _trace(self, frame: FrameType, event: str, argument: object) -> Any:
        name = frame.f_code.co_filename
        if name not in self._module_of:
            self._module_of[name] = next((m for m, path in self._paths.items() if name.endswith(f"/{path}")), None)
        if (module := self._module_of[name]) is None:
            return None
        self._lines.add((module, frame.f_lineno))
        return self._trace
