"""What a plan uses and leaves out, as data, JSON and text."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from scenes import change

import canprobe
from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.report import plan_dict, plan_text
from canprobe.cell.scene.load import load_scene, packaged
from canprobe.cell.scene.resolve import resolve


@pytest.mark.parametrize(
    ("name", "kinds", "estimator", "strategy", "absent"),
    [
        ("cylinder", {"drive", "tactile"}, "recursive", "weave", {"full image (32 PDOs)"}),
        ("press", {"drive", "tactile"}, None, None, {"surface estimator", "exploration strategy"}),
        ("calibrate", {"drive", "tactile"}, None, None, {"surface estimator", "exploration strategy", "tactile servo"}),
        ("listen", {"tactile"}, None, None, {"drives, their PDOs, joint limits", "surface estimator", "tactile servo"}),
        ("free", {"drive"}, None, None, {"tactile node and its PDOs", "surface estimator", "tactile servo"}),
    ],
)
def test_what_each_scene_uses_and_leaves_out(name, kinds, estimator, strategy, absent):
    plan = canprobe.plan(load_scene(name))
    assert {node.kind for node in plan.nodes} == kinds
    assert (plan_dict(plan)["estimator"], plan_dict(plan)["strategy"]) == (estimator, strategy)
    assert absent <= {what for what, _ in plan.left_out}
    assert all(why for _, why in plan.left_out)


def test_features_map_no_taxels():
    plan = canprobe.plan("listen", {"sensor.mode": "features"})
    assert {entry.index for pdo in plan.pdos for entry in pdo.entries} == {0x2130}
    left = dict(plan.left_out)
    assert {"full image (32 PDOs)", "window (8 PDOs)", "taxels and patch features in the master"} <= set(left)


def test_a_window_smaller_than_the_patch_is_told():
    cylinder = load_scene("cylinder")
    small = canprobe.plan(change(cylinder, sensor={"window": 6}))
    said = {what: why for what, why in small.left_out if what.startswith("full image")}
    assert next(iter(said.values())).endswith("is sent, with up to 6 % of the force outside")
    whole = {what: why for what, why in canprobe.plan(cylinder).left_out if what.startswith("full image")}
    assert next(iter(whole.values())).endswith("holds the patch")


def test_the_patch_is_left_out_where_it_is_switched_off_or_no_taxels_are_sent():
    axial = load_scene("axial")
    off = change(axial, shape={"patch": False})
    features = change(axial, sensor={"mode": "features"})
    assert "curvature from the patch" not in dict(canprobe.plan(axial).left_out)
    assert dict(canprobe.plan(off).left_out)["curvature from the patch"] == "shape.patch = false"
    assert "features" in dict(canprobe.plan(features).left_out)["curvature from the patch"]


def test_switches_of_the_plant_are_listed():
    quiet = change(load_scene("press"), plant={"noise": False, "creep": False})
    left = dict(canprobe.plan(quiet).left_out)
    assert left["taxel noise"] == "plant.noise = false"
    assert "taxel creep" in left
    assert "cover blur" not in left


def test_figures_and_truth_are_left_out_where_they_are_switched_off_or_nothing_is_emulated():
    whole, undrawn = (canprobe.plan("cylinder", {"outputs.figures": drawn}) for drawn in (True, False))
    assert {*whole.outputs} - {*undrawn.outputs} == {"report.png", "surface.png"}
    assert dict(undrawn.left_out)["figure"] == "outputs.figures = false"
    assert "truth.npz" in whole.outputs
    assert "truth.npz" not in canprobe.plan("free", {"arm.emulated": False}).outputs


def test_a_plan_knows_about_how_many_cycles_it_takes():
    assert canprobe.plan(load_scene("cylinder")).cycles == 23 * 400


WITHOUT_WARNINGS = ("cylinder", "foam", "steel", "calibrate", "listen", "free", "miscalibrated")


@pytest.mark.parametrize("name", [name for name, _ in packaged("scene")])
def test_a_packaged_scene_fits_and_its_plan_says_all_as_json_and_as_text(name):
    plan = canprobe.plan(load_scene(name))
    if plan.joint_speeds is not None:
        pairs = zip(plan.joint_speeds.needed, plan.joint_speeds.limit, strict=True)
        assert all(needed <= 0.6 * limit for needed, limit in pairs), "a packaged scene keeps clear of the limits"
    assert plan.warnings == () or name not in WITHOUT_WARNINGS
    document, text = json.loads(json.dumps(plan_dict(plan), allow_nan=False)), plan_text(plan)
    assert document["scene"] == name
    assert [node["node_id"] for node in document["nodes"]] == list(plan.node_ids)
    assert [pdo["cob_id"] for pdo in document["pdos"]] == [pdo.cob_id for pdo in plan.pdos]
    assert document["bus_load"]["can0"]["planned_worst"] == plan.traffic.load
    assert len(document["left_out"]) == len(plan.left_out)
    assert all(f"{pdo.cob_id:03X}h" in text for pdo in plan.pdos)
    assert all(node.name in text for node in plan.nodes)
    assert all(what in text and why in text for what, why in plan.left_out)
    assert f"{100 * plan.traffic.load:.1f} %" in text


@pytest.mark.parametrize("argv", [["plan", "press"], ["scenes"]])
def test_light_commands_import_neither_scipy_nor_matplotlib(argv):
    code = (
        "import sys; from canprobe.cli import main; status = main(sys.argv[1:]); "
        "heavy = {'scipy', 'matplotlib', 'canprobe.api', 'canprobe.cell.master', 'canprobe.cell.emulated'}; "
        "heavy &= set(sys.modules); "
        "sys.exit(f'imported {heavy}' if heavy else status)"
    )
    done = subprocess.run([sys.executable, "-c", code, *argv], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout


def test_help_imports_not_even_numpy():
    code = (
        "import sys; from canprobe.cli import main; main(['--help']); "
        "sys.exit(len({'numpy', 'can'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"bodies": None}, r"the masses of arm 'puma260' are not known; give .* or set plant.fidelity = \"ideal\""),
        ({}, r"pip install .*\[dynamics\]"),
    ],
    ids=["no bodies", "no extra"],
)
def test_a_dynamic_arm_that_cannot_be_emulated_is_refused(monkeypatch, changes, match):
    setup = resolve(load_scene("press"))
    setup = replace(setup, truth=replace(setup.truth, fidelity="dynamic", **changes))
    monkeypatch.setattr("canprobe.mechanics.robot.dynamics.importlib.util.find_spec", lambda name: None)
    with pytest.raises(canprobe.PlanError, match=match):
        make_plan(setup)


def test_the_identity_that_1018h_leaves_open_is_that_of_device_info():
    """The plan compares it in bring-up; a revision of 0 there is an empty field."""
    path = Path(__file__).parents[2] / "fieldbus" / "eds" / "messy" / "untold_drive.eds"
    assert DeviceCapabilities.of(str(path), 5).identity.numbers == (0xFB, 0x62100000, None, None)
