"""The geometry of arrays: where taxels are, and what area they stand for."""

import math

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import Pad, PatchCalibration, compute_patch


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


def test_a_grid_with_two_distances_is_a_list_of_rectangles() -> None:
    pad = Pad.of_grid(3, 5, (2e-3, 4.5e-3), mount_radius_m=None)
    assert not pad.is_grid and pad.uv[1] - pad.uv[0] == pytest.approx([2e-3, 0.0])
    assert pad.uv[5] - pad.uv[0] == pytest.approx([0.0, 4.5e-3])
    assert pad.areas == pytest.approx(np.full(15, 9e-6)) and pad.half_sides_m == pytest.approx([5e-3, 6.75e-3])
    assert pad.reach_m == pytest.approx(5e-3)
    square = Pad.of_grid(3, 5, (2e-3, 2e-3))
    assert square.is_grid and square.half_sides_m == pytest.approx([5e-3, 3e-3])


def test_a_list_on_a_sphere_covers_it_as_a_grid_does() -> None:
    grid = Pad(mount_radius_m=0.03)
    places = np.c_[grid.uv, np.zeros(grid.taxels)]
    assert Pad(mount_radius_m=0.03, positions=places).areas == pytest.approx(grid.areas)


@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_the_rim_of_a_list_is_its_outermost_taxels(turn: float) -> None:
    """A square of 8 × 8, turned: its outer ring or, where a corner points along a direction, a part of it; no other."""
    grid = Pad(8, 8, 2e-3)
    c, s = math.cos(turn), math.sin(turn)
    places = np.c_[grid.uv @ np.array(((c, s), (-s, c))), np.zeros(64)]
    rim = set(Pad(8, 8, 2e-3, positions=places).sides.any(axis=0).nonzero()[0].tolist())
    ring = {8 * row + column for row in range(8) for column in range(8) if {row, column} & {0, 7}}
    assert rim <= ring and {0, 7, 56, 63} <= rim
    if not turn:
        assert rim == ring


def test_a_contact_at_the_rim_of_a_list_leaves_it() -> None:
    pad = Pad(8, 8, 2e-3, positions=np.c_[Pad(8, 8, 2e-3).uv, np.zeros(64)])
    calibration = PatchCalibration(pad)
    image = np.zeros((8, 8), np.uint8)
    image[3:5, 3:5] = 100
    assert not compute_patch(image, calibration).off_pad
    image[3:5, 6:8] = 200
    assert compute_patch(image, calibration).off_pad


def test_a_list_whose_taxels_are_all_outermost_does_not_show_where_a_contact_ends() -> None:
    pad = Pad(2, 2, 2e-3, positions=np.c_[Pad(2, 2, 2e-3).uv, np.zeros(4)])
    assert not compute_patch(np.full((2, 2), 100, np.uint8), PatchCalibration(pad)).off_pad


@pytest.mark.parametrize("listed", [False, True])
@pytest.mark.parametrize(("rows", "leaves"), [(slice(0, 8), True), (slice(0, 6), False), (slice(1, 7), False)])
def test_a_contact_across_the_whole_pad_goes_on_beyond_it_though_no_edge_has_its_highest_pressure(
    rows: slice, leaves: bool, listed: bool
) -> None:
    image = np.zeros((8, 8), np.uint8)
    image[rows, 3:5] = 100
    image[4, 4] = 180
    pad = Pad(8, 8, 2e-3)
    if listed:
        pad = Pad(8, 8, 2e-3, positions=np.c_[pad.uv, np.zeros(64)])
    assert compute_patch(image, PatchCalibration(pad)).off_pad is leaves
    assert compute_patch(image.T.copy(), PatchCalibration(pad)).off_pad is leaves
