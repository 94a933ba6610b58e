"""Surface maps as files: what is written is read back bit by bit, and nothing else is read."""

import math

import numpy as np
import pytest

import canprobe
from canprobe.cell.results.surface_file import load_surface_map, save_surface_map
from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.errors import UsageError
from canprobe.mechanics.touch import UncertainMatrix, fit_surface
from canprobe.mechanics.touch.map import nodes
from canprobe.mechanics.touch.map.fit import fit_map
from canprobe.mechanics.touch.map.local_fits import PadLayer
from canprobe.mechanics.touch.map.noise import PAD_NOISE
from canprobe.mechanics.touch.map.stiffness import Stiffness
from canprobe.mechanics.touch.map.surface_map import SurfaceMap

PLACES = np.array([[1e-3, 2e-3, 0.0], [-3e-3, 1e-3, 0.1e-3]])


@pytest.fixture(scope="module")
def surface_map():
    """A pad over a plane, some of its contacts without an image, and a layer softer than stated."""
    rng = np.random.default_rng(0)
    x, y = np.linspace(-8e-3, 8e-3, 120), np.array([-2e-3, 0.0, 2e-3])
    points = np.array([[a, b, 0.0] for b in y for a in x]) + 2e-5 * rng.normal(size=(360, 3))
    made = SurfaceMap(PadLayer(0.04, 1.2e8), PAD_NOISE)
    made.add(points, [[0.0, 0.0, 1.0]] * 360, np.full(360, 2.0))
    rows = made.nodes.rows
    rows[::3, nodes.PATCH] = 2e-5
    return SurfaceMap.of_nodes(rows, made.pad, made.noise, Stiffness(1.0e8, 0.03))


def test_what_is_written_is_read_back(surface_map, tmp_path):
    path = tmp_path / "some.map"
    save_surface_map(surface_map, path)
    assert [file.name for file in tmp_path.iterdir()] == ["some.map"]
    again = canprobe.load_surface_map(path)
    np.testing.assert_array_equal(again.nodes.rows, surface_map.nodes.rows)
    for name in ("pad", "noise", "stiffness"):
        assert getattr(again, name) == getattr(surface_map, name)
    np.testing.assert_array_equal(again.distance(PLACES), surface_map.distance(PLACES))
    np.testing.assert_array_equal(again.curvature(PLACES).covariance, surface_map.curvature(PLACES).covariance)


def test_a_map_that_was_read_takes_more_contacts(surface_map, tmp_path):
    save_surface_map(surface_map, tmp_path / "a.npz")
    again = load_surface_map(tmp_path / "a.npz")
    again.add([[0.02, 0.0, 0.0]], [[0.0, 0.0, 1.0]], [2.0])
    assert len(again) == len(surface_map) + 1
    assert np.isfinite(again.distance([[0.02, 0.0, 0.0]])).all()
    again.add(surface_map.points[5:6], [[0.0, 0.0, 1.0]], [2.0])
    again.add([[0.04, 0.0, 0.0]], [[0.0, 0.0, 1.0]], [2.0])
    assert len(again) == len(surface_map) + 2  # ground that the file knew before is averaged


def test_a_map_of_points_and_one_of_nothing_are_maps(tmp_path):
    points = fit_map(PLACES, [[0.0, 0.0, 1.0]] * 2, sigma_normal=math.inf)
    save_surface_map(points, tmp_path / "points.npz")
    again = load_surface_map(tmp_path / "points.npz")
    assert (again.pad, again.stiffness, again.noise) == (None, None, points.noise)
    save_surface_map(SurfaceMap(None, PAD_NOISE), tmp_path / "surface.npz")
    assert len(load_surface_map(tmp_path)) == 0  # the folder of a run will do


def test_all_of_s_of_the_answers_is_in_the_file(surface_map, tmp_path):
    rng = np.random.default_rng(0)
    grid = [[x, y, 0.0] for x in (-5e-3, 0.0, 5e-3) for y in (-5e-3, 0.0, 5e-3)]
    points = np.array(grid) + 1e-5 * rng.normal(size=(9, 3))
    some = fit_surface(points, [[0.0, 0.0, 1.0]] * 9, sigma_point=1e-5, sigma_normal=1e-3)
    few = fit_surface(points[:3], [[0.0, 0.0, 1.0]] * 3, sigma_point=1e-5, sigma_normal=1e-3)
    answers = [ShapeRecord(0.1 * i, 0.0, answer, 0.0) for i, answer in enumerate((few, some))]
    path = tmp_path / "surface.npz"
    save_surface_map(surface_map, path, answers)
    with np.load(path) as saved:
        assert saved["answer_t_s"].tolist() == [0.0, 0.1]
        assert np.isnan(saved["answer_S"][0, 0, 0]) and np.isinf(saved["answer_covariance"][0, 0, 0])
        again = UncertainMatrix(saved["answer_S"][1], saved["answer_covariance"][1])
        in_base = again.transformed(np.linalg.inv(saved["answer_T_base_contact_m"][1]))
    for got, wanted in zip(in_base, some.matrix(np.eye(4)), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-6, atol=1e-9)
    assert len(load_surface_map(path)) == len(surface_map)


def test_a_file_of_the_form_before_is_read(surface_map, tmp_path):
    path = tmp_path / "surface.npz"
    save_surface_map(surface_map, path)
    answers = [name for name in np.load(path).files if name.startswith("answer_")]
    _rewrite(path, format_version=lambda _: np.array(3), **dict.fromkeys(answers))
    np.testing.assert_array_equal(load_surface_map(path).nodes.rows, surface_map.nodes.rows)
    _rewrite(path, format_version=lambda _: np.array(4))
    with pytest.raises(UsageError, match="missing answer_t_s"):
        load_surface_map(path)


def _rewrite(path, **changes):
    """Change columns of a file: a function of the old one, or None to leave it out."""
    with np.load(path) as saved:
        columns = {name: saved[name] for name in saved.files}
    for name, change in changes.items():
        if change is None:
            del columns[name]
        else:
            columns[name] = change(columns.get(name))
    np.savez(path, **columns)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"format_version": lambda _: 1},
            r'expected format_version 4, got 1 of another canprobe; .*canprobe\.replay\(".*"\)\.surface_map',
        ),
        ({"format_version": None}, "without 'format_version'"),
        ({"normal": None, "path_m": None}, "missing normal, path_m"),
        ({"colour": lambda _: np.zeros(3)}, "unknown colour; expected format_version, pad_radius_m"),
        ({"pad_axes": lambda c: c[:, :2]}, r"pad_axes: expected float64 of shape \(\d+, 3, 3\), got float64"),
        ({"contacts": lambda c: c[:2]}, r"expected float64 of shape \(2"),
        ({"contacts": lambda _: np.array(1.0)}, r"expected float64 of shape \(0"),
        ({"heading": lambda c: c.astype(np.float32)}, "heading: expected float64 .* got float32"),
        ({"centre_m": lambda c: c * np.nan}, "centre_m: expected finite numbers, got nan"),
        ({"normal": lambda c: 2.0 * c}, "normal: expected unit vectors"),
        ({"contacts": lambda c: 0.0 * c}, "contacts: expected numbers above 0, got 0"),
        ({"lateral_variance_m2": lambda c: c * np.inf}, "lateral_variance_m2: expected numbers above 0, got inf"),
        ({"stiffness_n_m3": lambda c: -c}, "stiffness_n_m3: expected numbers above 0, or NaN"),
    ],
)
def test_wrong_files_are_refused(surface_map, tmp_path, changes, message):
    path = tmp_path / "surface.npz"
    save_surface_map(surface_map, path)
    _rewrite(path, **changes)
    with pytest.raises(UsageError, match=message) as refused:
        load_surface_map(path)
    assert str(path) in str(refused.value)


def test_what_is_no_npz_is_refused(tmp_path):
    (tmp_path / "text").write_bytes(b"not a map")
    with pytest.raises(UsageError, match="text: expected an npz file with a surface map; cannot be read: "):
        load_surface_map(tmp_path / "text")
    with pytest.raises(UsageError, match=r"surface\.npz: no such file; a run writes"):
        load_surface_map(tmp_path)
