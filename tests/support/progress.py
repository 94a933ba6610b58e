"""How far a run of tests has come, and the time that is left, at the end of each line of dots."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

import pytest
import sharing

_BAR = 10
_LONGER = len(f" [{'#' * _BAR}]  00:00 left") + 1


class Progress:
    """Weighs the tests that are done against those that are to come: some folders take long, a test.

    Args:
        reporter: pytest's terminal reporter; its percentage gives way.
        tests: gives the node ids of all tests, once they are known.
    """

    def __init__(self, reporter: pytest.TerminalReporter, tests: Callable[[], Iterable[str]]) -> None:
        self._tests, self._total, self._done = tests, 0.0, 0.0
        self._start_s = time.monotonic()
        if hasattr(reporter, "_get_progress_information_message"):  # private: another pytest shows what it shows
            reporter._get_progress_information_message = self.message  # type: ignore[method-assign]
            reporter._screen_width -= _LONGER - len(" [100%]")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            self._done += sharing.weight(report.nodeid)

    def message(self) -> str:
        """A bar, and the time that the rest takes at the pace until now."""
        self._total = self._total or sum(map(sharing.weight, self._tests()))
        share = min(self._done / self._total, 1.0) if self._total else 1.0
        bar = f" [{'#' * round(share * _BAR):.<{_BAR}}]"
        if not share:
            return bar
        minutes, seconds = divmod(round((time.monotonic() - self._start_s) * (1 - share) / share), 60)
        return f"{bar} {minutes:3d}:{seconds:02d} left"
