"""How the suite is shared between workers (pytest-xdist): a file at a time, and all vcan tests to one worker."""

from __future__ import annotations

import os

import pytest
from xdist.scheduler import LoadGroupScheduling


def is_worker(config: pytest.Config) -> bool:
    """Return whether this session is a worker, which runs what another session gives it."""
    return hasattr(config, "workerinput")


def count_workers(config: pytest.Config) -> int:
    """Return one worker a processor; none where a session of its own is quicker, or is what was asked for."""
    processors = len(os.sched_getaffinity(0))
    files_only = all(argument.partition("::")[0].endswith(".py") for argument in config.args)
    by_itself = files_only or config.getoption("capture") == "no" or config.getoption("benchmark_only", False)
    return 0 if by_itself or processors == 1 else processors


def without_group(nodeid: str) -> str:
    """Return a test's name without the group that pytest-xdist has written behind it."""
    return nodeid.removesuffix("@vcan")


class ByFile(LoadGroupScheduling):
    """A worker takes a group, or a file, so that fixtures of a file are made once."""

    def _split_scope(self, nodeid: str) -> str:
        return super()._split_scope(nodeid).partition("::")[0]
