"""Plans whose frames the bridges describe, and one short recorded run."""

import pytest

import canprobe
from canprobe.planning import make_plan


@pytest.fixture(scope="session")
def press_plan():
    return make_plan(canprobe.load_scene("press"))


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
    return folder, canprobe.run(canprobe.load_scene(scene), out=folder, duration_s=0.3)
