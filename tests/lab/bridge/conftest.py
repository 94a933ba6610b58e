"""Plans whose frames the bridges describe, and short recorded runs that their tests share."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.master.observers import Observation
from canprobe.cell.results.result import RunResult
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.lab.bridge.pipe import pack_observation, unpack_observation
from canprobe.lab.bridge.process import BridgeProcess
from canprobe.lab.bridge.sampling import SampleSource


@dataclass(frozen=True)
class Recorded:
    """A run with the bridge `mcap`, and what an observer saw of it."""

    folder: Path
    result: RunResult
    observations: list[Observation]

    @property
    def first_ns(self) -> int:
        """Deadline of the first SYNC, as in bus.log."""
        return next(o.t_ns for o in self.observations if o.measurement is not None)

    def log(self, column: str) -> np.ndarray:
        return self.result.log[column]


@pytest.fixture(scope="session")
def recorded(tmp_path_factory) -> Recorded:
    folder = tmp_path_factory.mktemp("recorded")
    text = dump_scene(canprobe.load_scene("cylinder")).replace('also = ["ml", "chen1996"]', "also = []")
    seen: list[Observation] = []
    result = undrawn_run(
        parse_scene(text), out=folder, duration_s=0.6, seed=5, bridge=("mcap",), observers=(seen.append,)
    )
    return Recorded(folder, result, seen)


@pytest.fixture(scope="session")
def samples(recorded):
    """What a bridge's process makes of the observations of that run."""
    source = SampleSource(recorded.result.plan)
    return [source.sample(unpack_observation(pack_observation(o))) for o in recorded.observations]


@pytest.fixture
def bridge_of():
    """A function that starts the process of a bridge, which is killed at the end of the test."""
    with ExitStack() as stack:

        def start(name, plan, out=None, *, virtual=True):
            bridge = BridgeProcess(name, plan, out, virtual=virtual)
            stack.callback(bridge.kill)
            return bridge

        yield start


@pytest.fixture(scope="session")
def press_plan():
    return canprobe.plan(canprobe.load_scene("press"))


@pytest.fixture(scope="session")
def free_run(tmp_path_factory):
    """Folder of 0.3 s of `free` on the lockstep bus, and its result."""
    return _run("free", tmp_path_factory)


@pytest.fixture(scope="session")
def listen_run(tmp_path_factory):
    """Folder of 0.3 s of `listen` on the lockstep bus, and its result."""
    return _run("listen", tmp_path_factory)


def _run(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp(scene)
    return folder, undrawn_run(canprobe.load_scene(scene), out=folder, duration_s=0.3)
