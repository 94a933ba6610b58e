"""Names of before the wings still work, with a warning that names the new ones."""

import importlib
import subprocess
import sys
import warnings

import pytest

import canprobe
from canprobe.moved import new_name

OLD = (
    *("canprobe.gym.TouchScan", "canprobe.gym.Uniform", "canprobe.gym.Choice", "canprobe.gym.OBJECTS"),
    *("canprobe.tasks.Trajectory", "canprobe.tasks.shape.ShapeRecord", "canprobe.cell.cycle.Observation"),
    *("canprobe.cell.controller.TactileSample", "canprobe.protocol.tactile.TactileFrame"),
    *("canprobe.planning.model.Plan", "canprobe.planning.measured.MeasuredTraffic"),
    *("canprobe.touch.patch.image.Patch", "canprobe.touch.meshing.Feet"),
    *("canprobe.touch.meshing.Mesh", "canprobe.touch.estimate.noise.Prior"),
    *("canprobe.touch.estimate.noise.Correlation", "canprobe.scene.load.load_scene"),
)
"""What the API reference listed, and the scene loader."""


PLACES = {
    "TactileFrame": "canprobe.cell.master.tactile_frame",
    "Observation": "canprobe.cell.master.observers",
    "Prior": "canprobe.mechanics.touch.estimate.prior",
}
"""Where a name is whose module was taken apart."""


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    """Old names are imported anew."""
    for name in [name for name in sys.modules if new_name(name) is not None]:
        monkeypatch.delitem(sys.modules, name)
    yield
    for name in [name for name in sys.modules if new_name(name) is not None]:
        del sys.modules[name]
    for room in ("gym", "tasks", "planning", "protocol", "touch", "scene", "examples"):
        vars(canprobe).pop(room, None)


@pytest.mark.parametrize("name", OLD)
def test_an_old_name_is_the_same_thing(name):
    module, _, attribute = name.rpartition(".")
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        old = getattr(importlib.import_module(module), attribute)
    assert f"{module} is now {new_name(module)}" in [str(one.message) for one in told]
    new = getattr(importlib.import_module(PLACES.get(attribute, new_name(module))), attribute)
    assert old is new


def test_a_module_is_loaded_once_under_both_names():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        old = importlib.import_module("canprobe.tasks.trajectory")
    assert old is importlib.import_module("canprobe.cell.tasks.trajectory")


def test_the_warning_points_at_the_line_that_imports(tmp_path):
    (tmp_path / "script.py").write_text("import canprobe.gym\ncanprobe.gym.TouchScan\n")
    done = subprocess.run(
        [sys.executable, "-W", "error::DeprecationWarning", str(tmp_path / "script.py")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert 'script.py", line 1' in done.stderr and "canprobe.gym is now canprobe.lab.gym" in done.stderr


def test_an_example_runs_under_its_old_name(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "canprobe.examples.learn_touch_scan", "--help"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0 and "usage" in done.stdout


def test_what_never_was_is_no_module():
    with pytest.raises(ModuleNotFoundError, match=r"canprobe\.nothing"):
        importlib.import_module("canprobe.nothing")
    with warnings.catch_warnings(), pytest.raises(ModuleNotFoundError, match="nothing"):
        warnings.simplefilter("ignore")
        importlib.import_module("canprobe.touch.nothing")
