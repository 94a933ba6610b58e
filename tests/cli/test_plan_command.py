"""`canprobe plan` as a user types it."""

from __future__ import annotations

import json
import re

import pytest

import canprobe
from canprobe.cell.planning.report import plan_text
from canprobe.cell.scene.load import packaged_scenes
from canprobe.cli import main


def test_a_rehearsal_says_what_was_done(capsys):
    assert main(["plan", "press", "--rehearse"]) == 0
    assert capsys.readouterr().out.rstrip().splitlines()[-1].startswith("rehearsed in lockstep: 7 nodes brought up")
    assert main(["plan", "listen", "--rehearse", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rehearsed"].endswith('task.kind = "listen": done')


def test_a_rehearsal_that_fails_is_refused_with_its_cause(capsys):
    words = ["plan", "cylinder", "--set", "limits.force_max_n=2.1"]
    assert main(words) == 0
    capsys.readouterr()
    assert main([*words, "--rehearse", "--json"]) == 2
    refused = json.loads(capsys.readouterr().out)
    assert refused["fits"] is False and "the rehearsal failed (SafetyStop): measured force" in refused["problems"][0]


def test_a_way_out_of_a_fast_cycle_keeps_the_images(capsys):
    assert main(["plan", "cylinder", "--set", "cycle.rate_hz=2000"]) == 2
    assert "  cycle.rate_hz = 400: load" in capsys.readouterr().err


@pytest.mark.parametrize("width", [40, 80, 100])
def test_tables_keep_to_the_width(width):
    for name, _ in packaged_scenes()[:4]:
        plan = canprobe.plan(name)
        assert max(map(len, plan_text(plan, width).splitlines())) <= width
        words = plan_text(plan).split()
        assert [w for w in plan_text(plan, width).split() if w in ("181h", "206h")] == [
            w for w in words if w in ("181h", "206h")
        ]


def test_an_array_that_shows_no_force_is_refused_with_its_key(tmp_path, capsys):
    (tmp_path / "mat.toml").write_text(
        '[array]\ntitle = "mat"\n[sensor]\nrows = 8\ncolumns = 8\npitch_mm = 30\nmount = "sphere"\nrate_hz = 200\n'
    )
    assert main(["plan", "listen", "--set", f"sensor.array={tmp_path / 'mat.toml'}"]) == 2
    assert "sensor.pitch_mm = 30: on the sphere of probe.radius_mm = 40" in capsys.readouterr().err


def test_joints_of_real_drives_that_nobody_has_checked_are_a_warning_with_the_line_to_type(
    tmp_path, capsys, monkeypatch
):
    """The line has the scene as it was typed, and a bus that real drives can be on."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    scene = tmp_path / "my first.toml"
    scene.write_text(
        '[scene]\nname = "mine"\n[arm]\nemulated = false\n[bus]\nchannel = "can1"\n[task]\nkind = "free"\n'
    )
    line = f"type: canprobe up '{scene}' --check-joints --bus socketcan --channel can1"
    assert main(["plan", str(scene)]) == 0
    assert re.search(rf"^warning: whether the arm moves .* joints 1, .* {line}$", capsys.readouterr().out, re.M)
    assert main(["plan", str(scene), "--json"]) == 0
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert warning.endswith(line)
    assert main(["plan", "free"]) == 0
    assert "whether the arm moves" not in capsys.readouterr().out
