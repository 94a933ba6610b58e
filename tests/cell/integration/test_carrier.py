"""A scan of an object on a turntable or a conveyor: the same shape as at rest, and what the plan refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import reasons
from undrawn import undrawn_run

import canprobe
from canprobe.cell.planning.free_parameters import free_channel
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.bus_tools import _where_served
from canprobe.cell.session.check import measure_link, options_of_check
from canprobe.cell.session.session import Session, run_beginning
from canprobe.cell.session.target import Target
from canprobe.fieldbus.eds.packaged import eds_path

KEYS = {"task.duration_s": 2.5, "task.clearance_mm": 0.5, "shape.also": []}
CONVEYOR = {"kind": "conveyor", "axis": [0, 1, 0], "speed_mm_s": 3, "counts_per_m": 1e6}


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    return undrawn_run(canprobe.load_scene("turntable", KEYS), out=tmp_path_factory.mktemp("turntable"))


def test_the_shape_of_a_turning_object_is_found_as_that_of_one_at_rest(scanned):
    summary = scanned.summary
    shape, contact = summary["shape"], summary["contact"]
    assert summary["completed"] and contact["contact_fraction"] == 1.0 and summary["faults"] == []
    assert shape["kappa_rms_error_percent"] < 2.0 and shape["normal_rms_deg"] < 0.1 and shape["position_rms_mm"] < 0.1
    assert contact["force_rms_error_n"] < 0.1
    turned = np.rad2deg(scanned.log["carrier_rad"][-1] - scanned.log["carrier_rad"][0])
    assert turned == pytest.approx(5.0 * (scanned.log["t_s"][-1] - scanned.log["t_s"][0]), abs=0.01)


def test_the_estimates_of_the_run_come_again_from_its_folder_and_from_its_bus(scanned):
    again = canprobe.replay(scanned.out)
    assert again.summary["online"]["K_max_difference_per_m"] == 0.0
    of_bus = canprobe.replay(scanned.out / "bus.log", scene=scanned.out / "scene.toml")
    last = of_bus.summary["estimates"]["recursive"]["kappa_per_m"]
    assert last == pytest.approx(again.summary["estimates"]["recursive"]["kappa_per_m"], rel=0.05)


def test_an_object_on_a_conveyor_is_followed(tmp_path):
    scene = canprobe.load_scene("turntable", KEYS | {"carrier": CONVEYOR, "bus.interface": "direct"})
    result = undrawn_run(scene, out=tmp_path)
    shape = result.summary["shape"]
    assert result.summary["completed"] and shape["kappa_rms_error_percent"] < 2.0 and shape["position_rms_mm"] < 0.1


def test_a_run_that_leaves_the_reach_of_the_arm_is_refused():
    long = CONVEYOR | {"axis": [1, 0, 0], "speed_mm_s": 50}
    (problem,) = reasons(canprobe.load_scene("turntable", {"carrier": long}))
    assert problem.startswith("carrier: ") and "into the run the probe's centre at (" in problem


def test_the_speed_of_the_object_counts_in_the_speeds_of_the_joints():
    keys = {"task.duration_s": 2.0, "task.speed_mm_s": 2.0}
    at_rest, turning = (
        canprobe.plan("turntable", keys | {"carrier.speed_deg_s": speed}).joint_speeds.worst_share
        for speed in (0.01, 90.0)
    )
    assert turning > 2.0 * at_rest


def test_an_encoder_that_cannot_send_its_position_is_refused(tmp_path):
    text = eds_path("encoder").read_text(encoding="ascii")
    there = text.index("[6004]")
    (tmp_path / "other.eds").write_text(text[:there] + text[there:].replace("PDOMapping=1", "PDOMapping=0", 1))
    scene = canprobe.load_scene("turntable", {"carrier.eds": str(tmp_path / "other.eds")})
    (problem,) = reasons(scene)
    assert problem.startswith("node 17: ") and problem.endswith("object 6004h:00 is not mappable to a TPDO")


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ({"carrier.node_id": 3}, "carrier.node_id: expected a node id that no joint has, got 3"),
        ({"carrier.emulated": False}, "carrier.emulated: expected true, as arm.emulated"),
        ({"plant.fidelity": "dynamic"}, "plant.fidelity: expected an ideal arm with rigid joints"),
        ({"task.strategy": "explore"}, "task.strategy: expected a path that can be planned in time"),
        ({"carrier.point_mm": None}, 'carrier.point_mm: missing: kind = "turntable" needs it'),
    ],
)
def test_what_does_not_go_with_a_carrier_is_told(keys, told):
    with pytest.raises(canprobe.SceneError, match=told):
        canprobe.load_scene("turntable", keys)


REAL = {f"{section}.emulated": False for section in ("arm", "sensor", "carrier")}


def test_a_real_encoder_is_emulated_in_the_rehearsal():
    session = run_beginning(canprobe.plan("turntable", REAL | {"bus.interface": "socketcan", "cycle.rate_hz": 200.0}))
    assert session.opened and not session.cell.notes.lines()


def test_the_bus_of_the_encoder_may_have_another_name_and_is_not_free():
    scene = canprobe.load_scene("turntable", {"carrier.channel": "can1"})
    assert Target.over(scene, "socketcan", {"can1": "b"}).applied_to(scene).channels == ("can0", "b")
    assert free_channel(resolve(scene)) == "can2"


def test_the_line_that_takes_served_nodes_as_real_ones_names_the_encoder():
    line = _where_served(canprobe.load_scene("turntable"))
    keys = dict(word.split("=") for word in line.split() if word.endswith("emulated=false"))
    assert {f"{section}.emulated" for section in ("arm", "sensor", "carrier")} == set(keys)
    canprobe.load_scene("turntable", dict.fromkeys(keys, False))


def test_a_check_measures_the_answers_of_the_encoder():
    plan = canprobe.plan("turntable", {"bus.timed": True})
    report = measure_link(Session(plan, options_of_check()), 0.5)
    assert report.fit and [one.node_id for one in report.figures.answers] == [1, 2, 3, 4, 5, 6, 17]
    assert not any(one.missed for one in report.figures.answers)
