"""Judge a test in real time only where the machine kept the time of an idle loop beside it.

A host that serves others may take the processor away for longer than a node waits for its master's heartbeat (250 ms).
The nodes stop, as they must, and a test of something else fails. Such a test runs again once the machine goes on
evenly, and the summary tells it. Where the loop slipped a second time nothing is known: in CI that is a failure, and
elsewhere the test is skipped, which the summary tells, too.
"""

from __future__ import annotations

import os
import threading
import time
from types import TracebackType

import patience
import pytest
from _pytest.runner import runtestprotocol

ATTEMPTS = 2
LIMIT_S = 0.12
"""Half of the nodes' patience: no process of a test, waiting for its turn on one processor, waits as long."""
CALM_S, PATIENCE_S = 2.0, 30.0
"""Time without a standstill before a test is repeated, and how long that is waited for."""
NAME = "repeated after a standstill of the machine"
NOT_JUDGED = "in real time, and not judged"


class Watch:
    """While it is open: the longest time by which a thread that only sleeps woke up too late.

    Attributes:
        late_s: that time.
    """

    _PERIOD_S = 0.02

    def __init__(self) -> None:
        self.late_s = 0.0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def _look(self) -> None:
        before = time.monotonic()
        while not self._done.wait(self._PERIOD_S):
            now = time.monotonic()
            self.late_s = max(self.late_s, now - before - self._PERIOD_S)
            before = now

    def __enter__(self) -> Watch:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._done.set()
        self._thread.join()


def run_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> list[pytest.TestReport]:
    """Run one test, again where the machine stood still in a failure; return the reports of the last attempt."""
    stood: list[float] = []
    while True:
        with Watch() as watch:
            reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if watch.late_s <= LIMIT_S or len(stood) == ATTEMPTS - 1 or not any(report.failed for report in reports):
            break
        stood.append(round(watch.late_s, 3))
        item.session._setupstate.teardown_exact(None)  # nothing that stood still is used again
        _wait_for_calm()
        patience.set_timer_again(item)
    if watch.late_s > LIMIT_S and "CI" not in os.environ:
        for report in reports:
            if report.failed:
                path, line, _ = item.location
                why = f"the machine stood still for {watch.late_s:.2f} s, after it did so for {stood[0]:.2f} s"
                report.outcome, report.longrepr = "skipped", (path, (line or 0) + 1, f"Skipped: {NOT_JUDGED}: {why}")
    for report in reports:
        report.user_properties += [(NAME, late_s) for late_s in stood]
    return reports


def _wait_for_calm() -> None:
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        with Watch() as watch:
            time.sleep(CALM_S)
        if watch.late_s <= LIMIT_S:
            return


def tell(stats: dict[str, list[pytest.TestReport]]) -> list[str]:
    """Return a line for each test that was repeated, and for each that was not judged."""
    every = [report for reports in stats.values() for report in reports if isinstance(report, pytest.TestReport)]
    ended = {report.nodeid: dict(report.user_properties) for report in every if report.when == "call"}
    told = [f"{nodeid}: {NAME} of {found[NAME]:.2f} s" for nodeid, found in ended.items() if NAME in found]
    unjudged = [report for report in every if report.skipped and NOT_JUDGED in str(report.longrepr)]
    return told + [f"{report.nodeid}: {report.longrepr[2].removeprefix('Skipped: ')}" for report in unjudged]
