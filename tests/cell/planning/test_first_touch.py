"""The first touch of a plan, against the emulated array and the integral of its pressure, and what a plan refuses."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scenes import change, reasons

import canprobe
from canprobe.cell.planning.contact import blind_s, depth_at, first_shown_n, force_at
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.pressure import PressureField
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.cell.scene.load import packaged_files
from canprobe.cell.scene.resolve import resolve
from canprobe.mechanics.touch.pad import THRESHOLD_COUNTS, Pad

K = 1.27e8
MAT = {"mount": "flat", "mode": "image", "rows": 8, "columns": 8}


def press(sensor, *, force_n=3.0, radius_mm=200.0, rate_hz=400.0, limit_n=5.0):
    """A press on a sphere."""
    return change(
        canprobe.load_scene("press"),
        object={"kind": "sphere", "radius_mm": radius_mm, "rotation_deg": (0.0, 0.0, 0.0)},
        sensor=sensor,
        task={"force_n": force_n, "duration_s": 0.5, "clearance_mm": 1.0},
        cycle={"rate_hz": rate_hz},
        bus={"timed": False},
        limits={"force_max_n": limit_n},
    )


@pytest.mark.parametrize("pitch_m", [4e-3, 10e-3, 30e-3])
def test_from_that_force_on_the_emulated_array_shows_a_contact_between_its_taxels(pitch_m):
    pad = Pad(8, 8, pitch_m, mount_radius_m=None)
    touch = resolve(press(MAT)).task
    shown_n = first_shown_n(replace(touch.array, pad=pad))
    config = TaxelConfig(full_scale_pa=pad.full_scale_pa).without("noise", "gain_error", "crosstalk", "hysteresis")
    highest = []
    for force_n in (1.2 * shown_n, 0.5 * shown_n):
        array = TaxelArray(config, np.random.default_rng(0), radius_m=pad.radius_m, stiffness_n_m3=K, pad=pad)
        depth = depth_for_force(force_n, (20.0, 20.0), pad.radius_m, K)
        image = array.image((0.0, 0.0), depth, (20.0, 20.0), ((1.0, 0.0), (0.0, 1.0)), 0.0)
        highest.append(image.max())
    assert highest[0] >= THRESHOLD_COUNTS
    assert shown_n == 0.15 or highest[1] < THRESHOLD_COUNTS


@pytest.mark.parametrize("radius_mm", [5.0, 200.0, 1e6])
@pytest.mark.parametrize("depth_m", [2e-5, 2e-4])
def test_the_force_at_a_depth_is_the_integral_of_the_pressure_and_never_below_it(radius_mm, depth_m):
    touch = resolve(press(MAT | {"pitch_mm": 4.0})).task
    pad, kappa = touch.array.pad, 1e3 / radius_mm
    field = PressureField(pad.radius_m, pad, blur_pitch=0.0, samples=40)
    means = field.mean_pressure((0.0, 0.0), depth_m, (kappa, kappa), ((1.0, 0.0), (0.0, 1.0)))
    integral = touch.probe.stiffness * float(means.sum()) * pad.pitch_m**2
    force = force_at(depth_m, touch.probe, touch.array, (kappa, kappa))
    assert 0.999 * integral <= force <= 1.35 * integral  # the pad's edge cuts some of the paraboloid
    assert depth_at(force, touch.probe, touch.array, (kappa, kappa)) == pytest.approx(depth_m)


@pytest.mark.parametrize("sensor", [{"pitch_mm": 30.0, "full_scale_kpa": 20.0}, {"pitch_mm": 10.0}])
def test_taxels_that_do_not_show_the_force_are_refused_and_the_way_out_is_one(sensor):
    mat = {"full_scale_kpa": 100.0} | sensor
    (said,) = reasons(press(MAT | mat, force_n=2.0, limit_n=12.0))
    assert said.startswith(f"sensor.pitch_mm = {sensor['pitch_mm']:g}, sensor.full_scale_kpa = ")
    forces, pitches = re.findall(r"task.force_n = ([\d.]+)", said), re.findall(r"or sensor.pitch_mm = ([\d.]+)", said)
    if forces[1:]:
        assert canprobe.plan(press(MAT | mat, force_n=float(forces[1]), limit_n=12.0))
    assert canprobe.plan(press(MAT | mat | {"pitch_mm": float(pitches[0])}, force_n=2.0, limit_n=12.0))


def test_a_first_touch_that_presses_too_hard_until_it_is_seen_is_refused_and_the_slower_one_is_not():
    scene = press(MAT | {"pitch_mm": 4.0, "rate_hz": 25.0}, rate_hz=100.0, radius_mm=1e4)
    (said,) = reasons(scene)
    slower = float(re.search(r"lower task.approach_mm_s to ([\d.]+)", said)[1])
    assert said.startswith("task.approach_mm_s = 4:") and 0.0 < slower < 4.0
    assert canprobe.plan(change(scene, task={"approach_mm_s": slower}))


def test_the_time_until_an_approach_ends_is_that_of_an_image_its_way_and_the_command():
    """200 Hz: up to 5 ms to the next image, 5 ms until it is here, two cycles of 2.5 ms, and the lag of the drives."""
    setup = resolve(canprobe.load_scene("press"))
    assert blind_s(setup.rate_hz, setup.array, setup.touch.lag_s) == pytest.approx(5e-3 + 5e-3 + 2 * 2.5e-3 + 6.8e-3)


def test_a_press_needs_two_taxels_under_the_patch_of_a_sphere():
    (said,) = reasons(press({"rows": 8, "columns": 8, "pitch_mm": 7.0, "window": 6}, force_n=1.0, radius_mm=30.0))
    assert said.startswith("sensor.pitch_mm = 7: at task.force_n = 1 the patch covers 1.3 taxels")


def test_a_flat_array_leaves_a_touch_that_went_too_deep_before_it_presses_harder():
    scene = press(MAT | {"pitch_mm": 4.0, "rate_hz": 200.0 / 3, "full_scale_kpa": 60.0}, rate_hz=200.0)
    result = canprobe.run(scene, bus="direct", files=False)
    assert result.summary["completed"], result.summary["stop_reason"]
    assert result.truth["force_n"].max() < 5.0


def test_a_force_that_its_own_deviation_would_stop_is_refused_and_the_named_ones_are_not():
    scene = canprobe.load_scene("press", {"task.force_n": 2.0, "limits.force_max_n": 2.05})
    (said,) = reasons(scene)
    assert said.startswith("task.force_n = 2: the array measures it to ± 4.") and "(2σ)" in said
    less = float(re.search(r"lower task.force_n to ([\d.]+)", said)[1])
    more = float(re.search(r"raise limits.force_max_n to ([\d.]+)", said)[1])
    assert canprobe.plan(change(scene, task={"force_n": less}))
    assert canprobe.plan(change(scene, limits={"force_max_n": more}))


def test_a_calibration_without_errors_of_the_force_is_warned_of_once(tmp_path):
    text = (packaged_files("calibrations")["inch16"]).read_text()
    (tmp_path / "old.toml").write_text(text[: text.index("[force]")])
    plan = canprobe.plan("press", {"sensor.calibration": str(tmp_path / "old.toml")})
    assert ["[force]" in line for line in plan.warnings].count(True) == 1
    assert not any("[force]" in line for line in canprobe.plan("press").warnings)
