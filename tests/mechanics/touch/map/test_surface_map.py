"""The map of contacts against closed forms: what it answers, what it leaves unobserved, and the σ that it states."""

import math
from dataclasses import replace

import numpy as np
import pytest

from canprobe.errors import UsageError
from canprobe.mechanics.touch import (
    PAD_NOISE,
    ContactSample,
    ImageModel,
    MapNoise,
    PadLayer,
    Slope,
    SurfaceMap,
    fit_map,
    indentation_from_force,
)
from canprobe.mechanics.touch.image.calibration import ImageParameters, MomentErrors
from canprobe.mechanics.touch.map import discs, local_fits, nodes, surface_map
from canprobe.mechanics.touch.map.quartic import LENGTH_M, SECOND_DERIVATIVES, fourth_of, heights_and_slopes, terms
from canprobe.mechanics.touch.map.stiffness import SOURCE_SIGMA
from canprobe.mechanics.touch.pad import Pad

SIGMA_POINT, SIGMA_NORMAL = 30e-6, 1e-3
LINE = np.arange(-100, 100) * 0.125e-3
STRAIGHT = np.column_stack([LINE, np.zeros_like(LINE)])
RASTER = np.concatenate([np.column_stack([s * LINE, np.full_like(LINE, y)]) for s, y in
                         zip((1, -1, 1, -1, 1), np.arange(-6e-3, 7e-3, 3e-3), strict=True)])  # fmt: skip
PLACES = np.array([[0.0, 0.0], [2e-3, 1e-3], [-4e-3, 3e-3], [5e-3, -4e-3]])


def on_quadratic(xy, k1, k2):
    """Points and outward normals of z = −½ (k1 x² + k2 y²), and the shape operator there as a tensor."""
    x, y = xy.T
    p = np.column_stack([x, y, -0.5 * (k1 * x * x + k2 * y * y)])
    g = np.column_stack([k1 * x, k2 * y, np.ones_like(x)])
    size = np.linalg.norm(g, axis=1)
    n = g / size[:, None]
    P = np.eye(3) - n[:, :, None] * n[:, None]
    return p, n, P @ np.diag([k1, k2, 0.0]) @ P / size[:, None, None]


def on_sphere(xy, radius):
    """The same of a sphere with its top (radius below 0: its bottom, seen from inside) at the origin."""
    x, y = xy.T
    n = np.column_stack([x / radius, y / radius, np.sqrt(1.0 - (x * x + y * y) / radius**2)])
    return radius * (n - [0.0, 0.0, 1.0]), n, (np.eye(3) - n[:, :, None] * n[:, None]) / radius


SHAPES = {
    "ball": lambda xy: on_sphere(xy, 0.05),
    "small ball": lambda xy: on_sphere(xy, 0.015),
    "hollow": lambda xy: on_sphere(xy, -0.06),
    "plane": lambda xy: on_quadratic(xy, 0.0, 0.0),
    "saddle": lambda xy: on_quadratic(xy, 16.0, -12.0),
}


def touched(shape, xy, scale=1.0, seed=0):
    rng = np.random.default_rng(seed)
    p, n, _ = SHAPES[shape](xy)
    return (
        p + scale * SIGMA_POINT * rng.normal(size=p.shape),
        n + scale * SIGMA_NORMAL * rng.normal(size=n.shape),
    )


def fitted(shape, xy, scale=1.0, seed=0, **sigma):
    given = {"sigma_point": scale * SIGMA_POINT, "sigma_normal": scale * SIGMA_NORMAL} | sigma
    return fit_map(*touched(shape, xy, scale, seed), **given)


@pytest.mark.parametrize("shape", ["small ball", "plane", "saddle"])
def test_a_raster_gives_height_normal_and_curvature_with_their_errors(shape):
    z = []
    for seed in range(4):
        found = fitted(shape, RASTER, seed=seed)
        p, n, tensor = SHAPES[shape](PLACES)
        height, sigma = found.distance(p)
        normal, V = found.normal(p)
        bent = found.curvature(p)
        assert (bent.rank == 3).all()
        off = np.einsum("nip,nij,njq->npq", bent.axes, bent.tensor - tensor, bent.axes)
        turned = np.einsum("nip,ni->np", bent.axes, normal - n)
        Vn = np.einsum("nip,nij,njq->npq", bent.axes, V, bent.axes)
        z.append(
            np.column_stack([
                height / sigma,
                turned / np.sqrt(Vn[:, [0, 1], [0, 1]]),
                off[:, [0, 0, 1], [0, 1, 1]] / np.sqrt(np.einsum("nii->ni", bent.covariance)),
            ])
        )  # fmt: skip
        assert np.abs(height).max() < 30e-6
        assert np.abs(off).max() < 1.5
    rms = math.sqrt((np.array(z) ** 2).mean())
    assert 0.3 < rms < 1.6


@pytest.mark.parametrize("shape", ["small ball", "hollow"])
def test_the_mean_of_contacts_on_an_arc_lies_on_the_arc(shape):
    """Without noise the points of a millimetre lie up to 4 µm off the surface in the mean, below it where convex."""
    p, n, _ = SHAPES[shape](np.concatenate([RASTER, RASTER[::-1] + 0.4e-3]))
    points = fit_map(p, n, sigma_point=SIGMA_POINT, sigma_normal=SIGMA_NORMAL)
    pad = fit_map(
        p, n, np.zeros(len(p)), sigma_point=SIGMA_POINT, sigma_normal=SIGMA_NORMAL, probe_radius=0.04, stiffness=1e8
    )
    places, _, _ = SHAPES[shape](PLACES)
    for found in (points, pad):
        assert np.abs(found.distance(places)[0]).max() < 1e-6


@pytest.mark.parametrize(("shape", "scale"), [("ball", 1.0), ("saddle", 10.0)])
def test_one_straight_pass_says_nothing_of_the_curvature_across(shape, scale):
    found = fitted(shape, STRAIGHT, scale)
    p, n, _ = SHAPES[shape](PLACES[:2])
    bent = found.curvature(p)
    assert np.isnan(bent.K).all()
    assert (bent.rank == 2).all()
    height, sigma = found.distance(p[:1])
    assert abs(height[0]) < 4.0 * sigma[0] < 1.5e-3
    assert found.normal(p[:1])[0][0] @ n[0] > 0.999


@pytest.mark.parametrize(("path", "rank"), [(STRAIGHT[100:101], 0), (STRAIGHT[100:120:19], 2), (0.0 * RASTER, 0)])
def test_one_or_two_contacts_or_a_dwell_give_a_place_and_no_curvature(path, rank):
    found = fitted("ball", path)
    p, n, _ = SHAPES["ball"](PLACES[:1])
    height, sigma = found.distance(p)
    assert abs(height[0]) < 4.0 * sigma[0] < 4.0 * 1.1 * SIGMA_POINT
    assert found.normal(p)[0][0] @ n[0] > 0.99999
    bent = found.curvature(p)
    assert np.isnan(bent.K).all()
    assert bent.rank[0] <= rank
    assert len(found) <= 2  # noise at rest makes no way, and no nodes
    if len(path) > 2:
        assert len(fitted("ball", path, 10.0)) == 1


@pytest.mark.parametrize("shape", ["ball", "saddle"])
def test_points_alone_give_the_curvature_and_normals_alone_all_but_the_height(shape):
    """Of ground that was touched twice."""
    p, n, tensor = SHAPES[shape](PLACES)
    twice = np.concatenate([RASTER, RASTER])
    points = fitted(shape, twice, sigma_normal=math.inf)
    assert np.abs(points.curvature(p).tensor - tensor).max() < 3.0
    assert np.abs(points.distance(p)[0]).max() < 15e-6
    normals = fitted(shape, twice, sigma_height=math.inf)
    assert np.abs(normals.curvature(p).tensor - tensor).max() < 0.5
    assert (np.einsum("ni,ni->n", normals.normal(p)[0], n) > 0.99999).all()
    assert np.isnan(normals.distance(p)).all()
    one = fitted(shape, STRAIGHT[100:102], sigma_normal=math.inf)
    assert np.isnan(one.normal(p)[0]).all()


def test_both_sheets_of_a_thin_body_are_apart():
    """A plate of 1 mm, and two flat steps of 3 mm that face one way."""
    p, n, _ = on_quadratic(RASTER, 0.0, 0.0)
    below = p - [0.0, 0.0, 1e-3]
    plate = fit_map(np.concatenate([p, below]), np.concatenate([n, -n]))
    for z, up in ((0.1e-3, 1.0), (-0.3e-3, 1.0), (-0.7e-3, -1.0), (-1.2e-3, -1.0)):
        feet = plate.closest([[1e-3, 1e-3, z]])
        assert feet.normal[0, 2] == pytest.approx(up, abs=1e-4)
        assert feet.point[0, 2] == pytest.approx(0.0 if up > 0.0 else -1e-3, abs=2e-6)
    assert np.abs(plate.curvature([[0.0, 0.0, 0.0], [0.0, 0.0, -1e-3]]).tensor).max() < 0.1
    above = p - [0.0, 0.0, -3e-3]
    steps = fit_map(np.concatenate([p, above]), np.concatenate([n, n]))
    height, _ = steps.distance([[1e-3, 1e-3, 0.1e-3], [1e-3, 1e-3, 2.9e-3]])
    assert height == pytest.approx([0.1e-3, -0.1e-3], abs=2e-6)


def test_a_closed_body_gives_a_closed_mesh():
    rng = np.random.default_rng(1)
    n = rng.normal(size=(1500, 3))
    n /= np.linalg.norm(n, axis=1)[:, None]
    mesh = fit_map(0.02 * n, n).mesh(cell=2e-3)
    edges = np.sort(mesh.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1].tolist()) == {2}
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1) - 0.02).max() < 20e-6


def test_contacts_one_by_one_are_those_at_once():
    p, n = touched("saddle", RASTER[:300])
    at_once = fit_map(p, n)
    slowly = fit_map(p[:1], n[:1])
    for one, way in zip(p[1:], n[1:], strict=True):
        slowly.add(one, way)
    np.testing.assert_allclose(slowly.nodes.rows, at_once.nodes.rows, atol=1e-12)
    np.testing.assert_allclose(slowly.distance(p[::50]), at_once.distance(p[::50]), atol=1e-9)


def test_a_map_in_parts_is_the_map_at_once(monkeypatch):
    """Large maps are solved and asked in parts; the common errors are of all of them."""
    p, n = touched("saddle", RASTER)

    def answers():
        found = SurfaceMap(PadLayer(0.04, 1.2e8), PAD_NOISE)
        found.add(p, n, np.full(len(p), 2.0))
        return [*found.closest(p[::50]), found.curvature(p[::50]).covariance, found.common.mean, len(found.normals)]

    at_once = answers()
    for module, name in ((local_fits, "ROWS_AT_ONCE"), (discs, "DISCS_AT_ONCE"), (surface_map, "PLACES_AT_ONCE")):
        monkeypatch.setattr(module, name, 7)
    for one, other in zip(answers(), at_once, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


def test_ground_that_is_scanned_again_adds_weight_and_hardly_any_memory():
    p, n = touched("ball", RASTER)
    once, often = fit_map(p, n), fit_map(p, n)
    for seed in range(1, 9):
        often.add(*touched("ball", RASTER, seed=seed))
    assert len(often) < 2.5 * len(once)
    at = on_sphere(PLACES, 0.05)[0]
    assert (often.distance(at)[1] < 0.5 * once.distance(at)[1]).all()
    assert often.nodes.rows[:, nodes.COUNT].sum() == 9 * len(p)


def test_the_squeeze_of_the_layer_is_taken_off_by_the_curvature_of_the_map():
    radius, stiffness = 0.04, 1.2e8
    for shape, kappa in (("ball", (20.0, 20.0)), ("saddle", (16.0, -12.0)), ("plane", (0.0, 0.0))):
        p, n, _ = SHAPES[shape](RASTER)
        forces = np.linspace(1.0, 3.0, len(p))
        depth = np.array([indentation_from_force(f, stiffness, radius, kappa) for f in forces])
        found = fit_map(p - depth[:, None] * n, n, forces, probe_radius=radius, stiffness=stiffness)
        at, _, tensor = SHAPES[shape](PLACES)
        assert np.abs(found.distance(at)[0]).max() < 3e-6  # a mean over a millimetre of a ball lies 1 µm low
        assert np.abs(found.curvature(at).tensor - tensor).max() < 0.3
        assert depth.mean() > 150e-6


def test_curvature_that_changes_under_the_patch_leaves_the_true_normals_within_their_bands():
    """A pad on waves of 35 mm shows the slopes of h + 2/3 Lh: 3 mrad away from the true ones, where noise makes 0.3."""
    radius, stiffness, force, amplitude, wave = 0.04, 1.2e8, 2.0, 0.3e-3, 2.0 * np.pi / 35e-3

    def on_waves(xy, share):
        phase = wave * xy[:, 0]
        relative = 1.0 / radius + amplitude * wave**2 * np.cos(phase)
        depth = np.sqrt(force * np.sqrt(relative / radius) / (math.pi * stiffness))
        slope = -amplitude * wave * np.sin(phase)
        change = amplitude * wave**3 * np.sin(phase)
        slope = slope + share * 0.25 * depth / relative * change
        n = np.column_stack([-slope, np.zeros_like(slope), np.ones_like(slope)])
        p = np.column_stack([xy, amplitude * np.cos(phase)])
        return p, n / np.linalg.norm(n, axis=1)[:, None], depth

    rng = np.random.default_rng(0)
    p, shown, depth = on_waves(RASTER, 2.0 / 3.0)
    found = fit_map(
        p - depth[:, None] * shown + 10e-6 * rng.normal(size=p.shape),
        shown + 1e-3 * rng.normal(size=p.shape),
        np.full(len(p), force),
        sigma_point=10e-6,
        sigma_normal=1e-3,
        probe_radius=radius,
        stiffness=stiffness,
    )
    at, true, _ = on_waves(RASTER[::9], 0.0)
    normal, V = found.normal(at)
    axes = found.curvature(at).axes
    off = np.einsum("nip,ni->np", axes, normal - true)
    chi2 = np.einsum("np,npq,nq->n", off, np.linalg.inv(np.einsum("nip,nij,njq->npq", axes, V, axes)), off)
    assert math.sqrt(float((off**2).sum(axis=1).mean())) > 2e-3
    assert 0.4 < chi2.mean() < 4.0  # 2 is usual; 200 by noise alone


def pad_samples(radius, stiffness, true_stiffness, model):
    """Contacts of a pad that follows a ball and reports by the array's own model, on a layer that nobody stated."""
    p, n, _ = on_sphere(RASTER, 0.05)
    depth = indentation_from_force(2.0, true_stiffness, radius, (20.0, 20.0))
    shown = model.with_stiffness(true_stiffness).moments((20.0, 0.0, 20.0), 2.0)
    slope = Slope(math.sqrt(2.0) / depth, 20.0)
    for i, (place, up) in enumerate(zip(p, n, strict=True)):
        T = np.eye(4)
        x = np.array([1.0, 0.0, 0.0]) - up[0] * up
        x /= np.linalg.norm(x)
        T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(-up, x), -up]), place + (radius - depth) * up
        yield ContactSample(
            0.005 * i, place, up, T, np.array([0, 0, radius - depth]), 2.0, 40e-6, moments=shown, slope=slope
        )


def of_scan(seen, true_share=1.0, larger=1.0):
    """The map of a scan on a layer whose stiffness is a share of the stated one, and the model of its images."""
    radius = 0.04
    parameters = ImageParameters(stiffness=1.24e8, scale=1.0, blur=1.5e-3, crosstalk=0.0, memory=0.0)
    errors = MomentErrors(moment=1e-3, both=5e-4, shear=1e-3, frame_sigma=0.01)
    model = ImageModel(parameters, errors, Pad(pitch_m=1.6e-3, full_scale_pa=255 * 500.0, mount_radius_m=radius), seen)
    model.level = 1e3
    found = SurfaceMap(PadLayer(radius, model.parameters.stiffness), MapNoise(40e-6, 15e-6, 1e-3), model)
    samples = pad_samples(radius, model.parameters.stiffness, true_share * model.parameters.stiffness, model)
    found.add_samples([replace(s, moments=tuple(larger * moment for moment in s.moments)) for s in samples])
    return found, model


@pytest.mark.parametrize("true_share", [0.7, 1.4])
def test_the_scan_shows_the_stiffness_of_its_layer(true_share):
    found, model = of_scan(16, true_share)
    at = on_sphere(PLACES, 0.05)[0]
    assert np.abs(found.distance(at)[0]).max() < 5e-6
    assert found.stiffness.value == pytest.approx(true_share * model.parameters.stiffness, rel=0.02)


def test_images_of_a_patch_that_does_not_fit_into_the_window_say_nothing_of_the_stiffness():
    found, model = of_scan(4, larger=1.1)
    assert found.stiffness.value == pytest.approx(model.parameters.stiffness, rel=0.02)
    assert found.stiffness.sigma == SOURCE_SIGMA


def test_an_error_that_the_scan_has_in_common_is_found_and_taken_off():
    """The pad shows distances 8 % too long, and keeps its orientation over a ball: K would be 8 % off."""
    radius, scale = 0.04, 0.08
    p, n, tensor = on_sphere(RASTER, 0.05)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    samples = []
    for i, (place, up) in enumerate(zip(p, n, strict=True)):
        T = T.copy()
        T[:3, 3] = place + radius * up
        seen = T[:3, 2] + (1.0 + scale) * (-up - T[:3, 2])
        seen /= np.linalg.norm(seen)
        arm = radius * seen @ T[:3, :3]
        samples.append(
            ContactSample(0.005 * i, T[:3, 3] + radius * seen, -seen, T, arm, 0.0, 30e-6, sigma_height=10e-6)
        )
    at, _, tensor = SHAPES["ball"](PLACES)
    off = {}
    for name, noise in (("common", PAD_NOISE), ("independent", replace(PAD_NOISE, common=(0.0, 0.0, 0.0, 0.0)))):
        found = SurfaceMap(PadLayer(radius, 1e8), noise)
        found.add_samples(samples)
        off[name] = np.abs(found.curvature(at).tensor - tensor).max()
        if name == "common":
            assert abs(found.common.mean[1]) == pytest.approx(scale, rel=0.15)
    assert off["independent"] > 0.8
    assert off["common"] < 0.25 * off["independent"]


def test_the_map_shows_where_passes_disagree():
    p, n = touched("plane", RASTER)
    again, up = touched("plane", RASTER, seed=1)
    agreed = fit_map(np.concatenate([p, again]), np.concatenate([n, up]), sigma_point=SIGMA_POINT, sigma_normal=1e-3)
    at = np.array([[-9e-3, 0.0, 0.0], [9e-3, 0.0, 0.0]])
    assert (agreed.disagreement(at) < 0.5).all()
    again[:, 2] += np.where(again[:, 0] > 2e-3, 0.2e-3, 0.0)
    apart = fit_map(np.concatenate([p, again]), np.concatenate([n, up]), sigma_point=SIGMA_POINT, sigma_normal=1e-3)
    same, other = apart.disagreement(at)
    assert same < 0.5
    assert other > 3.0
    assert apart.distance(at)[1][1] > 0.1e-3  # half of the step between them


def test_what_every_pass_repeats_is_not_averaged_away_and_no_disagreement():
    """Taxels under the patch lift a pad by up to 6 µm, every 3 mm, and on each of 200 passes by the same."""
    p, n, _ = on_sphere(RASTER, 0.05)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    lift = 6e-6 * np.sin(2.0 * np.pi * p[:, 0] / 3e-3)
    samples = []
    for i, (place, up) in enumerate(zip(p + lift[:, None] * n, n, strict=True)):
        at = T.copy()
        at[:3, 3] = place + 0.04 * up
        samples.append(ContactSample(0.005 * i, place, up, at, np.array([0.0, 0.0, 0.04]), 0.0, 30e-6))
    once = SurfaceMap(PadLayer(0.04, 1e8), PAD_NOISE)
    once.add_samples(samples)
    rows = once.nodes.rows
    rows[:, nodes.COUNT :] *= 200.0
    often = SurfaceMap.of_nodes(rows, once.pad, PAD_NOISE, once.stiffness)
    at = on_sphere(PLACES, 0.05)[0]
    assert (often.disagreement(at) == 0.0).all()
    less = np.sqrt(np.trace(often.normal(at)[1], axis1=1, axis2=2) / np.trace(once.normal(at)[1], axis1=1, axis2=2))
    assert (less > 0.25).all()  # 0.07 where all passes count as independent
    assert (less < 0.6).all()


def test_contacts_are_placed_by_what_the_map_knows_in_the_end():
    """A pad on a ball whose contacts were placed as if the ball were flat, and its layer a fifth too soft."""
    radius, stiffness = 0.04, 1.2e8
    p, n, _ = on_sphere(RASTER, 0.05)
    forces = np.linspace(1.0, 3.0, len(p))
    samples = []
    for i, (place, up, force) in enumerate(zip(p, n, forces.tolist(), strict=True)):
        depth, wrong = (
            indentation_from_force(force, k, radius, kappa)
            for k, kappa in ((stiffness, (20.0, 20.0)), (0.8 * stiffness, (0.0, 0.0)))
        )
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[:3, 3] = place + (radius - depth) * up
        r = np.array([0.0, 0.0, radius - wrong])
        samples.append(ContactSample(0.005 * i, place + (wrong - depth) * up, up, T, r, force, 30e-6))
    found = SurfaceMap(PadLayer(radius, stiffness), PAD_NOISE)
    found.add_samples(samples)
    off = [np.linalg.norm(sample.p_base - np.array([0.0, 0.0, -0.05])) - 0.05 for sample in found.settled(samples)]
    assert np.abs(off).max() < 5e-6
    alone = SurfaceMap(PadLayer(radius, stiffness), PAD_NOISE)
    alone.add_samples(samples[:1])
    assert alone.settled(samples[:1]) == samples[:1]  # one contact shows no curvature


def test_terms_are_the_derivatives_of_the_height():
    a = np.random.default_rng(0).normal(size=15)
    x, y, d = np.array([0.3, -0.7]), np.array([0.5, 0.2]), 1e-5
    here, *others = terms(x, y, (0, 0), (1, 0), (1, 1), (2, 0), (0, 2))
    f, fx, fxy = (one @ a for one in (here, *others[:2]))
    h, hx, hy = heights_and_slopes(a[:, None], x, y)
    np.testing.assert_allclose([h, hx], [f, fx], atol=1e-12)
    up, low = heights_and_slopes(a[:, None], x, y + d), heights_and_slopes(a[:, None], x, y - d)
    np.testing.assert_allclose(hy, (up[0] - low[0]) / (2 * d), rtol=1e-6)
    np.testing.assert_allclose(fxy, (up[1] - low[1]) / (2 * d), rtol=1e-6)
    for (i, j), second in zip(((0, 1), (0, 0), (1, 1)), others[1:], strict=True):
        np.testing.assert_allclose(here @ SECOND_DERIVATIVES[i, j], second, atol=1e-12)


def test_the_prior_of_fourth_derivatives_is_that_of_a_ball():
    k = 20.0 * LENGTH_M
    (a,) = fourth_of(np.array([k * np.eye(2)]))
    x, y = np.array([0.4, -0.2]), np.array([0.1, 0.5])
    r2 = x * x + y * y
    exact = (np.sqrt(1.0 - k * k * r2) - 1.0) / k + 0.5 * k * r2
    np.testing.assert_allclose(heights_and_slopes(a[:, None], x, y)[0], exact, rtol=0.01)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"points": [[0.0, 0.0]]}, "points: expected shape"),
        ({"points": [[math.nan, 0.0, 0.0]]}, "points: expected finite"),
        ({"normals": [[0.0, 0.0, 0.0]]}, "normals: expected directions"),
        ({"normals": [[0.0, 0.0, 1.0]] * 2}, "normals: expected shape"),
        ({"sigma_point": 0.0}, "sigma_point: expected a number above 0"),
        ({"sigma_normal": -1.0}, "sigma_normal: expected a number above 0"),
        ({"forces": [1.0]}, "forces: expected with probe_radius"),
        ({"stiffness": 1e8}, "probe_radius, stiffness: expected with forces"),
        ({"forces": [1.0, 2.0], "probe_radius": 0.04, "stiffness": 1e8}, "forces: expected shape"),
        ({"points": np.zeros((0, 3)), "normals": np.zeros((0, 3))}, "map: expected contacts, got none"),
    ],
)
def test_what_is_wrong_is_named(change, said):
    given = {"points": [[0.0, 0.0, 0.0]], "normals": [[0.0, 0.0, 1.0]]} | change
    with pytest.raises(UsageError, match=said):
        fit_map(**given).closest([[0.0, 0.0, 0.0]])
