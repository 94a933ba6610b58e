"""Each packaged object and stiffness, some seconds of scan in lockstep, scored against the plant's truth."""

from dataclasses import replace

import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.scene.model import ObjectSettings
from canprobe.errors import PlanError

# scene: force RMS error and curvature RMS error that it stays below, percent
TABLE = {
    "ellipsoid": (5.0, 3.0),
    "turntable": (5.0, 3.0),
    "torus": (5.0, 13.0),  # the second curvature changes its sign within the estimator's memory
    "fillet": (11.0, 90.0),  # no quadric fits over a jump of curvature
    "bowl": (8.0, 1.5),
    "wave": (5.0, 30.0),  # 7 1/m at most, and it changes within the memory
    "relief": (6.0, 110.0),  # the true curvature is that of its edges, which are sharper than any patch
    "steel": (13.0, 3.0),
    "foam": (8.0, 8.0),
    "miscalibrated": (28.0, 20.0),  # a wrong tool is none of the noise that the estimator weighs
}


@pytest.mark.slow(reason="each packaged scene, whole")
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", TABLE)
def test_scene_runs_completely_with_sensible_figures(name, tmp_path):
    force_percent, kappa_percent = TABLE[name]
    scene = canprobe.load_scene(name)
    run = undrawn_run if scene.object.kind == "cylinder" else canprobe.run  # a cylinder is drawn elsewhere
    seconds = 6.0 if name == "miscalibrated" else 3.0  # a wrong tool is seen over a longer way only
    result = run(scene, out=tmp_path, duration_s=seconds)
    taken_along = {"relief.npz"} if name == "relief" else set()
    assert {path.name for path in tmp_path.iterdir()} == set(result.plan.outputs) | taken_along
    measured = canprobe.measure_traffic(tmp_path, result.plan)
    assert measured.as_planned and measured.unlisted == {} and measured.missing == ()
    summary = result.summary
    contact, shape = summary["contact"], summary["shape"]
    assert summary["completed"], summary["stop_reason"]
    assert contact["contact_fraction"] == 1.0
    assert 0.0 < 100.0 * contact["force_rms_error_n"] / contact["force_target_n"] < force_percent
    assert contact["force_max_n"] < 4.0
    assert shape["observed"] == [True, True]
    assert 0.0 < shape["kappa_rms_error_percent"] < kappa_percent
    if name == "miscalibrated":  # what real calibration costs: the default has 1 % and 0.1 mm
        assert shape["kappa_rms_error_percent"] > 4.0
        assert shape["position_rms_mm"] > 0.5


@pytest.mark.slow(reason="each packaged scene, whole")
@pytest.mark.timeout(600)
def test_a_dynamic_arm_is_as_deterministic_and_keeps_the_force(tmp_path):
    scene = canprobe.load_scene("press")
    scene = replace(scene, plant=replace(scene.plant, fidelity="dynamic"))
    logs = []
    for name in ("first", "second"):
        result = undrawn_run(scene, out=tmp_path / name, duration_s=1.0)
        logs.append((tmp_path / name / "bus.log").read_bytes())
    assert logs[0] == logs[1]
    assert result.summary["contact"]["force_rms_error_n"] < 0.2
    assert result.summary["contact"]["contact_fraction"] == 1.0


def test_a_bowl_as_tight_as_the_probe_is_refused_with_the_reason():
    scene = canprobe.load_scene("bowl")
    assert scene.object.kind == "bowl"
    tight = replace(scene, object=ObjectSettings("bowl", radius_mm=40.0))
    with pytest.raises(PlanError, match="hollow of radius 40 mm is tighter than the probe"):
        canprobe.plan(tight)
