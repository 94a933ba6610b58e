"""The bound of study `estimators`: its ground is exact, its cases are those promised, and what is wrong is said."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.lab.studies.bound import METHODS, all_cases, findings, verdict
from canprobe.lab.studies.ground import PATHS, SURFACES, make_ground


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("surface", SURFACES)
def test_the_ground_is_exact(surface, path):
    g = make_ground(surface, 0.03, path, 0.02, 400)
    steps, along = np.diff(g.points, axis=0), g.normals[1:] + g.normals[:-1]
    assert np.abs(np.einsum("ij,ij->i", steps, along)).max() < 1e-9  # normals stand on the path
    assert np.linalg.norm(steps, axis=1).sum() == pytest.approx(0.02, rel=0.1)
    assert np.allclose(g.points[-1], 0.0, atol=1e-15)
    assert np.allclose(g.normals[-1], [0.0, 0.0, -1.0], atol=1e-12)
    # K by differences of normals over a path that is short against the radii, also at a place off the contact
    small = make_ground(surface, 0.03, path, 3e-6, 400)
    K = np.linalg.lstsq(small.points[:, :2], small.normals[:, :2], rcond=None)[0]
    assert np.allclose(K, g.K, atol=0.01)
    assert np.allclose(g.tensor(np.zeros(3))[:2, :2], g.K, atol=1e-9)
    # along the path: dn = K dp, the tensor taken half-way
    for i in (50, 200):
        half = 0.5 * (g.points[i] + g.points[i + 1])
        assert np.allclose(g.tensor(half) @ steps[i], g.normals[i + 1] - g.normals[i], atol=2e-5)


def test_an_unknown_surface_is_named():
    with pytest.raises(UsageError, match="surface"):
        make_ground("cube", 0.1, "weave", 0.02, 10)
    with pytest.raises(UsageError, match="path"):
        make_ground("plane", 0.1, "spiral", 0.02, 10)


def test_the_table_says_what_is_wrong():
    good = {"surface": "cylinder", "path": "weave", "size_mm": 40.0, "sigma_point_um": 20.0, "observed": 1.0}
    good |= {"inside": True, "ratio": 1.0, "bias": 0.0, "coverage": 0.95}
    rows = [good | {"method": method} for method in METHODS]
    rows.append(rows[0] | {"ratio": 3.0, "coverage": 0.5})
    rows = [row | {"verdict": verdict(row, 200)} for row in rows]
    assert [row["verdict"] for row in rows] == ["good", "good", "error, overconfident"]
    said = findings(rows)
    assert any("out of line: cylinder" in line and "overconfident" in line for line in said)


def test_cases_are_what_was_promised():
    cases = list(all_cases())
    assert len(cases) == len(set(cases))
    assert {c.surface for c in cases} == set(SURFACES)
    assert min(c.size for c in cases) == 0.005
    assert max(c.size for c in cases) == 1.0
    assert {(c.sigma_point, c.sigma_normal) for c in cases} >= {(5e-6, 2e-4), (100e-6, 5e-3)}
