"""Surface maps as files: what is written is read back bit by bit, and nothing else is read."""

import numpy as np
import pytest

import canprobe
from canprobe.cell.results.surface_file import FORMAT_VERSION, load_surface_map, save_surface_map
from canprobe.errors import UsageError
from canprobe.mechanics.touch.estimate.fit import fit_surface
from canprobe.mechanics.touch.surface_map import LocalPatch, SurfaceMap


@pytest.fixture(scope="module")
def surface_map():
    """Patches of three kinds: all observed, two of three combinations, and from a method without pose."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(-8e-3, 8e-3, (2, 80))
    patches = []
    for i, (across, method) in enumerate(((v, "ml"), (0 * v, "ml"), (v, "chord"))):
        normals = np.stack([u, across, np.full_like(u, 0.05)], axis=1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points = 0.05 * normals + 1e-5 * rng.normal(size=normals.shape)
        estimate = fit_surface(points, normals, sigma_point=2e-5, sigma_normal=1e-3, method=method)
        patches.append(LocalPatch.of(estimate, t_s=0.1 * i, travelled_m=2e-3 * i))
    assert [patch.rank for patch in patches] == [3, 2, 3]
    return SurfaceMap(patches=tuple(patches), path=rng.normal(size=(7, 3)), method="ml")


def test_what_is_written_is_read_back(surface_map, tmp_path):
    path = tmp_path / "some.map"
    save_surface_map(surface_map, path)
    assert [file.name for file in tmp_path.iterdir()] == ["some.map"]
    assert canprobe.load_surface_map(path).equals(surface_map)


def test_an_empty_map_is_a_map(tmp_path):
    empty = SurfaceMap(patches=(), path=np.zeros((0, 3)))
    save_surface_map(empty, tmp_path / "surface.npz")
    assert load_surface_map(tmp_path).equals(empty)  # the folder of a run will do


def test_a_difference_is_seen(surface_map, tmp_path):
    save_surface_map(surface_map, tmp_path / "a.npz")
    _rewrite(tmp_path / "a.npz", innovation=lambda column: column + np.array([0.0, 0.0, 1e-15]))
    assert not load_surface_map(tmp_path / "a.npz").equals(surface_map)


def test_columns_can_be_read_without_canprobe(surface_map, tmp_path):
    save_surface_map(surface_map, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz", allow_pickle=False) as columns:
        assert int(columns["format_version"]) == FORMAT_VERSION
        assert columns["T_base_contact_m"].shape == (3, 4, 4)
        np.testing.assert_array_equal(columns["S_per_m"][1], surface_map.patches[1].S)
        assert np.isnan(columns["combinations"][1, 2]).all()


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
        ({"format_version": lambda _: 2}, "expected format_version 1, got 2"),
        ({"format_version": None}, "without 'format_version'"),
        ({"S_per_m": None, "t_s": None}, "missing t_s, S_per_m"),
        ({"colour": lambda _: np.zeros(3)}, "unknown colour; expected format_version, method"),
        (
            {"S_per_m": lambda c: c[:, :3]},
            r"S_per_m: expected float64 of shape \(3, 4, 4\), got float64 of \(3, 3, 4\)",
        ),
        ({"t_s": lambda c: c[:2]}, r"expected float64 of shape \(2"),
        ({"t_s": lambda _: np.array(1.0)}, r"t_s: expected float64 of shape \(0,\), got float64 of \(\)"),
        ({"path_m": lambda c: c.astype(np.float32)}, "path_m: expected float64 .* got float32"),
        ({"S_covariance_si": lambda c: c * [[[np.nan]]]}, "patch 0: S_covariance: expected finite numbers"),
        ({"travelled_m": lambda c: c[::-1]}, r"patches\[1\].travelled_m: expected at least"),
        ({"method": lambda _: np.array([1.0])}, "method: expected a name, got float64"),
        ({"method": lambda _: np.array({"a": 1}, dtype=object)}, "cannot be read: method.npy holds Python objects"),
    ],
)
def test_wrong_files_are_refused(surface_map, tmp_path, changes, message):
    path = tmp_path / "surface.npz"
    save_surface_map(surface_map, path)
    _rewrite(path, **changes)
    with pytest.raises(UsageError, match=message) as refused:
        load_surface_map(path)
    assert str(path) in str(refused.value)


def test_what_is_no_npz_is_refused(surface_map, tmp_path):
    whole = tmp_path / "whole.npz"
    save_surface_map(surface_map, whole)
    for name, content in {
        "empty": b"",
        "text": b"not a map",
        "cut": whole.read_bytes()[:2000],
        "garbled": whole.read_bytes()[:700] + bytes(300) + whole.read_bytes()[1000:],
    }.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UsageError, match=f"{name}: expected an npz file"):
            load_surface_map(tmp_path / name)
    np.save(tmp_path / "single.npy", np.zeros(3))
    with pytest.raises(UsageError, match="expected an npz file with a surface map; cannot be read: a single array"):
        load_surface_map(tmp_path / "single.npy")
    with pytest.raises(UsageError, match=r"surface\.npz: no such file; a run writes"):
        load_surface_map(tmp_path)
