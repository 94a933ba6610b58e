"""`canprobe calibrate array`: what a touch of a known object records, and what is refused.

The fit is tested on simulated touches (`tests/cell/plant/test_calibrated_arrays.py`): the whole command
takes a minute.
"""

import json
import math
import re
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.calibrations import dump_calibration, load_calibration
from canprobe.cell.scene.load import load_scene, packaged_files
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session import array_calibration
from canprobe.cell.session.array_calibration import KnownObject, Visit, touch_object, visits
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.calibrate import Press
from canprobe.cli import main
from canprobe.errors import NodeError, PlanError, SceneError

AT = (-120.0, -122.5, 374.0)


def plan_of(known):
    keys = {"cycle.rate_hz": 200.0, "sensor.serial_number": 0x11, "bus.timed": False, "task.start_mm": AT}
    return make_plan(resolve(replace(load_scene("press", keys), object=known.settings(AT))))


def test_a_touch_rolls_over_the_pad_and_is_recorded_with_its_reference_force():
    known = KnownObject("ball", 0.025)
    presses = (Press(1.0, (1.5e-3, -1e-3), seconds=1.5, hz=(1.0,)), Press(2.0, seconds=1.0, hz=(1.0,)))
    dwells, unloaded, serial = touch_object(
        plan_of(known), Visit(known, presses, rest_s=0.5, load=True), None, lambda _: None, None
    )
    assert len(unloaded) > 80 and not np.any(unloaded) and serial == 0x11
    assert [d.place for d in dwells] == [0, 1]
    for dwell, press in zip(dwells, presses, strict=True):
        assert dwell.force == pytest.approx(press.force, rel=0.08)  # just pressed, it reads 5 % low
        np.testing.assert_allclose(dwell.expected[0], press.at, atol=0.15e-3)
        np.testing.assert_allclose(np.ptp(dwell.expected, axis=0), [3.0e-3, 1.2e-3], rtol=0.25)
        v, u = np.indices((16, 16)) - 7.5
        for image, place in list(zip(dwell.images, dwell.expected, strict=True))[50::40]:
            centroid = 1.5875e-3 * np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
            np.testing.assert_allclose(centroid, place, atol=0.25e-3)
        A = 0.5 * (25.0 + dwell.kappa[0])
        depth = math.sqrt(2.0 * dwell.force * A / (math.pi * 1.27e8))
        assert dwell.push.mean() == pytest.approx(depth, rel=0.05)


def test_a_calibration_is_of_one_array(tmp_path):
    """Its serial number is asked for at bring-up; of another array, named in the cell, it is one of the make."""
    file = tmp_path / "mine.toml"
    text = packaged_files("calibrations")["inch16"].read_text()
    gains = f"\n[taxels]\ngains = [{', '.join(['[' + '1.1, ' * 16 + ']'] * 16)}]\n"
    file.write_text(text.replace("\n[image]", "serial_number = 0x11\n\n[image]") + gains)
    its, another, others = (
        make_plan(resolve(load_scene("press", {"sensor.calibration": str(file), **changes})))
        for changes in ({}, {"sensor.serial_number": 0x22}, {"sensor.calibration": "inch16"})
    )
    assert its.warnings == others.warnings == ()
    assert [[node.identity.serial_number for node in plan.nodes][-1] for plan in (its, others)] == [0x11, None]
    (warning,) = another.warnings
    assert "of the array 0x11, and this one is 0x22 (1018h:04): its forces are known to 10 %" in warning
    force, its_force = (plan.setup.array.calibration.force for plan in (another, its))
    assert (force.spread, its_force.spread) == (0.1, 0.01)
    assert its.setup.array.calibration.gains and not another.setup.array.calibration.gains
    assert load_calibration(file).serial_number == 0x11
    (tmp_path / "again.toml").write_text(dump_calibration(load_calibration(file)))
    assert load_calibration(tmp_path / "again.toml") == load_calibration(file)
    exchanged = Session(its)
    exchanged.buses.world.participants[:] = Session(another).buses.world.participants
    with pytest.raises(NodeError, match=r"expected 0x11, got 0x22; if it is meant, its serial_number is 0x22 in"):
        exchanged.__enter__()


def test_an_array_that_is_no_node_has_a_name_in_the_cell_file(tmp_path):
    file = tmp_path / "mine.toml"
    text = packaged_files("calibrations")["inch16"].read_text()
    file.write_text(text.replace("\n[image]", 'serial_number = "left"\n\n[image]'))
    skin = {"sensor.array": "uskin4x4", "sensor.calibration": str(file)}
    named, other, nameless = (
        resolve(load_scene("listen", skin | name))
        for name in ({"sensor.serial_number": "left"}, {"sensor.serial_number": "right"}, {})
    )
    assert [setup.array.calibration.of_make for setup in (named, other, nameless)] == [False, True, True]
    assert load_calibration(file).serial_number == "left"
    told = [line for line in make_plan(nameless).warnings if "sensor.calibration" in line]
    assert "of the array left, and this one has no name" in told[-1]
    assert told[-1].endswith('or, if it is that one: sensor.serial_number = "left"')
    assert "of the array left, and this one is right: its forces" in " ".join(make_plan(other).warnings)
    with pytest.raises(SceneError, match=r"sensor\.serial_number: expected the number of 1018h:04.*got 'left'"):
        load_scene("press", {"sensor.serial_number": "left"})


def test_the_plan_states_which_force_of_an_array_of_the_make_may_be_at_the_limit(tmp_path):
    file = tmp_path / "mine.toml"
    text = packaged_files("calibrations")["inch16"].read_text()
    file.write_text(text.replace("\n[image]", "serial_number = 1\n\n[image]"))
    keys = {"sensor.calibration": str(file), "sensor.serial_number": 2}
    (told,) = (line for line in make_plan(resolve(load_scene("press", keys))).warnings if "of the array 0x1" in line)
    assert "known to 10 % (1σ), so that 4.14 N may be at limits.force_max_n = 5, and curvature is less" in told
    with pytest.raises(PlanError, match=r"task.force_n = 4.5: .* lower task.force_n to 4\.1"):
        make_plan(resolve(load_scene("press", {**keys, "task.force_n": 4.5})))


def test_a_force_beyond_the_calibration_is_less_certain():
    keys = {"limits.force_max_n": 20.0, "sensor.full_scale_kpa": 300.0}
    within, beyond = (make_plan(resolve(load_scene("press", keys | {"task.force_n": force}))) for force in (3.0, 6.0))
    assert "has forces up to" not in " ".join(within.warnings)
    told = "task.force_n = 6: the calibration of the array has forces up to 3 N; beyond them the force errs by 3.5 %"
    assert told in " ".join(beyond.warnings)
    errors = beyond.setup.array.calibration.force
    at_3, at_6 = (errors.sigma(force, 0.05, 0.0).total / force for force in (3.0, 6.0))
    assert math.hypot(at_3, 0.05 * math.log(2.0)) == pytest.approx(at_6)


def test_a_speed_beyond_that_of_the_settings_is_told():
    slow, fast = (make_plan(resolve(load_scene("bowl", {"task.speed_mm_s": v}))).warnings for v in (40.0, 60.0))
    told = "task.speed_mm_s = 60: what curvature is known to was found up to 40 mm/s; regions are 1.24 times as wide"
    assert told in fast and not any("was found up to" in line for line in slow)


def test_there_are_at_most_forty_touches_and_forces_only_grow_on_an_object():
    every = list(visits(0.025, 0.025, loads=True, one_by_one=True))
    assert sum(len(v.presses) for v in every) <= 40
    for visit in every:
        forces = [p.force for p in visit.presses]
        assert forces == sorted(forces)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["gantry"], "this arm holds its orientation"),
        (["pumma"], "no such cell"),
        (["puma260", "--force-reference", "guess"], "invalid choice"),
        (["puma260", "--at", "2000", "0", "0"], "out of reach"),
        (
            ["puma260", "--yes", "--verify"],
            "expected the file of this array, got none; make one first: canprobe calibrate array",
        ),
    ],
)
def test_what_cannot_be_calibrated_is_said(argv, said, tmp_path, capsys):
    assert main(["calibrate", "array", *argv, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err


def test_the_reach_of_every_roll_is_checked_before_anything_moves(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["calibrate", "array", "puma260", "--at", "-104", "-122.5", "374"]) == 2
    said = capsys.readouterr().err
    assert "give another point with --at" in said and "visit" not in said
    assert "contact at" not in said, "the plan of a press alone accepts it"
    assert list(tmp_path.iterdir()) == []


def test_without_a_point_a_cell_file_has_the_one_under_its_probe(tmp_path, monkeypatch):
    cell = tmp_path / "mine.toml"
    cell.write_text(packaged_files("cells")["puma260"].read_text())
    asked = []
    monkeypatch.setattr(array_calibration, "touch_object", lambda plan, *_: asked.append(plan.scene) or 1 / 0)
    for name in ("puma260", cell):
        with pytest.raises(ZeroDivisionError):
            array_calibration.calibrate(array_calibration.CalibrationRequest(name), date="2026-01-01")
        at = asked[-1].task.start_mm
        assert asked[-1].object.position_mm == at
        assert (at == AT) == (name == "puma260")
        assert at == pytest.approx(AT, abs=15)


def test_a_real_array_needs_somebody_to_place_things(tmp_path, capsys):
    cell = tmp_path / "mine.toml"
    text = packaged_files("cells")["puma260"].read_text().replace("[sensor]", "[sensor]\nemulated = false", 1)
    text = text.replace('eds = "puma260_joint.eds"', 'eds = "puma260_joint.eds"\nemulated = false', 1)
    cell.write_text(text)
    bus = ("--bus", "socketcan", "--channel", "can9")
    assert main(["calibrate", "array", str(cell), "--yes", *bus, "--out", str(tmp_path / "o")]) == 2
    assert "a person has to place the objects" in capsys.readouterr().err


def test_a_real_array_without_a_calibration_measures_nominal_newtons(tmp_path):
    scene = load_scene("listen")
    real = replace(scene, sensor=replace(scene.sensor, emulated=False), bus=replace(scene.bus, interface="socketcan"))
    assert any("nominal newtons" in warning for warning in make_plan(resolve(real)).warnings)
    assert not any("nominal" in warning for warning in make_plan(resolve(scene)).warnings)


@pytest.fixture(scope="module")
def own_array(tmp_path_factory):
    """A cell with an emulated array that has the packaged calibration as its own."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.toml").write_text(packaged_files("calibrations")["inch16"].read_text())
    text = packaged_files("cells")["puma260"].read_text()
    text = text.replace("[sensor]\n", '[sensor]\ncalibration = "mine.toml"\n')
    (folder / "cell.toml").write_text(text + "\n[cycle]\nrate_hz = 200.0\n")
    return folder


def test_a_calibration_that_holds_is_dated(own_array, capsys, monkeypatch):
    monkeypatch.chdir(own_array)
    assert main(["calibrate", "array", "cell.toml", "--yes", "--verify", "--out", "a", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["holds"], report["verified"]) == (True, None), "as it was before"
    assert load_calibration("mine.toml").verified == date.today().isoformat()


def test_gains_that_drifted_are_told(own_array, capsys, monkeypatch):
    """By the arm's way: as if the array showed a seventh less than when it was calibrated."""
    monkeypatch.chdir(own_array)
    stated = replace(load_calibration("mine.toml"), verified=None)
    shown = replace(stated.image, scale=1.15 * stated.image.scale)
    Path("mine.toml").write_text(dump_calibration(replace(stated, image=shown)))
    assert main(["calibrate", "array", "cell.toml", "--yes", "--verify", "--out", "c"]) == 1
    assert re.search(
        r"calibrated .*, last verified never\n  moments .* %\n  stiffness .* by the arm's way.*\n"
        r"  it does not hold: type canprobe calibrate array CELL\n$",
        capsys.readouterr().out,
    )
    assert load_calibration("mine.toml").verified is None


def test_a_file_without_the_stiffness_by_the_way_is_not_verified(own_array, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.toml").write_text((own_array / "cell.toml").read_text())
    text = packaged_files("calibrations")["inch16"].read_text()
    (tmp_path / "mine.toml").write_text(re.sub(r"(?m)^(depth|arm_compliance)_.*\n", "", text))
    assert main(["calibrate", "array", "cell.toml", "--yes", "--verify", "--out", "a"]) == 2
    assert "mine.toml: stiffness.depth_n_m3: expected a number, got none" in capsys.readouterr().err
