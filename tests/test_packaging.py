"""What a wheel takes along (`.ci/run` installs one and runs a scene with it), and how an extra is installed."""

import fnmatch
import importlib.metadata
import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from canprobe.errors import install_line

ROOT = Path(__file__).resolve().parent.parent


def test_every_file_of_the_package_is_packaged():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    patterns = project["tool"]["setuptools"]["package-data"]["canprobe"]
    package = ROOT / "canprobe"
    files = [
        Path(folder, name).relative_to(package).as_posix()
        for folder, _, names in os.walk(package, followlinks=True)
        for name in names
        if "__pycache__" not in folder and not name.endswith(".py")
    ]
    assert "fieldbus/eds/puma260_joint.eds" in files, "links are followed"
    assert [file for file in files if not any(fnmatch.fnmatch(file, pattern) for pattern in patterns)] == []


# What to type for an extra that is missing.


@pytest.mark.parametrize(
    ("origin", "line"),
    [
        ({}, "pip install 'canprobe[view]'"),
        ({"url": "file:///home/me/my%20cell", "dir_info": {}}, "pip install '/home/me/my cell[view]'"),
        ({"url": "file:///src", "dir_info": {"editable": True}}, "pip install -e '/src[view]'"),
        ({"url": "file:///a.whl", "archive_info": {}}, "pip install 'canprobe[view] @ file:///a.whl'"),
        (
            {"url": "https://host/canprobe", "vcs_info": {"vcs": "git"}},
            "pip install 'canprobe[view] @ git+https://host/canprobe'",
        ),
    ],
)
def test_the_line_that_installs_an_extra_is_for_where_canprobe_came_from(origin, line, monkeypatch, tmp_path):
    class Installed:
        def read_text(self, _):
            return json.dumps(origin)

    monkeypatch.setattr(importlib.metadata, "distribution", lambda _: Installed())
    assert install_line("view") == line
    (tmp_path / "pipx_metadata.json").touch()
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert install_line("view") == line.replace("pip", "pipx runpip canprobe", 1)
    monkeypatch.setattr(sys, "prefix", "/home/me/.cache/uv/archive-v0/5bAs")
    assert install_line("view") == line.replace("pip", "uv tool", 1)


def test_a_package_that_a_command_misses_is_told_with_that_line(tmp_path):
    script = "import sys; sys.modules['matplotlib'] = None; from canprobe.cli import main; sys.exit(main(sys.argv[1:]))"
    words = ("study", "estimators", "--quick", "--out", str(tmp_path / "out"))
    done = subprocess.run([sys.executable, "-c", script, *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("canprobe: study: needs matplotlib; type: ") and "[study]" in done.stderr
    assert done.stderr.count("\n") == 1
