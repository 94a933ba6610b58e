"""`canprobe run calibrate`: what it finds of the tool, what it writes, and what a scan with a wrong tool gains."""

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.results.tool_file import with_tool
from canprobe.errors import PlanError, SafetyStop, SceneError
from canprobe.mechanics.touch.probe_motion import ArcMotion
from canprobe.mechanics.touch.servo import ProbePose

ERROR_MM = (0.4, -0.3, 0.5)


def fast(scene, **sections):
    scene = replace(scene, bus=replace(scene.bus, timed=False))
    return replace(scene, **{name: replace(getattr(scene, name), **values) for name, values in sections.items()})


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """One scan over a layer a third as stiff as stated: by the force alone the depth would be wrong, and the tool."""
    scene = fast(
        canprobe.load_scene("calibrate", {"cycle.rate_hz": 200.0}),
        task={"touches": 5},
        plant={"stiffness_n_m3": 1.27e8 / 3},
    )
    return undrawn_run(scene, out=tmp_path_factory.mktemp("calibrate"))


def test_the_tool_is_found_within_its_bounds(calibrated):
    found = calibrated.summary["calibration"]
    assert calibrated.summary["completed"]
    assert found["touches"] == 5 and found["observed"] == [True] * 3
    assert found["true_mm"] == pytest.approx([0.4, -0.3, 80.5])
    error, sigma = np.array(found["error_mm"]), np.array(found["sigma_mm"])
    np.testing.assert_allclose(np.array(found["tool_centre_mm"]) - found["true_mm"], error)
    assert (np.abs(error) < 2.6 * sigma).all() and (sigma < 0.2).all()
    assert (np.abs(error) < 0.1).all(), "of 0.3 to 0.5 mm that it was off"
    np.testing.assert_allclose(found["ball_moved_mm"], (0.8, -0.6, 0.5), atol=0.15)
    assert 1 < found["condition_number"] < 1000


def test_it_presses_gently_and_lets_go_between_the_touches(calibrated):
    force = calibrated.truth["force_n"]
    touches = np.flatnonzero(np.diff((force > 0.5).astype(int)) == 1)
    assert len(touches) == 5
    assert force.max() < 1.5
    assert all(force[a:b].min() == 0.0 for a, b in itertools.pairwise(touches))


def test_terminal_and_files_say_it(calibrated):
    measured = canprobe.measure_traffic(calibrated.out, calibrated.plan)
    assert measured.as_planned and measured.unlisted == {} and measured.missing == ()
    text = calibrated.text()
    assert "5 touches, condition number" in text
    assert "true 0.400, error" in text
    assert json.loads((calibrated.out / "summary.json").read_text())["calibration"] == calibrated.summary["calibration"]
    text = (calibrated.out / "tool.toml").read_text()
    assert "centre_lateral_mm = [0." in text
    assert f"position_sd_mm = {max(calibrated.summary['calibration']['sigma_mm']):.3f}\n" in text


def test_a_scene_with_the_tool_that_was_found_believes_it_and_knows_how_surely(calibrated):
    """The real tool stays; without a calibration 0.2 mm were believed that nobody measured."""
    scene = fast(canprobe.load_scene("cylinder"), plant={"tool_error_mm": ERROR_MM})
    better = with_tool(scene, calibrated.out / "tool.toml")
    believed = np.array([*better.probe.centre_lateral_mm, better.probe.centre_offset_mm])
    np.testing.assert_allclose(believed + better.plant.tool_error_mm, np.add(ERROR_MM, (0.0, 0.0, 80.0)), atol=1e-9)
    assert np.linalg.norm(better.plant.tool_error_mm) < 0.4 * np.linalg.norm(ERROR_MM)
    before, after = (canprobe.plan(each).setup.probe.place_sd for each in (scene, better))
    assert after < 0.7 * before


def test_heights_know_that_the_tool_may_be_off():
    scene = fast(canprobe.load_scene("cylinder", {"cycle.rate_hz": 200.0}), plant={"tool_error_mm": (0.1, 0.1, 0.2)})
    found = canprobe.run(scene, bus="direct", files=False, duration_s=2.0).summary["shape"]["map"]
    assert found["rms_error_um"] == pytest.approx(200.0, abs=20.0)
    assert found["sigma_um"] == pytest.approx(200.0, rel=0.05) and found["sigma_relative_um"] < 20.0
    assert found["within_2_sigma_fraction"] == 1.0 and found["within_2_sigma_relative_fraction"] > 0.9
    real = replace(scene, arm=replace(scene.arm, emulated=False))
    stated = [
        canprobe.plan(replace(each, arm=replace(each.arm, accuracy_mm=mm))).setup.probe.place_sd
        for each, mm in ((scene, None), (scene, 0.15), (real, None), (real, 0.0))
    ]
    assert stated == pytest.approx([0.2e-3, 0.25e-3, 0.5385e-3, 0.2e-3], rel=1e-3)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("[probe]\ncentre_offset_mm = 80.0\n", "expected the section"),
        ("[probe]\ncentre_offset_mm = -1\ncentre_lateral_mm = [0, 0]\n", "probe.centre_offset_mm: expected"),
        ("[probe]\ncentre_offset_mm = 80\ncentre_lateral_mm = [0, nan]\n", "probe.centre_lateral_mm: expected"),
        ("[probe\n", "not valid TOML"),
    ],
)
def test_a_file_that_is_no_calibration_is_refused(tmp_path, text, what):
    (tmp_path / "tool.toml").write_text(text)
    with pytest.raises(SceneError, match=what):
        with_tool(canprobe.load_scene("cylinder"), tmp_path / "tool.toml")
    with pytest.raises(SceneError, match="has no probe"):
        (tmp_path / "good.toml").write_text("[probe]\ncentre_offset_mm = 80\ncentre_lateral_mm = [0, 0]\n")
        with_tool(replace(canprobe.load_scene("free"), probe=None), tmp_path / "good.toml")


def test_a_ball_that_is_not_there_is_told():
    scene = fast(canprobe.load_scene("calibrate"), task={"touches": 3, "search_mm": 1.0, "clearance_mm": 1.0})
    x, y, z = scene.object.position_mm
    scene = replace(scene, object=replace(scene.object, position_mm=(x, y, z - 4.0)))
    with pytest.raises(SafetyStop, match="touch 1: no ball found up to 1 mm beyond the expected place"):
        canprobe.run(scene, bus="direct", files=False)


def test_the_plan_refuses_a_side_that_the_arm_cannot_reach():
    scene = canprobe.load_scene("calibrate")
    with pytest.raises(PlanError, match=r"touch \d+ of 13 is out of reach|joint \d would move"):
        canprobe.plan(replace(scene, task=replace(scene.task, tilt_deg=55.0)))


def test_the_way_round_the_ball_keeps_its_distance():
    centre = np.array([0.1, 0.2, 0.3])
    a, b = (np.array([math.sin(angle), 0.0, math.cos(angle)]) for angle in (-0.5, 0.6))
    arc = ArcMotion(centre, ProbePose(centre + 0.07 * a, -a), ProbePose(centre + 0.068 * b, -b), 0.04)
    poses = [arc.at(t) for t in np.linspace(0, arc.duration, 50)]
    distances = [np.linalg.norm(pose.centre - centre) for pose in poses]
    assert min(distances) >= 0.068 - 1e-12 and max(distances) <= 0.07 + 1e-12
    np.testing.assert_allclose(poses[-1].centre, centre + 0.068 * b, atol=1e-12)
    np.testing.assert_allclose(poses[-1].pole, -b, atol=1e-12)
    speeds = np.linalg.norm(np.diff([pose.centre for pose in poses], axis=0), axis=1)
    assert speeds.max() / (arc.duration / 49) < 2 * 0.04
