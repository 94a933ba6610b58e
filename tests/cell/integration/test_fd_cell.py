"""The full image at 200 Hz beside the 400 Hz arm on one CAN FD bus, end to end in lockstep."""

import dataclasses

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.errors import PlanError
from canprobe.fieldbus.bus.candump import read_candump

PERIOD_NS = 2_500_000


def fd_scene(name, mode="image", **bus):
    scene = canprobe.load_scene(name)
    sensor = dataclasses.replace(scene.sensor, mode=mode, eds="tactile_array_fd.eds")
    return dataclasses.replace(scene, sensor=sensor, bus=dataclasses.replace(scene.bus, **({"fd": True} | bus)))


def test_the_servo_runs_on_whole_images_and_only_taxels_are_long(tmp_path):
    """All else stays classical; each trigger brings a header and 256 taxels, none of them late."""
    result = undrawn_run(fd_scene("press"), out=tmp_path, duration_s=0.5)
    assert result.summary["completed"] and not result.summary["faults"]
    assert result.summary["cycle"]["torn_frames"] == result.summary["cycle"]["missed_pdos"] == 0
    assert result.summary["contact"]["contact_fraction"] == 1.0
    assert result.summary["contact"]["force_measured_rms_error_n"] < 0.1  # of 2 N
    frames = list(read_candump(tmp_path / "bus.log"))
    long = [frame for frame in frames if len(frame[3]) > 8]
    assert {(frame[2], len(frame[3])) for frame in long} == {(cob_id, 64) for cob_id in range(0x512, 0x516)}
    headers = [frame for frame in frames if frame[2] == 0x511]
    assert len(long) == 4 * len(headers) > 200
    assert np.abs(np.diff([frame[0] for frame in headers]) - 2 * PERIOD_NS).max() < 100_000
    planned = {pdo.cob_id: pdo.response_ns for pdo in result.plan.pdos if pdo.kind == "tactile"}
    sync_ns, worst = 0, dict.fromkeys(planned, 0)
    for t_ns, _, can_id, _ in frames:
        sync_ns = t_ns if can_id == 0x080 else sync_ns
        if can_id in worst:
            worst[can_id] = max(worst[can_id], t_ns - sync_ns)
    assert all(0 < worst[cob_id] <= planned[cob_id] for cob_id in planned), (worst, planned)
    assert worst[0x515] > 0.5 * planned[0x515]


def test_an_fd_image_takes_a_fifth_of_a_classical_one():
    plan = canprobe.plan(fd_scene("press"))
    load = dict(plan.traffic.parts)
    classical = canprobe.plan(fd_scene("listen", fd=False, mode="features"))
    assert len(plan.pdos_of(16, "tpdo")) == 5 and len(classical.pdos_of(16, "tpdo")) == 2
    assert load["tactile"] < 0.89 / 5
    with pytest.raises(PlanError, match="TPDO6"):  # the array with long PDOs has five of them
        canprobe.plan(fd_scene("press", fd=False))


def test_a_device_without_long_pdos_keeps_short_ones_and_the_plan_says_so():
    scene = fd_scene("press", mode="window")
    plan = canprobe.plan(dataclasses.replace(scene, sensor=dataclasses.replace(scene.sensor, eds="tactile_array.eds")))
    assert {pdo.layout.length for pdo in plan.pdos_of(16, "tpdo")} == {8}
    assert any(what == "CAN FD frames from the sensor" for what, _ in plan.not_available)
