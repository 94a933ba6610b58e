"""A window that cuts the contact patch: how much of the force it feels, and what the plan says and refuses."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from scenes import change, refused

import canprobe
from canprobe.cli import main
from canprobe.emulator.plant.contact import elastic_contact
from canprobe.planning import plan_text
from canprobe.planning.contact_window import PITCH_M, patch_radius_m
from canprobe.planning.cut_patch import cut_patch, measured_share, true_force_n
from canprobe.scene_loader import load_scene
from canprobe.scene_resolve import resolve
from canprobe.scene_writer import dump_scene

PROBE = resolve(load_scene("cylinder")).probe


@pytest.mark.parametrize("side, off", [(4, 0.0), (4, 0.75), (6, 0.0), (6, 0.75), (8, 0.75)])
@pytest.mark.parametrize("force", [0.5, 2.0, 4.5])
def test_share_against_points_on_a_grid(side, off, force):
    """The plant's own patch and pressure, summed over a million points."""
    radius = patch_radius_m(force, PROBE)
    contact = elastic_contact(radius**2 / 0.08, (0.0, 0.0), 0.04, PROBE.stiffness)
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 1001)] * 2)
    pressure = np.clip(1.0 - x**2 - y**2, 0.0, None)
    half, middle = side / 2 * PITCH_M / contact.a, off * PITCH_M / contact.a
    inside = pressure[(np.abs(x - middle) <= half) & (np.abs(y) <= half)].sum() / pressure.sum()
    assert measured_share(force, PROBE, side, off) == pytest.approx(inside, abs=5e-3)


def test_share_of_a_strip_by_hand():
    """A window far longer than the patch whose edge runs through the middle feels half of the force."""
    assert measured_share(2.0, PROBE, 40, 20.0) == pytest.approx(0.5, abs=1e-6)
    assert measured_share(2.0, PROBE, 40, 0.0) == pytest.approx(1.0, abs=1e-4)
    assert measured_share(2.0, PROBE, 40, 30.0) == 0.0


@pytest.mark.parametrize("side", [4, 6, 8])
def test_the_true_force_is_the_one_of_which_the_target_is_inside(side):
    true = true_force_n(2.0, PROBE, side, 100.0)
    assert true * measured_share(true, PROBE, side) == pytest.approx(2.0, rel=1e-6)
    assert true_force_n(2.0, PROBE, side, 0.999 * true) is None
    stiffer = dataclasses.replace(PROBE, stiffness=10 * PROBE.stiffness)
    assert true_force_n(2.0, stiffer, side, 100.0) < true


def test_a_window_that_cuts_the_patch_is_a_warning_with_numbers():
    small = canprobe.plan(change(load_scene("cylinder"), sensor={"window": 6}))
    (warning,) = small.warnings
    for part in ("6.7 taxels across", "at 2 N", "94 % of that force", "carried on", "errs by up to 10 %", "window = 8"):
        assert part in warning
    assert f"\nwarning: {warning}\n" in plan_text(small)
    assert small.as_dict()["warnings"] == [warning]


@pytest.mark.parametrize("name", ["cylinder", "foam", "steel", "calibrate", "listen", "free", "miscalibrated"])
def test_packaged_scenes_have_nothing_to_warn_of(name):
    assert canprobe.plan(load_scene(name)).warnings == ()


def test_more_than_the_force_limit_unfelt_is_refused(tmp_path, capsys):
    foam = change(load_scene("foam"), sensor={"window": 4})
    error = refused(foam)
    assert "more than limits.force_max_n = 5 N can press" in error.problems[0]
    assert error.ways_out == ("sensor.window = 10", "a smaller task.force_n")
    assert "up to 0.29 N" in canprobe.plan(change(foam, task={"force_n": 0.2})).warnings[0]
    (tmp_path / "foam.toml").write_text(dump_scene(foam))
    assert main(["plan", str(tmp_path / "foam.toml"), "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert document["fits"] is False and document["problems"] == list(error.problems)
    assert document["ways_out"] == list(error.ways_out)


def test_features_and_the_whole_image_cut_nothing():
    for mode in ("features", "image"):
        assert cut_patch(resolve(change(load_scene("foam"), sensor={"mode": mode, "window": 4}))) is None


def test_errors_on_the_wire_are_a_warning():
    """135 bits: 31 more for the error, and 1 - (1 - 1e-3)^135 of them are hit."""
    (warning,) = canprobe.plan(change(load_scene("free"), bus={"bit_error_rate": 1e-3})).warnings
    assert "up to 166 µs" in warning and f"{100 * (1 - math.exp(135 * math.log1p(-1e-3))):.2g} % of the" in warning
