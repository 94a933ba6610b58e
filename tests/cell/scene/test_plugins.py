"""What other packages offer by entry points: the package of docs/own-package.md, built; broken ones, equal names."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import canprobe
from canprobe.cell.scene.load import load_array, load_scene, packaged_files
from canprobe.cell.scene.plugins import find_plugin, plugins
from canprobe.cli import main
from canprobe.errors import SceneError, UsageError

ROOT = Path(__file__).resolve().parents[3]
PAGE = (ROOT / "docs" / "own-package.md").read_text(encoding="utf-8")
EXAMPLE = dict(re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```$', PAGE, re.S | re.M))
QUICK = {"task.clearance_mm": 0.2, "shape.also": []}
FREE = '[scene]\nname = "lab-free"\ntitle = "As free"\n[task]\nkind = "free"\n[arm]\n'


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Puts a package with entry points on the path, as pip does."""

    def install(package, points, files=()):
        site = tmp_path / f"site-{package}"
        info = site / f"{package.replace('-', '_')}-1.0.dist-info"
        info.mkdir(parents=True)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        lines = [f"[canprobe.{group}]\n{name} = {value}" for group, name, value in points]
        (info / "entry_points.txt").write_text("\n".join(lines))
        for name, text in dict(files).items():
            (site / name).parent.mkdir(parents=True, exist_ok=True)
            (site / name).write_text(text)
        monkeypatch.syspath_prepend(site)

    yield install
    for name, module in list(sys.modules.items()):
        if any(
            str(place).startswith(str(tmp_path))
            for place in getattr(module, "__path__", [getattr(module, "__file__", None)])
        ):
            del sys.modules[name]


@pytest.mark.slow(reason="pip builds a package")
def test_the_package_of_the_page_is_built_and_used_by_name(tmp_path, monkeypatch, capsys):
    assert sum(len(text.splitlines()) for text in EXAMPLE.values()) <= 30
    for name, text in EXAMPLE.items():
        (tmp_path / "src" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / name).write_text(text)
    pip = [sys.executable, "-m", "pip", "-q", "install", "--no-deps"]  # it makes an environment to build in
    subprocess.run([*pip, "--target", tmp_path / "site", tmp_path / "src"], check=True, capture_output=True)
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.chdir(tmp_path)

    assert main(["cells"]) == 0
    assert re.search(
        r"lab-bench +The array of the lab on its bench +of the package lab-canprobe", capsys.readouterr().out
    )
    assert main(["scenes", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert {"kind": "estimator", "name": "lab-fit", "package": "lab-canprobe"} in listed
    assert "lab_canprobe" not in sys.modules, "read lazily"

    assert load_scene("listen", {"cell": "lab-bench"}).cell.title == "The array of the lab on its bench"
    overrides = {
        "shape.method": "lab-fit",
        "shape.also": ["recursive", "lab-canprobe:lab-fit"],
        "outputs.figures": False,
    }
    result = canprobe.run("sphere", overrides, bus="direct", duration_s=1.0, out=tmp_path / "run")
    shape = result.summary["shape"]
    assert shape["method"] == "lab-fit"
    assert shape["kappa_est_per_m"] == pytest.approx([20.0, 20.0], rel=0.2)
    assert shape["methods"]["lab-canprobe:lab-fit"]["kappa_rms_error_per_m"] < 5.0
    assert main(["replay", "run", "--method", "lab-fit"]) == 0
    assert result.score("lab-fit")["lab-fit"]["estimates"] > 0


def test_scenes_and_arrays_with_their_files(install, tmp_path):
    array = packaged_files("arrays")["uskin4x4"].read_text()
    files = {"lab/__init__.py": "", "lab/rooms/lab-free.toml": FREE, "lab/lab-pad.toml": array}
    install("lab", [("scenes", "lab-free", "lab.rooms"), ("arrays", "lab-pad", "lab")], files)
    assert load_scene("lab-free").scene.title == "As free"
    assert load_array("lab-pad") == load_array("uskin4x4")
    with pytest.raises(SceneError, match=r"did you mean lab-free\?; scenes: .*, lab-free"):
        load_scene("lab-fre")
    scene = load_scene("listen", {"sensor.array": "lab-pad"})
    assert scene.sensor.array == str(tmp_path / "site-lab" / "lab" / "lab-pad.toml"), "a saved scene takes it along"


@pytest.mark.parametrize(
    ("value", "files", "why"),
    [
        ("lab.rooms", {"lab/__init__.py": "import nowhere_at_all"}, "No module named 'nowhere_at_all'"),
        ("lab.rooms", {"lab/__init__.py": "1 / 0"}, "ZeroDivisionError: division by zero"),
        ("lab", {"lab/__init__.py": ""}, "there is no file lab-arm.toml in"),
        ("lab", {}, "lab is no package; expected the package of this file in its entry point"),
        ("lab", {"lab/__init__.py": "", "lab/lab-arm.toml": "[cell"}, "not valid TOML"),
        ("lab:arm", {"lab/__init__.py": ""}, "lab:arm is no package"),
    ],
)
def test_a_broken_package_is_named_in_a_line_and_stops_no_other(install, capsys, value, files, why):
    install("broken-lab", [("cells", "lab-arm", value)], files)
    install(
        "good", [("cells", "good-arm", "good")], {"good/good-arm.toml": "[cell]\nname = 'good'\ntitle = 'Good arm'"}
    )
    assert main(["cells"]) == 0
    shown = capsys.readouterr()
    assert "Good arm" in shown.out and "puma260" in shown.out
    assert [line for line in shown.err.splitlines() if "broken-lab" in line and why in line] == shown.err.splitlines()
    assert main(["plan", "free", "--cell", "lab-arm"]) == 2
    err = capsys.readouterr().err
    assert why in err and "Traceback" not in err
    assert load_scene("free").cell.name == "puma260"


def test_a_name_of_two_packages_is_refused_with_what_to_type(install, capsys):
    for package in ("lab-a", "lab-b"):
        files = {f"{package[-1]}/lab-arm.toml": f"[cell]\nname = 'lab-arm'\ntitle = 'Of {package}'"}
        points = [("cells", "lab-arm", package[-1]), ("estimators", "mine", f"{package[-1]}:Mine")]
        install(package, points, files)
    with pytest.raises(
        SceneError, match="packages lab-a and lab-b each offer a cell of this name; type lab-a:lab-arm or"
    ):
        load_scene("listen", {"cell": "lab-arm"})
    assert load_scene("listen", {"cell": "lab-b:lab-arm"}).cell.title == "Of lab-b"
    with pytest.raises(SceneError, match="each offer an estimator of this name; type lab-a:mine or lab-b:mine"):
        load_scene("sphere", {"shape.method": "mine"})
    assert main(["cells"]) == 0
    out = capsys.readouterr().out
    assert "lab-a:lab-arm" in out and "lab-b:lab-arm" in out


def test_a_name_of_canprobe_stays_its_own(install, capsys):
    points = [("cells", "puma260", "lab"), ("estimators", "ml", "lab:Mine")]
    install("lab", points, {"lab/puma260.toml": "[cell]\nname = 'other'\ntitle = 'Another one'"})
    assert load_scene("free").cell.name == load_scene("free", {"cell": "canprobe:puma260"}).cell.name == "puma260"
    assert load_scene("listen", {"cell": "lab:puma260"}).cell.title == "Another one"
    assert main(["cells"]) == 0
    assert re.search(r"lab:puma260 +Another one +of the package lab", capsys.readouterr().out)
    overrides = {"shape.method": "ml", "shape.also": []}
    assert canprobe.run("sphere", overrides | QUICK, bus="direct", duration_s=0.1, files=False).summary["completed"]


MINE = """class Mine:
    def __init__(self, **_): ...
    def add(self, sample): {add}
    def {estimate}(self): return {answer}
"""


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("raise OSError('no licence')", "cannot be imported: OSError: no licence"),
        ("class Mine:\n    pass", "TypeError: Mine() takes no arguments"),
        (MINE.format(add="...", estimate="answer", answer="None"), "has no attribute 'estimate'"),
        (MINE.format(add="1 / 0", estimate="estimate", answer="None"), "ZeroDivisionError"),
        (MINE.format(add="...", estimate="estimate", answer="3"), "expected a SurfaceEstimate or None from estimate()"),
    ],
)
def test_a_broken_estimator_is_named(install, code, why):
    install("lab", [("estimators", "lab-fit", "lab_fits:Mine")], {"lab_fits.py": code})
    with pytest.raises(UsageError, match="estimator lab-fit of the package lab: ") as error:
        canprobe.run("sphere", {"shape.method": "lab-fit"} | QUICK, bus="direct", duration_s=0.5, files=False)
    assert why in str(error.value)


def test_an_unknown_method_has_the_words_that_it_could_be():
    with pytest.raises(
        SceneError, match=r'expected one of recursive, ml, .* or text that another package offers, got "m1"'
    ):
        load_scene("sphere", {"shape.method": "m1"})
    assert find_plugin("cell", "nothing") is None and plugins("calibration") == []
