"""How the suite is shared between workers (pytest-xdist): a file at a time, and all vcan tests to one worker."""

from __future__ import annotations

import functools
import json
import os
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

_LIST = "canprobe_vcan_tests"
_NICE = 10
_PATH = pytest.StashKey[Path]()


def is_worker(config: pytest.Config) -> bool:
    """Return whether this session is a worker, which runs what another session gives it."""
    return hasattr(config, "workerinput")


def count_workers(config: pytest.Config) -> int:
    """Return one worker a processor; none where a session of its own is quicker, or is what was asked for."""
    processors = len(os.sched_getaffinity(0))
    files_only = all(argument.partition("::")[0].endswith(".py") for argument in config.args)
    by_itself = files_only or config.getoption("capture") == "no" or config.getoption("benchmark_only", False)
    return 0 if by_itself or processors == 1 else processors


def tell_worker(config: pytest.Config, workerinput: dict[str, Any]) -> None:
    """Tell a worker of this session where to list the vcan tests: only who collects tests sees their markers."""
    if _PATH not in config.stash:
        folder = tempfile.TemporaryDirectory(prefix="canprobe-tests-")
        config.add_cleanup(folder.cleanup)
        config.stash[_PATH] = Path(folder.name) / "vcan.json"
    workerinput[_LIST] = str(config.stash[_PATH])


def list_vcan_tests(config: pytest.Config, nodeids: Iterable[str]) -> None:
    """In a worker: write down which tests are vcan tests. Every worker writes the same."""
    if is_worker(config):
        path = Path(config.workerinput[_LIST])
        new = path.with_suffix(f".{os.getpid()}")
        new.write_text(json.dumps(list(nodeids)))
        new.replace(path)


class ByFile(LoadScopeScheduling):
    """A worker takes a file, so that what its tests share is made once; the vcan tests count as one file."""

    @functools.cached_property
    def _vcan_tests(self) -> frozenset[str]:
        return frozenset(json.loads(self.config.stash[_PATH].read_text()))

    def _split_scope(self, nodeid: str) -> str:
        return "vcan" if nodeid in self._vcan_tests else nodeid.partition("::")[0]


def give_way(config: pytest.Config) -> None:
    """Let a worker's processor go first to a guest that keeps the time of a bus: the worker has none to keep."""
    if is_worker(config) and os.nice(0) < _NICE:
        os.nice(_NICE - os.nice(0))
