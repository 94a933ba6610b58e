"""Study `stability`: the linear loop against a plain simulation of it, and how extreme touches end."""

import json
import math
from collections import deque
from dataclasses import replace

import numpy as np
import pytest
from puma_arm import MODELS

from canprobe.cell.plant.ideal_arm import natural_frequency
from canprobe.cell.scene.geometry import T_flange_probe
from canprobe.cell.scene.load import load_scene
from canprobe.lab.studies import stability
from canprobe.lab.studies.linear_loop import ForceLoop, spectral_radius
from canprobe.lab.studies.result import write_study
from canprobe.lab.studies.stability_extremes import (
    EXTREMES,
    ExtremeCase,
    extreme_scene,
    judged,
    sync_delay_ns,
    touch_in_posture,
    upright,
)
from canprobe.lab.studies.stability_runs import LoopCase, layer_stiffness, loop_of, scene_of
from canprobe.lab.studies.witnessed_run import longest_above
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy
from canprobe.mechanics.touch.contact import indentation_from_force

LOOP = ForceLoop(1.0, 0.0025, 2, 8.0, 0.0, natural_frequency(30.0))
LOOPS = [
    replace(LOOP, depth_ratio=0.3),
    replace(LOOP, depth_ratio=3.9),
    replace(LOOP, depth_ratio=3.1, late_s=0.006),
    replace(LOOP, depth_ratio=2.4, period_s=0.01, sample_cycles=1),
    replace(LOOP, depth_ratio=5.0, height_hz=40.0),
]


def growth(loop, samples=240, substeps=500):
    """Growth of the surface's height over one period of the sensor, late in a run with small steps of the drive."""
    h, a, r, p, v = loop.period_s / substeps, 1.0, 0.0, 0.0, 0.0
    targets, shots, posted = {}, {}, {}
    height = deque(maxlen=samples // 2)
    share = 1.0 - math.exp(-2.0 * math.pi * loop.height_hz * loop.sample_cycles * loop.period_s)
    for cycle in range(samples * loop.sample_cycles):
        if cycle % loop.sample_cycles == 0:
            shots[cycle] = p  # taken at this trigger, sent at the next, usable a cycle after that
            posted[cycle + 1 + loop.late_cycles] = shots.get(cycle - loop.sample_cycles, p)
            height.append(a)
        if cycle in posted:
            tip = posted[cycle]
            felt = -tip * loop.depth_ratio  # depth, from the force by the law that was told
            a += share * ((tip + felt) - a)
        targets[cycle] = a
        end = targets.get(cycle - 1 - loop.late_cycles, r)
        slope = (end - r) / loop.period_s
        for _ in range(substeps):
            v += h * (loop.omega**2 * (r - p) - 2.0 * loop.damping * loop.omega * v)
            p += h * v
            r += h * slope
    size = np.abs(height)
    half = len(size) // 2
    return (size[half:].max() / size[:half].max()) ** (1.0 / half)


@pytest.mark.parametrize("loop", LOOPS, ids=lambda loop: f"g{loop.depth_ratio}-{loop.late_s}-{loop.period_s}")
def test_eigenvalues_are_the_growth_of_the_same_loop_step_by_step(loop):
    assert spectral_radius(loop) == pytest.approx(growth(loop), rel=0.015)


def test_a_known_stiffness_leaves_the_correction_alone():
    share = 1.0 - math.exp(-2.0 * math.pi * 8.0 * 0.005)
    assert spectral_radius(LOOP) == pytest.approx(1.0 - share, rel=1e-9)


def test_a_wrong_sign_of_the_gain_diverges():
    assert spectral_radius(replace(LOOP, depth_ratio=0.02)) < 1.0
    assert spectral_radius(replace(LOOP, depth_ratio=-0.02)) > 1.0


def test_twice_the_slope_is_stable_however_late_and_more_delay_takes_away_the_rest():
    late = [replace(LOOP, height_hz=50.0, late_s=s) for s in (0.0, 0.01, 0.05)]
    assert all(spectral_radius(replace(loop, depth_ratio=1.99)) < 1.0 for loop in late)
    stable = [[spectral_radius(replace(loop, depth_ratio=r)) < 1.0 for r in (2.1, 2.3, 2.5, 3.0, 9.0)] for loop in late]
    assert [sum(ratios) for ratios in stable] == sorted((sum(ratios) for ratios in stable), reverse=True)
    assert not any(stable[-1]) and any(stable[0]) and not all(stable[0])


def test_the_layer_has_the_stiffness_of_the_case():
    kappa = (1e3 / 36.0, 0.0)
    depths = [indentation_from_force(f, layer_stiffness(3e4), 0.04, kappa) for f in (1.99, 2.01)]
    assert 0.02 / (depths[1] - depths[0]) == pytest.approx(3e4, rel=1e-4)


def test_feeling_takes_the_wrong_stiffness_out_of_the_loop_within_its_bound():
    stated, estimated = (loop_of(LoopCase(5e4, servo)).depth_ratio for servo in stability.SERVOS)
    assert estimated == pytest.approx(1.0)
    assert stated > 4.0
    assert loop_of(LoopCase(1e6)).depth_ratio > 10.0


def test_a_posture_touches_where_the_arm_would_be():
    """Joints by the forward kinematics: 10 mm above, the pole points at the place, against its normal."""
    scene = extreme_scene(ExtremeCase("joint 5", 3, scan=False))
    angles = [joint.start_deg for joint in scene.joints.values()]
    T = forward(MODELS["puma260"].chain, np.radians(angles)) @ T_flange_probe(scene.probe)
    tip = 1e3 * T[:3, 3] + 40.0 * T[:3, 2]
    np.testing.assert_allclose(tip + 10.0 * T[:3, 2], scene.task.start_mm, atol=1e-6)
    np.testing.assert_allclose(-T[:3, 2], scene.task.approach_normal, atol=1e-9)
    _, normal, away = touch_in_posture((90.0, 65.0, 15.0, -360.0, 5.0, 0.0))
    assert abs(away[4] - 5.0) < 2.0 and normal == pytest.approx(normal / np.linalg.norm(normal))


@pytest.mark.parametrize("normal", [(0.0, 0.0, 1.0), (0.6, 0.0, 0.8), (0.0, 0.985, -0.174), (-0.48, 0.6, 0.64)])
def test_an_object_stands_upright_on_its_normal(normal):
    unit = np.array(normal) / np.linalg.norm(normal)
    z = rotation_rpy(*np.radians(upright(tuple(unit))))[:, 2]
    np.testing.assert_allclose(z, unit, atol=1e-12)


def test_the_array_is_one_that_the_wanted_force_does_not_saturate():
    scales = [scene_of(LoopCase(k)).sensor.full_scale_kpa for k in (1e3, 1e4, 2e4, 1e7)]
    assert scales == [100.0, 100.0, 300.0, 300.0]


def test_time_above_a_limit():
    rows = list(zip(range(0, 70, 10), (0.0, 3.0, 3.0, 1.0, 3.0, 3.0, 3.0), strict=True))
    assert longest_above(rows, 2.0) == 20
    assert longest_above(rows, 4.0) == 0


class InLine:
    """A sweep without processes."""

    def say(self, words):
        assert words

    def map(self, measure, cells, model):
        return [json.loads(json.dumps(measure(cell), allow_nan=False)) for cell in cells]


ENDINGS = [
    ("stable", ""),
    ("approach", "above the limit"),
    ("stopped", "no tactile frame"),
    ("refused", "worst-case load"),
]


@pytest.mark.slow(reason="a whole study in its quick form")
def test_quick_touches_end_as_they_may_and_are_drawn(tmp_path):
    result = stability.run(quick=True, sweep=InLine())
    for row, (ended, why) in zip(result.rows, ENDINGS, strict=True):
        assert (row["ended"], why in row["reason"]) == (ended, True), row
        assert row["above_ms"] is None or row["above_ms"] <= row["allowed_ms"]
    assert "Every touch is stable" in result.findings[-1]
    pictures = [path for path in write_study(result, tmp_path) if path.suffix == ".png"]
    assert [path.stem for path in pictures] == ["stability", "stability_extremes"]
    assert all(path.stat().st_size > 10_000 for path in pictures)
    (extremes,) = result.more
    assert [(row["extreme"], row["task"], row["ended"]) for row in extremes.rows] == [
        ("dead rows", "press", "right"),
        ("dead rows", "scan", "right"),
    ]


def test_findings_name_every_touch_that_ends_otherwise(tmp_path):
    force = {"force_max_n": 3.0, "above_ms": 10.0, "allowed_ms": 115.0, "error_percent": 4.0, "spread_percent": 3.0}
    good = stability.row_of(LoopCase(1e4, "stated"), {"ended": "stable", "reason": "", **force})
    assert "Every touch is stable" in stability.findings([good])[-1]
    bad = stability.row_of(LoopCase(1e6, "stated"), {"ended": "failed", "reason": "hang", **force})
    said = "\n".join(stability.findings([good, bad]))
    assert "stated, 1e+06 N/m" in said
    assert "failed, hang" in said
    assert "of 1 outside 1 are not stable" in said
    assert good["eigenvalue"] < 1.0 < bad["eigenvalue"]


def test_the_approach_limit_is_the_force_over_the_way_that_nobody_sees():
    row = {"rate_hz": 400.0, "late_ms": 0.0}
    way = 4e-3 * 0.0175
    assert stability.approach_limit(row) == pytest.approx(2.0 * math.sqrt(10.0) / way)
    assert stability.approach_limit(row | {"late_ms": 6.0}) < stability.approach_limit(row)


def test_an_extreme_case_is_right_only_with_its_force_and_its_curvature():
    sound = {"ended": "stable", "reason": "", "task": "scan", "error_percent": 4.0, "curvature_per_m": 9.0, "held": 0.9}
    assert judged(sound, 50.0)["ended"] == "right"
    assert judged(sound | {"held": 0.1}, 50.0) == {"ended": "wrong", "reason": "curvature"}
    assert judged(sound | {"held": 0.1, "curvature_per_m": 4.0}, 50.0)["ended"] == "right"
    assert judged(sound | {"held": None}, 50.0) == {"ended": "right", "reason": "curvature not observed"}
    assert judged(sound | {"error_percent": 21.0}, 50.0) == {"ended": "wrong", "reason": "force"}
    assert judged(sound | {"ended": "stopped"}, 50.0) == {"ended": "stopped"}
    assert judged(sound | {"ended": "hunting"}, 50.0)["reason"] == "hunting: the force does not settle"


@pytest.mark.parametrize("name", EXTREMES)
def test_extremes_are_one_thing_of_a_packaged_scene(name):
    case = ExtremeCase(name, EXTREMES[name][0][-1], scan=True)
    scene, plain = extreme_scene(case), load_scene("cylinder")
    assert scene.task.kind == "scan" and not scene.bus.timed
    if name != "jitter of the period":
        assert (scene.plant, scene.cycle, scene.object, scene.joints, scene.probe, scene.task) != (
            plain.plant, plain.cycle, plain.object, plain.joints, plain.probe, plain.task,
        )  # fmt: skip


def test_a_sync_is_as_late_for_every_node():
    delays = [sync_delay_ns(1e6, t_ns) for t_ns in (0, 2_500_000, 5_000_000)]
    assert delays == [sync_delay_ns(1e6, t_ns) for t_ns in (0, 2_500_000, 5_000_000)]
    assert len(set(delays)) == 3 and all(0 <= delay < 1_000_000 for delay in delays)
