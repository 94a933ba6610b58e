"""What other people's CI uses of this repository: the action and its script."""

from __future__ import annotations

import json
import os
import re
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from network_buses import group  # noqa: F401

ACTION = Path(__file__).parents[1] / ".github" / "actions" / "conform"
SCRIPT = ACTION / "examine.sh"


def test_the_action_gives_its_script_what_it_reads():
    action = yaml.safe_load((ACTION / "action.yml").read_text())
    steps = {step["name"]: step for step in action["runs"]["steps"]}
    asked = set(re.findall(r"\$\{\{ inputs\.([\w-]+) \}\}", json.dumps(steps)))
    assert asked == set(action["inputs"])
    read = set(re.findall(r"\$\{?([A-Z_]+)", SCRIPT.read_text())) - {"SECONDS", "GITHUB_STEP_SUMMARY"}
    given = set(steps["Examine the device"]["env"])
    assert read - given == {"BUS", "PATIENCE_S"}, "which have values of their own"


def examined(folder: Path, group: str, device: str, **more: str) -> subprocess.CompletedProcess[str]:
    settings = {"DEVICE": device, "NODE": "5", "EDS": "puma260_joint", "BUS": "udp_multicast", "CHANNEL": group, **more}
    env = {**os.environ, **settings}
    return subprocess.run(["bash", SCRIPT], cwd=folder, env=env, capture_output=True, text=True, check=False)


def test_a_device_program_that_ends_is_named_with_its_last_lines(tmp_path, group):
    done = examined(tmp_path, group, "echo it needs a battery; false")
    assert done.returncode == 3 and "it needs a battery" in done.stderr and "node 5 is not on" in done.stderr


@pytest.mark.slow(reason="an examination in real time")
def test_a_device_program_is_examined_and_ended(tmp_path, group):
    device = f"canprobe emulate --eds puma260_joint --node-id 5 --bus udp_multicast --channel {group}; echo ended"
    done = examined(tmp_path, group, device, OPTIONS="--points 100")
    assert done.returncode == 0, done.stderr
    assert "1 pass" in done.stdout and (tmp_path / "conform" / "bus.log").stat().st_size > 10_000
    assert json.loads((tmp_path / "conform" / "conform.json").read_text())["counts"]["PASS"] == 1
    assert len(ElementTree.parse(tmp_path / "conform" / "conform.xml").findall(".//testcase")) == 1
    assert "serving nodes 5" in (tmp_path / "conform" / "device.log").read_text()
