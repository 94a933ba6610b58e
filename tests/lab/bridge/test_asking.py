"""How bridges are asked for: by the scene and the command line; bad names, missing extras, and nothing unasked."""

from __future__ import annotations

from typing import get_args

import pytest

import canprobe
from canprobe.cell.planning.bridges import BRIDGES, BridgeInfo, check_bridges
from canprobe.cell.planning.report import plan_dict, plan_text
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.cell.scene.model import BridgeName
from canprobe.cli import main
from canprobe.errors import SceneError, UsageError

FREE = dump_scene(canprobe.load_scene("free"))


def test_the_scene_knows_the_bridges_that_there_are_each_a_module_with_an_extra(request):
    assert set(get_args(BridgeName)) == set(BRIDGES)
    root = request.config.rootpath
    for info in BRIDGES.values():
        assert f"\n{info.extra} = [" in (root / "pyproject.toml").read_text()
        assert root.joinpath("bridge", *info.module.split(".")).with_suffix(".py").is_file()


def test_a_plan_names_the_bridges_that_its_scene_asks_for():
    plan = canprobe.plan(parse_scene(FREE))
    assert ("bridges to other tools", "no [bridge]: no other tool is fed") in plan.left_out
    assert plan_dict(plan)["bridges"] == [] and "run.mcap" not in plan.outputs
    plan = canprobe.plan(parse_scene(FREE + '[bridge]\nuse = ["mcap"]\n'))
    assert plan.scene.bridge.ros2_loopback is True
    assert "run.mcap" in plan.outputs and plan_dict(plan)["bridges"] == ["mcap"]
    assert "mcap: one MCAP file" in plan_text(plan)
    assert not [what for what, _ in plan.left_out if "bridge" in what]


@pytest.mark.parametrize(
    ("section", "complaint"),
    [
        ('use = ["mkap"]', "bridge.use: expected"),
        ('use = "mcap"', "bridge.use"),
        ("foxglove_port = 70000", "bridge.foxglove_port: expected"),
        ('use = ["mcap", "mcap"]', "bridge.use"),
    ],
)
def test_a_wrong_section_is_refused_with_its_key(section, complaint):
    with pytest.raises(SceneError, match=complaint):
        parse_scene(FREE + f"[bridge]\n{section}\n")


@pytest.mark.parametrize("command", ["run free", "replay ."])
def test_a_wrong_name_on_the_command_line_lists_what_there_is(command, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bus.log").write_text("")
    (tmp_path / "scene.toml").write_text(FREE)
    assert main([*command.split(), "--bridge", "foxglov"]) == 2
    error = capsys.readouterr().err
    assert "did you mean foxglove?" in error and all(f"{name} (" in error for name in BRIDGES)
    assert not (tmp_path / "runs").exists()


def test_a_missing_extra_is_named_with_its_pip_line(monkeypatch):
    nowhere = BridgeInfo("nothing", "nowhere", "mcap", ("a_package_that_nobody_has",))
    monkeypatch.setitem(BRIDGES, "mcap", nowhere)
    with pytest.raises(UsageError, match=r"mcap: needs a_package_that_nobody_has; type: pip install .*\[mcap\]'"):
        check_bridges(["mcap"])
    plan = canprobe.plan(parse_scene(FREE + '[bridge]\nuse = ["mcap"]\n'))
    assert [why for what, why in plan.not_available if what == "bridge mcap" and "pip install" in why]


def test_children_import_our_package_and_the_bridge_is_named_before_the_run(tmp_path, monkeypatch, capsys):
    (tmp_path / "canprobe").mkdir()
    (tmp_path / "canprobe" / "__init__.py").write_text("raise ImportError('of the working folder')")
    monkeypatch.chdir(tmp_path)
    assert main(["run", "press", "--bridge", "mcap", "--duration", "0.1", "--no-figures", "--out", "out"]) == 0
    assert "bridge mcap: " in capsys.readouterr().err, "also without a terminal"
