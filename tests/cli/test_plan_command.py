"""`canprobe plan` as a user types it."""

from __future__ import annotations

import json
import re

import pytest

import canprobe
from canprobe.cell.planning.contact import witness_rows
from canprobe.cell.planning.report import plan_text, verdict_text
from canprobe.cell.scene.load import packaged
from canprobe.cli import main


@pytest.mark.parametrize("name", ["cylinder", "listen", "free"])
def test_a_plan_begins_with_a_verdict_of_at_most_five_lines(name, capsys):
    assert main(["plan", name, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert main(["plan", name]) == 0
    title, *verdict, more = capsys.readouterr().out.splitlines()
    assert title == f"{name}: {document['title']}" and "--full" in more
    lines = {line[2:13].strip(): line[13:] for line in verdict}
    touches = ["witnesses"] * (name == "cylinder")
    assert list(lines) == ["fits", "nodes", "load", *touches, "left out"] and len(lines) <= 5
    assert bool(document["witnesses"]) == bool(touches)
    assert lines["fits"] == "on can0 (lockstep), 1000000 bit/s, 400 Hz"
    (bus,) = document["bus_load"].values()
    slack_us = min(pdo["slack_us"] for pdo in document["pdos"])
    assert lines["load"].startswith(
        f"{100 * bus['planned_worst']:.1f} % at worst; {bus['budget']['slack_us']:g} of 2500"
    )
    assert lines["load"].endswith(f"is {slack_us:g} µs before its deadline")
    assert lines["left out"] == f"{len(document['left_out'])}: " + "; ".join(
        one["what"] for one in document["left_out"]
    )
    assert main(["plan", name, "--full"]) == 0
    full = capsys.readouterr().out.splitlines()
    assert full[: len(verdict) + 1] == [title, *verdict]
    assert {"nodes:", "uses:", "leaves out:"} < set(full)


def test_a_verdict_names_real_nodes_and_warnings():
    keys = {"joints.joint_2.emulated": False, "joints.joint_3.emulated": False, "arm.missed_syncs": 40}
    plan = canprobe.plan("cylinder", keys)
    text = verdict_text(plan)
    assert "  nodes      6 drives (1–6), tactile array (16); real: 2–3, the others emulated\n" in text
    assert f"  warning    {plan.warnings[0]}\n" in text and plan.warnings[0].startswith("arm.missed_syncs = 40")
    assert max(map(len, verdict_text(plan, 60).splitlines())) <= 60


@pytest.mark.parametrize("keys", [{}, {"arm.torque": False}, {"task.speed_mm_s": 60}])
def test_a_verdict_names_the_witnesses_that_watch_and_those_that_are_silent(keys):
    plan = canprobe.plan("cylinder", keys)
    said = dict(witness_rows(plan))
    shown = next(line for line in verdict_text(plan).splitlines() if line.startswith("  witnesses  "))
    watching, _, silent = shown.removeprefix("  witnesses  ").partition("; silent: ")
    assert {*watching.split(", ")} | ({*silent.split(", ")} if silent else set()) == set(said)
    for name, text in said.items():
        assert (name in silent) == text.startswith(("silent", "none"))
        assert text[:30] in plan_text(plan)


def test_what_does_not_fit_begins_with_that(capsys):
    assert main(["plan", "cylinder", "--set", "cycle.rate_hz=2000"]) == 2
    said = capsys.readouterr()
    assert said.out == "cylinder: does not fit\n" and "worst-case load" in said.err
    assert "  cycle.rate_hz = 400: load" in said.err, "a way out that keeps the images"


def test_a_rehearsal_says_what_was_done(capsys):
    assert main(["plan", "press", "--rehearse", "--set", "cycle.rate_hz=200"]) == 0
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


def test_tables_keep_to_the_width():
    for name, _ in packaged("scene")[:4]:
        plan = canprobe.plan(name)
        ids = [word for word in plan_text(plan).split() if word in ("181h", "206h")]
        for width in (40, 80, 100):
            text = plan_text(plan, width)
            assert max(map(len, text.splitlines())) <= width, name
            assert [word for word in text.split() if word in ("181h", "206h")] == ids, name


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
    assert re.search(rf"^  warning +whether the arm moves .* joints 1, .* {line}$", capsys.readouterr().out, re.M)
    assert main(["plan", str(scene), "--json"]) == 0
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert warning.endswith(line)
    assert main(["plan", "free"]) == 0
    assert "whether the arm moves" not in capsys.readouterr().out
