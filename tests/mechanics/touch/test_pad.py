"""The geometry of arrays: where taxels are, and what area they stand for."""

import math

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch.pad import Pad


def test_a_wrapped_grid_covers_the_cap_of_its_sphere() -> None:
    pad = Pad(rows=160, columns=160, pitch_m=0.25e-3, mount_radius_m=0.03)
    half, R = 0.015, 0.03
    inside = np.hypot(*pad.uv.T) <= half
    cap = 2 * math.pi * R**2 * (1 - math.cos(half / R))  # closed form of a spherical cap of this arc
    assert pad.areas[inside].sum() == pytest.approx(cap, rel=0.005)
    assert pad.uv[0] == pytest.approx([-0.019875, -0.019875]) and pad.reach_m == 0.02


def test_columns_run_along_u_and_rows_along_v() -> None:
    pad = Pad(rows=4, columns=6, pitch_m=4.7e-3, mount_radius_m=None)
    assert pad.uv[1] - pad.uv[0] == pytest.approx([4.7e-3, 0.0])
    assert pad.uv[6] - pad.uv[0] == pytest.approx([0.0, 4.7e-3])
    assert pad.areas == pytest.approx(np.full(24, 4.7e-3**2), rel=1e-5) and pad.is_flat


def test_a_list_of_taxels_keeps_its_places_and_tilts() -> None:
    places = np.array([[0.0, 0.0, 0.0], [0.01, 0.0, -0.001]])
    tilted = np.array([[0.0, 0.0, 1.0], [math.sin(0.3), 0.0, math.cos(0.3)]])
    pad = Pad(1, 2, 6.5e-3, mount_radius_m=None, positions=places, normals=tilted)
    assert not pad.is_grid and pad.uv.tolist() == places[:, :2].tolist()
    assert pad.areas[1] / pad.areas[0] == pytest.approx(math.cos(0.3))
    with pytest.raises(UsageError, match="expected 3 points of 3 coordinates"):
        Pad(1, 3, 6.5e-3, positions=places)
