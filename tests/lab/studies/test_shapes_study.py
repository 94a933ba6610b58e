"""Study `shapes`: its Gaussian process and local fits against closed forms, its scores on known surfaces, short run."""

import hashlib
import json
import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from canprobe.cli import main
from canprobe.lab.studies.harness import Column
from canprobe.lab.studies.shapes import revisits
from canprobe.lab.studies.shapes.implicit import ImplicitSurface, Touched, fit_quadric, rbf, thin_plate
from canprobe.lab.studies.shapes.methods import METHODS, ProcessSurface
from canprobe.lab.studies.shapes.patches import LocalPatch, PatchSurface
from canprobe.lab.studies.shapes.scans import (
    DEVELOPMENT,
    TEST,
    columns_of,
    drawn,
    form_of,
    heights_mm,
    object_of,
    reached,
    samples_of,
    scene_of,
    truth_under,
)
from canprobe.lab.studies.shapes.study import COLUMNS, distance_from, findings, over_map, row_of, scored
from canprobe.mechanics.touch.contact import ContactSample, Doubt, Slope
from canprobe.mechanics.touch.meshing import mesh_of
from canprobe.mechanics.touch.objects import Sphere, Torus
from canprobe.mechanics.touch.surface import SurfaceMatrix

RADIUS = 0.05
KERNELS = pytest.mark.parametrize(("kernel", "length"), [(rbf, 0.03), (thin_plate, 0.1)])


def on_ball(count, seed=0, noise=0.0, half=8e-3):
    """Contacts on a ball with its top at the origin; noise of heights, m, and of normals, 20 times as many rad."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-half, half, (2, count))
    n = np.stack([x / RADIUS, y / RADIUS, np.sqrt(1 - (x**2 + y**2) / RADIUS**2)], axis=1)
    p = RADIUS * n - [0, 0, RADIUS] + noise * rng.normal(size=(count, 1)) * n
    m = n + 20 * noise * rng.normal(size=(count, 3))
    m /= np.linalg.norm(m, axis=1)[:, None]
    return Touched(p, m, np.full(count, max(noise, 1e-7)), np.full(count, max(20 * noise, 1e-6)))


def differences(kernel, length, x, y, scale=5e-3):
    """The covariance of values and gradients at x and y from differences of the kernel alone."""

    h = 1e-5

    def k(a, b):
        return float(kernel(np.array([math.dist(a, b)]), scale, length)[0][0])

    C = np.zeros((len(x), 4, len(y), 4))
    for i, a in enumerate(x):
        for j, b in enumerate(y):
            C[i, 0, j, 0] = k(a, b)
            for u, e in enumerate(h * np.eye(3)):
                C[i, 1 + u, j, 0] = (k(a + e, b) - k(a - e, b)) / (2 * h)
                C[i, 0, j, 1 + u] = (k(a, b + e) - k(a, b - e)) / (2 * h)
                for v, g in enumerate(h * np.eye(3)):
                    four = k(a + e, b + g) - k(a + e, b - g) - k(a - e, b + g) + k(a - e, b - g)
                    C[i, 1 + u, j, 1 + v] = four / (4 * h * h)
    return C.reshape(4 * len(x), 4 * len(y))


@KERNELS
def test_the_process_is_that_of_its_kernel(kernel, length):
    """Mean, σ and likelihood from the textbook's formulae, with covariances from differences of the kernel."""
    touched = on_ball(5)._replace(sigma_point=np.full(5, 1e-4), sigma_normal=np.full(5, 0.02))
    process = ImplicitSurface(kernel, 5e-3, length, touched)
    x = np.array([[1e-3, 2e-3, 1e-3], [-4e-3, 3e-3, -1e-3]])
    up = touched.normals.mean(axis=0) / np.linalg.norm(touched.normals.mean(axis=0))
    middle = touched.points.mean(axis=0)
    y = np.column_stack([-(touched.points - middle) @ up, touched.normals - up]).ravel()
    C = differences(kernel, length, touched.points, touched.points)
    C += np.diag(np.tile([1e-8, 4e-4, 4e-4, 4e-4], 5))
    c = differences(kernel, length, x, touched.points)
    mean = (c @ np.linalg.solve(C, y)).reshape(-1, 4)
    f, g = process.value(x)
    np.testing.assert_allclose(f, mean[:, 0] + (x - middle) @ up, atol=2e-7)
    np.testing.assert_allclose(g, mean[:, 1:] + up, atol=2e-4)
    k0 = float(kernel(np.zeros(1), 5e-3, length)[0][0])
    variance = k0 - np.einsum("ij,ji->i", c[::4], np.linalg.solve(C, c[::4].T))
    np.testing.assert_allclose(process.sigma(x), np.sqrt(variance), rtol=2e-2)
    assert process.log_likelihood == pytest.approx(multivariate_normal(np.zeros(20), C).logpdf(y), rel=5e-3)


@pytest.mark.parametrize(("kernel", "length", "limit"), [(rbf, 0.03, (1e-6, 1.0)), (thin_plate, 0.1, (2e-5, 5.0))])
def test_the_process_of_a_ball_is_the_ball(kernel, length, limit):
    touched = on_ball(60)
    surface = ProcessSurface(ImplicitSurface(kernel, 3e-3, length, touched), touched.points)
    mesh = mesh_of(surface.closest, touched.points[:1], 1e-3)
    assert len(mesh.vertices) > 200
    inner = np.abs(mesh.vertices[:, :2]).max(axis=1) < 6e-3
    away = np.linalg.norm(mesh.vertices + np.array([0, 0, RADIUS]), axis=1) - RADIUS
    assert np.abs(away[inner]).max() < limit[0]
    curvature = surface.curvature(mesh.vertices[inner])
    true = (np.eye(3) - mesh.normals[inner, :, None] * mesh.normals[inner, None]) / RADIUS
    assert np.sqrt(((curvature - true) ** 2).sum(axis=(1, 2)).mean()) < limit[1]
    assert np.isnan(surface.closest(np.array([[0.03, 0.0, -0.01]])).height).all()


def test_a_local_fit_has_the_error_that_it_states():
    errors = []
    for seed in range(60):
        T, K, C = fit_quadric(
            np.zeros(3),
            np.array([0.0, 0.0, 1.0]),
            on_ball(80, seed, 2e-5, 2e-3),  # of so little of it a ball is a paraboloid
        )
        assert T[:3, 3] @ [0, 0, 1] == pytest.approx(0.0, abs=2e-5)
        errors.append((np.array([K[0, 0], K[0, 1], K[1, 1]]) - [1 / RADIUS, 0, 1 / RADIUS]) / np.sqrt(np.diag(C)[3:]))
    assert np.std(errors) == pytest.approx(1.0, abs=0.2)
    assert fit_quadric(np.zeros(3), np.array([0.0, 0.0, 1.0]), on_ball(1)) is None


def ball_patches(lift=0.0, sigma=1e-5):
    """Exact patches over the top of a ball, all lifted by as much."""
    surface = SurfaceMatrix.sphere(RADIUS).transformed(np.diag([1.0, -1.0, -1.0, 1.0]))
    patches = []
    for x, y in np.stack(np.meshgrid(*2 * [np.arange(-8e-3, 8.1e-3, 2e-3)]), -1).reshape(-1, 2):
        T = surface.contact_frame(surface.project([x, y, 0.0]))
        T[:3, 3] -= lift * T[:3, 2]
        P = np.diag([1e-14, 1e-14, sigma**2, *6 * [1e-6]])
        patches.append(LocalPatch(T, SurfaceMatrix.sphere(RADIUS).S, P))
    return patches


def score_of(patches, truth):
    surface = PatchSurface(patches)
    return scored(surface, mesh_of(surface.closest, surface.points, 1e-3), truth)


def test_surfaces_that_are_known_have_the_scores_that_they_must():
    exact = ball_patches()
    truth = truth_under(Sphere(np.eye(4), RADIUS), np.repeat(PatchSurface(exact).points, 4, axis=0))
    assert not truth["truth_edge"].any()
    best = score_of(exact, truth)
    assert best["accuracy_um"] < 0.1
    assert best["completeness_um"] < 0.1
    assert [best[f"f_{mm:g}mm"] for mm in (0.05, 0.1, 0.2, 0.5)] == [1.0] * 4
    assert (best["coverage"], best["missed"]) == (1.0, 0.0)
    assert best["nll"] == pytest.approx(math.log(0.01 * math.sqrt(2 * math.pi)), abs=0.05)
    assert best["normal_mrad"] < 0.01
    assert best["curvature_per_m"] < 2.0  # of the nearest patch: its normal is turned by up to 30 mrad
    high = score_of(ball_patches(lift=0.15e-3), truth)
    assert high["accuracy_um"] == pytest.approx(150, rel=0.01)
    assert high["completeness_um"] == pytest.approx(150, rel=0.01)
    assert [high[f"f_{mm:g}mm"] for mm in (0.05, 0.1, 0.2, 0.5)] == [0.0, 0.0, 1.0, 1.0]
    assert high["coverage"] == 0.0
    half = score_of(exact[:45], truth)
    assert half["accuracy_um"] < 0.1  # what is there is right,
    assert 0.2 < half["missed"] < 0.5
    assert half["completeness_um"] == pytest.approx(1e3 * half["missed"], rel=0.01)  # and what is not there counts
    nothing = score_of([], truth)
    assert (nothing["f_0.5mm"], nothing["missed"], nothing["nll"]) == (0.0, 1.0, None)


def test_distances_from_sampled_truth_are_those_of_the_shape():
    torus = Torus(np.eye(4), 0.1, 0.032)
    walk = np.column_stack([np.linspace(-0.01, 0.01, 40), np.linspace(-6e-3, 6e-3, 40), np.zeros(40)])
    truth = truth_under(torus, np.repeat(walk, 4, axis=0))
    points = walk + np.random.default_rng(0).uniform(-1e-3, 1e-3, walk.shape)
    found = distance_from(truth["truth_point"], truth["truth_normal"], truth["truth_tensor"].reshape(-1, 3, 3), points)
    np.testing.assert_allclose(found, [torus.nearest(tuple(p)).distance for p in points], atol=3e-7)


def test_contacts_are_read_as_they_were_felt():
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.2, 0.3
    whole = ContactSample(
        0.5, np.arange(3.0), np.array([0.0, 0.0, 1.0]), T, np.arange(3.0), 2.0, 2e-5, None, (1e-6, 0.0, 2e-6),
        (Doubt.CUT, Doubt.DEAD), 1e-6, Slope(3.0, 0.1), 1e-5, 1.5e-5,
    )  # fmt: skip
    bare = ContactSample(0.6, np.arange(3.0), np.array([0.0, 0.0, 1.0]), T, np.arange(3.0), 2.0)
    read = samples_of({k: np.array(v) for k, v in json.loads(json.dumps(_plain(columns_of([whole, bare])))).items()})
    for sample, again in zip((whole, bare), read, strict=True):
        for name in ContactSample.__slots__:
            np.testing.assert_equal(getattr(again, name), getattr(sample, name))


def _plain(columns):
    return {key: values.tolist() for key, values in columns.items()}


def test_shapes_are_the_same_ones_each_time(tmp_path):
    assert (len(DEVELOPMENT), len(TEST)) == (8, 12)
    np.testing.assert_array_equal(heights_mm("groove", 2), heights_mm("groove", 2))
    assert np.abs(heights_mm("groove", 2) - heights_mm("groove", 5)).max() > 0.3
    objects = [object_of(name, tmp_path) for name in (*DEVELOPMENT, *TEST)]
    assert len({(o.kind, o.radius_mm, o.radius_x_mm, o.amplitude_mm, o.file) for o in objects}) == 20


def test_the_words_name_what_is_better():
    method = METHODS[0]
    scores = [{"accuracy_um": 10.0, "nll": None}, {"accuracy_um": 20.0, "nll": -1.0}]
    row = row_of(method, 5.0, scores)
    assert (row["accuracy_um"], row["accuracy_um_low"], row["accuracy_um_high"]) == (15.0, 10.0, 20.0)
    assert math.isnan(row["nll"])
    keys = [c.key for c in COLUMNS if isinstance(c, Column)]
    base = {**dict.fromkeys(keys, 1.0), "unit": "mm"}
    rows = [base | {"method": "map"}, base | {"method": "quadrics", "accuracy_um": 0.5, "nll": 2.0}]
    each = [[rows[0], rows[0] | {"coverage": 0.8}], [rows[1] | {"accuracy_um": 0.4}, rows[1] | {"accuracy_um": 0.6}]]
    said = findings(rows, each, "free-2")
    assert any(line.startswith("  accuracy: quadrics better") and "0.5 (0.4 to 0.6)" in line for line in said)
    assert any(line.startswith("  NLL: map better") for line in said)
    assert any(line.startswith("  F at 0.5 mm: as good") for line in said)
    assert "90.0% hold the truth; on the worst shape 80.0%" in said[-1]
    apart = over_map(each[1], each[0])
    assert apart["accuracy_um_over_map"] == pytest.approx(-0.5)
    assert (apart["nll_over_map_low"], apart["nll_over_map_high"]) == (1.0, 1.0)


def test_the_words_on_revisits_name_the_least_good(tmp_path):
    row = {"shape": "a", "share": 0.4, "own_per_m": 1.0, "joined_per_m": 0.5, "own_coverage": 1.0}
    rows = [row | {"joined_coverage": 0.9}, row | {"shape": "b", "joined_per_m": 2.0, "joined_coverage": 0.8}]
    (said,) = revisits.findings([*rows, {"shape": "c", "share": 0.0, "own_per_m": None}])
    assert "has 1.00 of its own error of K" in said and "better on 1, the least good is b: 1.00 and 2.00" in said
    assert "100% and 85%" in said
    revisits.draw(rows, tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_draw_is_repeated_and_like_no_other(tmp_path):
    assert len(drawn(7)) == len(TEST)
    for name, other in zip(drawn(7), drawn(8), strict=True):
        assert form_of(name) == form_of(name) != form_of(other)
        assert scene_of(name, tmp_path).seed != scene_of(other, tmp_path).seed
    assert {form_of(name)["kind"] for name in drawn(7)} == {form_of(name)["kind"] for name in TEST}


@pytest.mark.slow(reason="a whole study in its quick form")
@pytest.mark.timeout(600)  # a second of a whole cell takes long where many share a processor
def test_a_short_run_of_every_method(tmp_path, capsys):
    assert main(["study", "shapes", "--quick", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["method"] for row in document["rows"]} == {method.name for method in METHODS}
    for row in document["rows"]:
        assert row["accuracy_um"] < 100
        assert row["cpu_s"] > 0
        assert row["memory_mb"] > 1
        assert (row["coverage"] is None) == (row["method"] in ("chen1996", "chord"))
    later = json.loads((tmp_path / "shapes_after.json").read_text())
    assert {row["method"] for row in later["rows"]} == {method.name for method in METHODS}
    assert {"accuracy_um_over_map", "nll_over_map_high"} <= set(document["rows"][1])
    (back,) = json.loads((tmp_path / "shapes_revisits.json").read_text())["rows"]
    assert (back["share"], back["own_per_m"]) == (0.0, None)  # 30 mm: it came back to nothing
    digest = hashlib.sha256((tmp_path / "contacts.npz").read_bytes()).hexdigest()
    assert document["facts"]["contacts"] == digest[:16]
    assert (tmp_path / "shapes.png").stat().st_size > 10_000


def test_a_drawn_shape_that_the_arm_does_not_reach_is_left_out_with_a_line():
    said = []
    assert reached(("drawn-21-0", "drawn-21-1"), said.append) == ("drawn-21-0",)
    (line,) = said
    assert line.startswith("drawn-21-1 is left out: task: contact at") and "out of reach" in line
