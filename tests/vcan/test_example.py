"""The project of docs/example, by the steps of its own CI file: a device in C, a master in Python."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from canprobe.fieldbus.bus.real.socketcan import has_socketcan
from canprobe.fieldbus.vcan.guest import missing_packages

ROOT = Path(__file__).parents[2]
ACTION = ROOT / ".github" / "actions" / "conform"
PREPARED = ("actions/", "pip install")
"""What this machine has already: a checkout, Python, canprobe."""


def script_of(step: dict[str, Any], env: dict[str, str]) -> str:
    """What a step does, for bash; the action of this repository is its script."""
    if "run" in step:
        return str(step["run"])
    assert step["uses"].startswith("OWNER/canprobe/.github/actions/conform@"), step
    asked = yaml.safe_load((ACTION / "action.yml").read_text())["inputs"]
    assert set(step["with"]) <= set(asked)
    inputs = {name: one.get("default", "") for name, one in asked.items()} | step["with"]
    given = {name.replace("-", "_").upper(): str(value) for name, value in inputs.items()}
    words = [f"{name}={value.replace('${{ env.EDS }}', env['EDS'])}" for name, value in given.items()]
    return f"env {shlex.join(words)} bash {ACTION / 'examine.sh'}"


@pytest.mark.slow(reason="a device is built, examined, and its master run and judged, in real time")
@pytest.mark.skipif(
    bool(missing_packages()) and not has_socketcan(), reason="no vcan; type: canprobe vcan --install -- true"
)
def test_the_example_project_passes_its_ci(tmp_path: Path) -> None:
    project = shutil.copytree(ROOT / "docs" / "example", tmp_path / "example")
    job = yaml.safe_load((project / ".github" / "workflows" / "ci.yml").read_text())["jobs"]["ci"]
    steps = [step for step in job["steps"] if not (step.get("uses") or step["run"]).startswith(PREPARED)]
    scripts = {step["name"]: script_of(step, job["env"]) for step in steps}
    env = {name: value for name, value in os.environ.items() if not name.startswith(("PYTEST", "CANPROBE_"))}
    env |= job["env"] | {"PYTHONPATH": str(ROOT), "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    if "CANOPEN_NODE" in os.environ:  # clones, as for docs/measure.py
        env["CANOPENNODE"] = str(Path(os.environ["CANOPEN_NODE"].split()[0]).parent)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(words, cwd=project, env=env, capture_output=True, text=True, check=False)

    built = run("bash", "-c", scripts.pop("Build the device"))
    if "Could not resolve host" in built.stderr:
        pytest.skip("CANopenNode's source is not at hand")
    assert built.returncode == 0, built.stderr
    tested = run("bash", "-ec", scripts.pop("Test the master in virtual time"))
    assert tested.returncode == 0, tested.stdout
    for number, script in enumerate(scripts.values()):
        (project / f"step{number}.sh").write_text(script)
    on_vcan = " && ".join(f"bash -e step{number}.sh" for number in range(len(scripts)))
    done = run(sys.executable, "-m", "canprobe", "vcan", "--", "bash", "-c", on_vcan)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "inputs: 00h" in done.stdout, "the master has run with the device"
    report = json.loads((project / "conform" / "conform.json").read_text())
    assert report["counts"]["FAIL"] == len(report["known"]) == 4
    assert not ElementTree.parse(project / "judge.xml").findall(".//failure")
