"""Another window end to end in lockstep: plan, configuration over SDO, frames on the bus, force and shape from them."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import change
from undrawn import undrawn_run

import canprobe
import canprobe.fieldbus.eds.packaged
from canprobe.cell.planning.array import patch_across_taxels, patch_radius_m, window_choices
from canprobe.cell.planning.pdos import tactile_objects
from canprobe.cell.plant.elastic_contact import elastic_contact
from canprobe.cell.scene.load import parse_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Probe
from canprobe.errors import PlanError, SceneError


def tactile(plan):
    return [pdo for pdo in plan.pdos if pdo.kind == "tactile"]


def test_what_is_planned_is_on_the_bus(tmp_path):
    keys = {"task.clearance_mm": 0.3, "arm.grouped_rpdo": True, "bus.cob_ids": "by_deadline", "sensor.window": 10}
    result = undrawn_run(canprobe.load_scene("press", keys), out=tmp_path, duration_s=0.1)
    assert len(tactile(result.plan)) == 14
    measured = canprobe.measure_traffic(tmp_path, result.plan)
    assert measured.as_planned and measured.unlisted == {} and measured.missing == ()
    (one,) = (one for one in measured.classes if one.kind == "tactile PDO")
    assert one.frames == pytest.approx(one.planned_frames, rel=0.02) and one.late == 0
    assert result.summary["cycle"]["torn_frames"] == 0
    (setup,) = (setup for setup in result.plan.nodes if setup.node_id == 16)
    assert [(w.value, w.read_back) for w in setup.writes if w.index == 0x2008] == [(10, True)]


@pytest.mark.parametrize("force, stiffness, radius_mm", [(2.0, 2.3e7, 40.0), (0.5, 1e9, 20.0)])
def test_the_planned_patch_is_the_plants_on_a_plane(force, stiffness, radius_mm):
    probe = Probe(np.eye(4), radius_mm * 1e-3, stiffness, 0.3)
    radius = patch_radius_m(force, probe)
    depth = radius**2 / (2e-3 * radius_mm)
    contact = elastic_contact(depth, (0.0, 0.0), radius_mm * 1e-3, stiffness)
    assert contact.force == pytest.approx(force, rel=1e-12)
    assert patch_across_taxels(force, probe, 1.5875e-3) == pytest.approx(2e3 * radius / 1.5875)


def test_the_smallest_that_holds_the_patch_comes_first_then_smaller_then_larger_ones():
    press = canprobe.load_scene("press")
    orders = {
        2.0: [10, 8, 6, 4, 12],  # 6.7 taxels across and 1.5 for following
        0.2: [6, 4, 8, 10, 12],  # 10^(1/4) less
    }
    for force, sides in orders.items():
        assert [side for side, _ in window_choices(resolve(change(press, task={"force_n": force})))] == sides
    assert "10.7 mm across and asks for 8.2 taxels" in window_choices(resolve(press))[0][1]
    assert [side for side, _ in window_choices(resolve(canprobe.load_scene("listen")))] == [12, 10, 8, 6, 4]


def test_auto_takes_what_fits_and_says_why():
    press = change(canprobe.load_scene("press"), sensor={"window": "auto"})
    full = canprobe.plan(press)
    assert full.scene.sensor.window == 10
    assert "motor torque (6077h)" in dict(full.left_out), "it goes before the window is cut"
    tight = canprobe.plan(change(press, cycle={"rate_hz": 1e6 / 2400}, sensor={"rate_hz": 1e6 / 4800}))
    assert tight.scene.sensor.window == 8
    assert "the largest that fits, cutting its rim" in tight.choices[0].why
    assert "motor torque (6077h)" not in dict(tight.left_out)
    grouped = canprobe.plan(change(press, arm={"grouped_rpdo": True}, bus={"cob_ids": "by_deadline"}))
    assert grouped.scene.sensor.window == 10 and len(tactile(grouped)) == 14
    assert "the smallest that holds it" in grouped.choices[0].why
    listening = canprobe.plan(change(canprobe.load_scene("listen"), sensor={"mode": "window", "window": "auto"}))
    assert listening.scene.sensor.window == 12
    features = canprobe.plan(change(press, sensor={"mode": "features"}))
    assert features.choices == (), "there is no window to choose"


def test_what_does_not_fit_names_the_windows_that_do():
    with pytest.raises(PlanError, match=r"5695 µs of the 5000 µs in 2 cycles") as refused:
        canprobe.plan(change(canprobe.load_scene("press"), sensor={"window": 12}))
    assert any(way.startswith("sensor.window = 8: load 8") for way in refused.value.ways_out)


def test_on_can_fd_every_word_of_every_window_has_its_place():
    scene = change(canprobe.load_scene("press"), sensor={"eds": "tactile_array_fd.eds"}, bus={"fd": True})
    lengths = {4: [8, 16], 6: [8, 32, 8], 8: [8, 64], 10: [8, 64, 32, 8], 12: [8, 64, 64, 16]}
    for side, expected in lengths.items():
        plan = canprobe.plan(change(scene, sensor={"window": side}))
        pdos = sorted(tactile(plan), key=lambda pdo: pdo.number)
        assert [pdo.layout.length for pdo in pdos] == expected
        objects = [(entry.index, entry.subindex) for pdo in pdos for entry in pdo.entries]
        assert objects == list(tactile_objects(plan.scene.sensor))


def test_a_sensor_without_the_object_keeps_8(tmp_path):
    """An older array: the same file without 2008h."""
    eds = (canprobe.fieldbus.eds.packaged.eds_path("tactile_array")).read_text()
    start = eds.index("[2008]")
    older = eds[:start] + eds[eds.index("\n\n", start) + 2 :]
    count = eds.index("SupportedObjects=12\n1=0x2000")
    older = older[:count] + older[count:].replace("SupportedObjects=12", "SupportedObjects=11", 1).replace(
        "8=0x2008\n9=0x2100\n10=0x2110\n11=0x2120\n12=0x2130", "8=0x2100\n9=0x2110\n10=0x2120\n11=0x2130", 1
    )
    path = tmp_path / "older.eds"
    path.write_text(older)
    scene = canprobe.load_scene("press", {"sensor.eds": str(path), "sensor.window": "auto"})
    plan = canprobe.plan(scene)
    assert plan.scene.sensor.window == 8
    assert ("another window", f"{path} has no window size (2008h), so the window keeps 8×8 taxels") in (
        plan.not_available
    )
    (setup,) = (setup for setup in plan.nodes if setup.node_id == 16)
    assert not any(write.index == 0x2008 for write in setup.writes) and setup.left_out == ()
    with pytest.raises(PlanError, match=r"sensor\.window = 8, not 6"):
        canprobe.plan(change(scene, sensor={"window": 6}))


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("window = 7", "an integer of 4, 6, 8, 10, 12"),
        ('window = "big"', '"auto"'),
        ('mode = "features"\nwindow = 8', "mode"),
    ],
)
def test_the_key_is_strict(line, complaint):
    with pytest.raises(SceneError, match=complaint):
        parse_scene(f'[scene]\nname = "x"\n[task]\nkind = "listen"\n[sensor]\n{line}\n')
