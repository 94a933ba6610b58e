"""Explorations of ridges, steps and bumps that no setting was found on: heights as stated, ends with their true reason.

A probe of 40 mm touches all of these grounds: nowhere are they as hollow as it is.
"""

from __future__ import annotations

import numpy as np
import pytest

import canprobe

SPACING_MM = 0.5
X, Y = np.meshgrid(*(np.arange(-24.0, 24.1, SPACING_MM),) * 2, indexing="ij")
DOME = -(X**2 + Y**2) / (2.0 * 90.0)


def bump(x, y, height):
    return height * np.exp(-((X - x) ** 2 + (Y - y) ** 2) / (2.0 * 5.0**2))


FORMS = {
    "ridge": 0.5 * np.exp(-((0.92 * X + 0.39 * Y - 4.0) ** 2) / (2.0 * 5.0**2)),
    "step": 0.15 * np.tanh((X - 4.0) / 4.0),
    "two bumps": bump(6.0, 3.0, 0.6) + bump(-6.0, -4.0, 0.5),
}


@pytest.mark.slow(reason="whole explorations")
@pytest.mark.parametrize("form", FORMS)
def test_heights_of_a_form_are_as_exact_as_stated_and_its_end_has_its_true_reason(form, tmp_path):
    heights = DOME + FORMS[form]
    np.savez(tmp_path / "heights.npz", heights=heights - heights[len(X) // 2, len(X) // 2], spacing=SPACING_MM)
    keys = {
        "object": {"kind": "heights", "file": str(tmp_path / "heights.npz"), "position_mm": (-170.0, -175.0, 300.0)},
        "task.length_mm": 24.0,
        "task.width_mm": 18.0,
    }
    summary = canprobe.run("explore", keys, bus="direct", files=False).summary
    surface, explored = summary["shape"]["map"], summary["explore"]
    assert surface["within_2_sigma_relative_fraction"] > 0.85 and surface["rms_error_um"] < 30.0
    assert explored["closed_fraction"] == 0.0 and (explored["sigma_max_um"] < 12.0) is explored["reached"]
    if not explored["reached"]:
        assert "its curvature changes within a contact patch" in explored["why_not"]
        assert "time was over" not in explored["why_not"] and explored["time_s"] < 20.0
