"""Each packaged object and stiffness, some seconds of scan in lockstep, scored against the plant's truth."""

import pytest

import canprobe

# scene: force RMS error and curvature RMS error that it stays below, percent
TABLE = {
    "ellipsoid": (5.0, 3.0),
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
def test_scene_runs_completely_with_sensible_figures(name):
    force_percent, kappa_percent = TABLE[name]
    scene = canprobe.load_scene(name)
    seconds = 6.0 if name == "miscalibrated" else 3.0  # a wrong tool is seen over a longer way only
    summary = canprobe.run(scene, files=False, duration_s=seconds).summary
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
