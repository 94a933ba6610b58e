"""How the suite is shared between workers (pytest-xdist): a file at a time, long ones first; all vcan tests to one."""

from __future__ import annotations

import functools
import json
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadScopeScheduling

_LIST = "canprobe_vcan_tests"
_NICE = 10
_PATH = pytest.StashKey[Path]()
_TESTS = pytest.StashKey[Sequence[str]]()
WEIGHTS = {
    "tests/vcan/": 2.0,
    "tests/lab/gym/": 0.8,
    "tests/cell/recorded/": 0.7,
    "tests/cell/integration/": 0.4,
    "tests/lab/": 0.2,
    "tests/cell/results/": 0.2,
    "tests/cell/planning/": 0.14,
    "tests/cell/session/": 0.14,
    "tests/cli/": 0.14,
    "tests/fieldbus/conformance/": 0.14,
    "tests/": 0.04,
}
"""Seconds that a test of a folder takes, about; the first prefix holds."""


TOGETHER = ("tests/lab/bridge/",)
"""Folders whose files share what takes long to make."""


def weight(nodeid: str) -> float:
    """How long a test takes, about."""
    return next((weight for prefix, weight in WEIGHTS.items() if nodeid.startswith(prefix)), 1.0)


def list_tests(config: pytest.Config, nodeids: Sequence[str]) -> None:
    """Keep the tests of this session."""
    config.stash[_TESTS] = nodeids


def all_tests(config: pytest.Config) -> Sequence[str]:
    """All tests of this session and of its workers."""
    return config.stash.get(_TESTS, ())


def longest_first(config: pytest.Config, items: list[pytest.Item]) -> None:
    """In a worker: the files that take longest at first, or one of them would be waited for at the end."""
    if is_worker(config):
        scopes = {item.nodeid: _scope(item.nodeid) for item in items}
        long_s: defaultdict[str, float] = defaultdict(float)
        for nodeid, scope in scopes.items():
            long_s[scope] += weight(nodeid)
        items.sort(key=lambda item: (-long_s[scope := scopes[item.nodeid]], scope, item.nodeid.partition("::")[0]))


def _scope(nodeid: str) -> str:
    return next((folder for folder in TOGETHER if nodeid.startswith(folder)), nodeid.partition("::")[0])


def is_worker(config: pytest.Config) -> bool:
    """Return whether this session is a worker, which runs what another session gives it."""
    return hasattr(config, "workerinput")


def count_workers(config: pytest.Config) -> int:
    """Return one worker a processor, and one for the tests that wait for the time of a bus; none where a session of
    its own is quicker, or is what was asked for."""
    processors = len(os.sched_getaffinity(0))
    files_only = all(argument.partition("::")[0].endswith(".py") for argument in config.args)
    by_itself = files_only or config.getoption("capture") == "no" or config.getoption("benchmark_only", False)
    return 0 if by_itself or processors == 1 else processors + 1


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
    """A worker takes a file, so that what its tests share is made once; the vcan tests count as one file.

    A folder whose files share runs is taken whole.
    """

    def schedule(self) -> None:
        super().schedule()
        list_tests(self.config, self.collection or ())

    @functools.cached_property
    def _vcan_tests(self) -> frozenset[str]:
        return frozenset(json.loads(self.config.stash[_PATH].read_text()))

    def _split_scope(self, nodeid: str) -> str:
        return "vcan" if nodeid in self._vcan_tests else _scope(nodeid)


def give_way(config: pytest.Config) -> None:
    """Let a worker's processor go first to a guest that keeps the time of a bus: the worker has none to keep."""
    if is_worker(config) and os.nice(0) < _NICE:
        os.nice(_NICE - os.nice(0))
