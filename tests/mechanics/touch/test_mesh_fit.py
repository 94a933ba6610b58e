"""Meshes as smooth surfaces: against the bodies that they are meshes of, edges, and meshes that show no surface."""

import math
import tracemalloc

import numpy as np
import pytest
from scipy.spatial import Delaunay

from canprobe.mechanics.touch import make_object
from canprobe.mechanics.touch.mesh_fit import fit_mesh
from canprobe.mechanics.touch.mesh_repair import repaired

EDGE, SPACING = 5e-4, 1e-3
BODIES = {
    "sphere": ({"radius": 0.05}, lambda x, y: np.sqrt(0.05**2 - x**2 - y**2) - 0.05),
    "torus": (
        {"ring_radius": 0.06, "radius": 0.03},
        lambda x, y: np.sqrt(0.03**2 - (np.hypot(x + 0.06, y) - 0.06) ** 2) - 0.03,
    ),
}


def patch_of(height, edge=EDGE, half=0.016, seed=1):
    """An irregular mesh: a grid of points, each moved by up to 0.3 of the edge's length, in single precision."""
    x, y = np.meshgrid(*[np.linspace(-half, half, round(2 * half / edge) + 1)] * 2, indexing="ij")
    inner = (slice(1, -1), slice(1, -1))
    for axis, moved in zip((x, y), np.random.default_rng(seed).uniform(-0.3, 0.3, (2, *x.shape)), strict=True):
        axis[inner] += edge * moved[inner]
    vertices = np.column_stack((x.ravel(), y.ravel(), height(x, y).ravel()))
    faces = Delaunay(vertices[:, :2]).simplices
    a, b, c = (vertices[faces[:, k], :2] for k in range(3))
    down = (b - a)[:, 0] * (c - a)[:, 1] < (b - a)[:, 1] * (c - a)[:, 0]
    faces[down] = faces[down][:, ::-1]
    return vertices.astype(np.float32), faces


def mesh(vertices, faces, spacing=SPACING, origin=(0, 0)):
    pose = np.eye(4)
    return make_object("mesh", T_base_object=pose, vertices=vertices, faces=faces, spacing=spacing, origin=origin)


def worst(exact, read, seed=2):
    """Errors of point (m), normal (rad) and curvature (relative) over feet of a ball of about 30 mm."""
    errors = []
    for at in np.random.default_rng(seed).uniform((-0.009, -0.009, 0.029), (0.009, 0.009, 0.031), (40, 3)):
        a, b = exact.closest(at), read.closest(at)
        A, B = ((c.directions.T * c.kappa) @ c.directions for c in (a, b))
        bend = np.linalg.norm(A - B) / np.linalg.norm(A)
        errors.append((np.linalg.norm(a.point - b.point), np.linalg.norm(a.normal - b.normal), bend))
    return np.max(errors, axis=0)


@pytest.mark.parametrize("kind", BODIES)
def test_an_irregular_mesh_of_a_body_is_the_body(kind):
    """Edges of 0.5 mm; fifty times nearer than the 5 µm, 0.5 mrad and 1 % that are asked for."""
    params, height = BODIES[kind]
    exact = make_object(kind, T_base_object=np.eye(4), **params)
    point, normal, bend = worst(exact, mesh(*patch_of(height)))
    assert point < 1e-7 and normal < 1e-5 and bend < 1e-3


def ball(radius=0.02, rings=60, sectors=120):
    """A closed ball with two poles, its centre at the origin."""
    polar, turn = np.linspace(0, math.pi, rings + 1)[1:-1], np.arange(sectors) * (2 * math.pi / sectors)
    p, t = (one.ravel() for one in np.meshgrid(polar, turn, indexing="ij"))
    body = radius * np.column_stack((np.sin(p) * np.cos(t), np.sin(p) * np.sin(t), np.cos(p)))
    vertices = np.vstack((body, (0, 0, radius), (0, 0, -radius)))
    index = np.arange(len(body)).reshape(-1, sectors)
    beside = np.roll(index, -1, axis=1)
    a, b, c, d = (one.ravel() for one in (index[:-1], beside[:-1], index[1:], beside[1:]))
    top, bottom = np.full(sectors, len(body)), np.full(sectors, len(body) + 1)
    faces = [(a, c, b), (b, c, d), (top, index[0], beside[0]), (bottom, beside[-1], index[-1])]
    return vertices, np.concatenate([np.column_stack(one) for one in faces])


def test_of_a_closed_body_the_upper_side_is_the_surface():
    vertices, faces = ball()
    read, exact = mesh(vertices, faces), make_object("sphere", T_base_object=np.eye(4), radius=0.02)
    point, normal, bend = worst(exact, read)
    assert point < 1e-6 and normal < 1e-4 and bend < 1e-2
    beyond = np.array([(0.0195, 0.0, 0.0), (0.1, 0.0, 0.0), (0.0, 0.0, -1e-5)])
    assert (read.gaps(beyond) > 0).tolist() == [True, True, False]  # the steep side is no surface, nor what is beside


def test_a_plate_of_few_facets_is_flat_between_its_edges():
    profile = np.array([(-30, 0), (-1, 0), (-1, -0.5), (1, -0.5), (1, 0), (30, 0)]) * 1e-3  # a groove 2 mm wide
    sides = [np.column_stack((profile[:, 0], np.full(6, y), profile[:, 1])) for y in (-0.02, 0.02)]
    i = np.arange(5)
    faces = np.concatenate((np.column_stack((i, i + 1, i + 6)), np.column_stack((i + 1, i + 7, i + 6))))
    plate = mesh(np.concatenate(sides), faces, spacing=5e-4, origin=(0.015, 0.0))
    flat = plate.closest((0.0, 0.0, 0.03))
    assert flat.point == pytest.approx((0, 0, 0), abs=1e-7) and np.abs(flat.kappa).max() < 0.05
    assert plate.spline.at(-0.015, 0.0)[0] == pytest.approx(-5e-4, abs=1e-4)
    over = plate.touches((-0.015, 0.0, 0.03), 0.0302)
    assert over is not None and len(over.points) == 2  # on its edges, which are round over two spacings to each side
    assert 2e-3 < np.ptp(over.points[:, 0]) < 4.5e-3
    along = np.linspace(-0.04, 0.01, 2001)
    assert plate.spline.many(along, np.zeros(2001))[0].max() < 1e-5  # it does not overshoot beside the walls


OPEN = patch_of(BODIES["sphere"][1], edge=2e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f: (v, f[:, ::-1]), "inside out"),
        (lambda v, f: (v * np.nan, f), "finite"),
        (lambda v, f: (v[:5], f), "faces name vertices 0 to 4"),
        (lambda v, f: (v, f[:0]), "needs vertices"),
        (lambda v, f: (v * 1000, f), "widen"),
        (lambda v, f: ball(0.02, 8, 16), "too coarse: facets of about 7.8 mm turn the normal by 19 deg"),
        (lambda v, f: (OPEN[0], OPEN[1][:, ::-1]), r"no facet of the mesh faces \+z"),
        (lambda v, f: (*OPEN, SPACING, (0.1, 0.0)), "beside the surface"),
    ],
)
def test_what_shows_no_surface_is_refused_with_the_reason(change, message):
    with pytest.raises(ValueError, match=message):
        mesh(*change(*ball()))


def soup(vertices, faces, jitter_m, seed=0):
    """Facets that share no vertex, each vertex of which a program has rounded for itself."""
    apart = vertices[faces].reshape(-1, 3).astype(float)
    moved = np.random.default_rng(seed).uniform(-jitter_m, jitter_m, apart.shape)
    return apart + moved, np.arange(len(apart)).reshape(-1, 3)


@pytest.mark.parametrize(("jitter_m", "edge"), [(0.0, 1e-3), (1e-8, 1e-3)])
def test_vertices_that_are_almost_at_one_place_are_one(jitter_m, edge):
    params, height = BODIES["sphere"]
    vertices, faces = patch_of(height, edge)
    read = mesh(*soup(vertices, faces, jitter_m))
    assert worst(make_object("sphere", T_base_object=np.eye(4), **params), read)[2] < 5e-3
    state = read.fit.state
    assert state.vertices == len(vertices) and state.merged_m < 4 * jitter_m + 1e-12
    assert state.merged == (jitter_m > 0) * (3 * len(faces) - len(vertices))


def test_no_detail_is_merged_away():
    """A ball of facets, one part of which is a thousand times finer: 2 µm."""
    fine = ball(2e-5)
    vertices, faces = ball()
    both = np.vstack((vertices, fine[0] + (0.05, 0, 0))), np.vstack((faces, fine[1] + len(vertices)))
    points, corners, state = repaired(*both)
    assert len(points) == len(vertices) + len(fine[0]) and len(corners) == len(both[1]) and state.merged == 0


def test_facets_that_are_turned_over_are_turned_back():
    params, (vertices, faces) = BODIES["sphere"][0], OPEN
    over = np.random.default_rng(5).random(len(faces)) < 0.3
    mixed = np.where(over[:, None], faces[:, ::-1], faces)
    whole, read = mesh(vertices, faces), mesh(vertices, mixed)
    assert read.fit.state.turned == over.sum() > 0 and whole.fit.state.turned == 0
    np.testing.assert_array_equal(read.fit.heights, whole.fit.heights)
    assert worst(make_object("sphere", T_base_object=np.eye(4), **params), read)[2] < 5e-3


def test_open_edges_and_edges_of_three_facets_are_counted():
    vertices, faces = ball()
    assert (repaired(vertices, faces)[2].open_edges, repaired(vertices, faces)[2].odd_edges) == (0, 0)
    assert repaired(vertices, faces[1:])[2].open_edges == 3
    fin = np.vstack((vertices, (0, 0, 0.05))), np.vstack((faces, (faces[0, 0], faces[0, 1], len(vertices))))
    assert (repaired(*fin)[2].open_edges, repaired(*fin)[2].odd_edges) == (2, 1)


def test_the_error_of_a_measured_mesh_is_stated_and_a_wider_spacing_found():
    """Vertices with a scatter of 10 µm."""
    params, height = BODIES["sphere"]
    vertices, faces = patch_of(height, 1e-3)
    vertices = vertices + np.random.default_rng(6).normal(0.0, 1e-5, vertices.shape)
    exact = make_object("sphere", T_base_object=np.eye(4), **params)
    usual, chosen = mesh(vertices, faces, 1e-3), mesh(vertices, faces, None)
    assert chosen.fit.spacing > 2e-3 and usual.fit.better[0] == chosen.fit.spacing
    for read in (usual, chosen):
        true = worst(exact, read)[2]
        assert 0.1 * true < read.fit.curvature.share < true


def test_a_cad_cylinder_of_long_slivers_costs_as_much_as_its_area():
    sections = 360
    turn = 2.0 * math.pi * np.arange(sections) / sections
    ring = np.column_stack((np.zeros(sections), 0.02 * np.sin(turn), 0.02 * np.cos(turn)))
    i = np.arange(sections)
    j = (i + 1) % sections
    faces = np.concatenate((np.column_stack((i, i + sections, j)), np.column_stack((j, i + sections, j + sections))))
    tracemalloc.start()
    try:
        read = mesh(np.concatenate([ring + np.array((end, 0.0, 0.0)) for end in (-0.08, 0.08)]), faces, 1e-3)
        assert tracemalloc.get_traced_memory()[1] < 200e6
    finally:
        tracemalloc.stop()
    exact = make_object("cylinder", T_base_object=np.eye(4), radius=0.02)
    point, normal, bend = worst(exact, read)
    assert point < 1e-7 and normal < 1e-4 and bend < 1e-2


def grid_faces(n):
    """Facets of a grid of n by n vertices, row by row."""
    corner = np.array([n * i + j for i in range(n - 1) for j in range(n - 1)])[:, None]
    return np.concatenate((corner + np.array((0, n, 1)), corner + np.array((1, n, n + 1))))


def ring_of(low_m, high_m, at_m, n=61):
    """A shallow dome, the facets of which lie between two distances from its middle at (x, y), in single precision."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-high_m, high_m, n)] * 2, indexing="ij"))
    faces = grid_faces(n)
    far = np.hypot(x, y)[faces]
    faces = faces[(far >= low_m).all(axis=1) & (far <= high_m).all(axis=1)]
    return np.column_stack((x + at_m[0], y + at_m[1], -2.0 * (x * x + y * y))).astype(np.float32), faces


@pytest.mark.parametrize(
    ("at_mm", "width_mm", "nodes"),
    [
        (0.0, 8.00002, 9),
        (0.0, 20.45, 21),
        (100.0, 8.0, 9),
        (-1000.0, 8.99, 9),
    ],
)
def test_no_node_lies_beyond_the_border(at_mm, width_mm, nodes):
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.5, 0.5, 21) * width_mm] * 2, indexing="ij"))
    points = 1e-3 * np.column_stack((x + at_mm, y, -0.01 * (x * x + y * y))).astype(np.float32).astype(float)
    fit = fit_mesh(points, grid_faces(21), 1e-3, (1e-3 * at_mm, 0.0))
    assert fit.heights.shape == (nodes, nodes) and fit.there.all()
    assert fit.origin == pytest.approx((0.0, 0.0), abs=1e-7)  # the grid stands in the middle of the mesh
    assert 0.5 * (nodes - 1) * 1e-3 <= 0.5e-3 * width_mm + 1e-6


@pytest.mark.parametrize("hole_m", [0.0, 0.006])
def test_the_surface_ends_with_the_facets_and_so_does_the_closest_point(hole_m):
    vertices, faces = ring_of(hole_m, 0.02, (0.3, -0.2))
    read = mesh(vertices, faces, origin=(0.3, -0.188))
    at = np.random.default_rng(3).uniform((-0.035, -0.047, 0.005), (0.035, 0.023, 0.075), (400, 3))
    feet = np.array([read.closest(one).point for one in at])[:, :2] + (0.0, 0.012)
    seen = np.random.default_rng(4).uniform(-0.021, 0.021, (20_000, 2))
    there = seen[read.exists(seen[:, 0], seen[:, 1] - 0.012)]
    for points in (feet, there):
        far = np.hypot(*points.T)
        assert far.min() >= hole_m - 1e-6 * (hole_m > 0.0) and far.max() <= 0.02 + 2e-6
    assert len(there) / len(seen) > 0.8 * math.pi * (0.02**2 - hole_m**2) / 0.042**2  # cells at the border are lost


def test_missing_facets_round_a_node_are_bridged():
    vertices, faces = ring_of(0.0, 0.02, (0.0, 0.0), n=81)
    torn = faces[(faces != 40 * 81 + 40).all(axis=1)]
    assert len(torn) == len(faces) - 6
    assert (fit_mesh(vertices, torn, SPACING).there == fit_mesh(vertices, faces, SPACING).there).all()


def test_a_body_that_is_narrow_where_it_is_seen_is_refused():
    """A steep truncated pyramid: 30 mm wide at its foot and 4 mm at its top."""
    top, foot = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * 2e-3, np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    vertices = np.vstack((np.column_stack((top, np.zeros(4))), np.column_stack((15e-3 * foot, np.full(4, -0.1)))))
    sides = [(k, 4 + k, 4 + (k + 1) % 4) for k in range(4)] + [(k, 4 + (k + 1) % 4, (k + 1) % 4) for k in range(4)]
    with pytest.raises(ValueError, match=r"mesh from \+z is 4 mm by 4 mm, narrower than 7 spacings"):
        mesh(vertices, [(0, 1, 2), (0, 2, 3), *sides])


def test_a_mesh_narrower_than_seven_spacings_or_with_a_far_vertex_is_refused():
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(-4.0, 4.1), np.arange(-4.0, 4.1), indexing="ij"))
    points = 1e-3 * np.column_stack((x, y, -0.01 * (x * x + y * y)))
    faces = grid_faces(9)
    assert fit_mesh(points, faces, 1e-3).heights.shape == (9, 9)
    with pytest.raises(ValueError, match=r"8 mm by 8 mm, narrower than 7 spacings of 1.5 mm"):
        fit_mesh(points, faces, 1.5e-3)
    for far in (0.1, 0.2):
        odd = np.concatenate((points, [[-far, far, 0.0]])), np.concatenate((faces, [[0, 1, len(points)]]))
        with pytest.raises(ValueError, match=r"mm and nearly empty: remove vertices far away"):
            fit_mesh(*odd, 1e-3)
