"""Objects from files: what is read, what a run takes along, and what is said about files that hold no surface."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import canprobe
from canprobe.cell.npz import read_npz
from canprobe.cell.scene.geometry import stl_damage, true_object
from canprobe.cell.scene.load import load_scene, packaged_files, scenes_folder
from canprobe.cell.scene.model import ObjectSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.folder import write_scene
from canprobe.cli import main
from canprobe.errors import PlanError, UsageError

X, Y = np.meshgrid(np.arange(-20, 20.1), np.arange(-15, 15.1), indexing="ij")
BUMP_MM = 1.5 * np.exp(-((X - 4) ** 2 + 2 * Y**2) / 200)


def write(folder, name, z, **arrays):
    path = folder / name
    if name.endswith(".npy"):
        np.save(path, z)
    elif name.endswith(".npz"):
        np.savez(path, heights=z, **arrays)
    else:
        np.savetxt(path, z, fmt="%.17g", delimiter="," if name.endswith(".csv") else " ", header="a bump, mm")
    return str(path)


def kappa_over(settings, x, y):
    T = np.array(true_object(settings).T_base_object)
    return true_object(settings).closest(T[:3, :3] @ (x, y, 0.02) + T[:3, 3]).kappa


@pytest.mark.parametrize("name", ["bump.npy", "bump.npz", "bump.csv", "bump.txt"])
def test_heights_of_every_kind_of_file_are_the_same_surface(name, tmp_path):
    z = BUMP_MM / 25.4
    file = write(tmp_path, name, z, spacing=1 / 25.4)
    spacing = None if name.endswith("npz") else 1.0
    settings = ObjectSettings("heights", file=file, unit_mm=25.4, spacing_mm=spacing, origin_mm=(24, 15))
    middle = dataclasses.replace(settings, origin_mm=None)
    assert kappa_over(settings, 0.0, 0.0) == pytest.approx((30.0, 15.0), rel=0.01)  # 1.5 · 4/200 and 1.5 · 2/200, 1/mm
    assert kappa_over(middle, 0.004, 0.0) == pytest.approx(kappa_over(settings, 0.0, 0.0), rel=0.05)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("gone.npy", None, "gone.npy: cannot be read: No such file"),
        ("bump.png", b"", "expected heights in a file of .npy, .npz, .csv, .txt, got bump.png"),
        (
            "bump.csv",
            b"1, 2\n3, four\n",
            "bump.csv is no grid of numbers: line 2: expected numbers, got 'four'; get the file",
        ),
        (
            "bump.csv",
            b"1, 2\n# beside\n3\n",
            "no grid of numbers: line 3: expected 2 numbers as above, got 1; get the file",
        ),
        ("bump.csv", b"1, 2\n3, \xff\n", "bump.csv is no grid of numbers: byte 8 is 0xff, which is no text"),
        ("bump.csv", b"1, 2\n3, nan\n", "bump.csv: height nan in row 2, column 2: fill gaps first"),
        ("bump.csv", b"1, 2\n1e308, -1e308\n", "bump.csv: 2 of 4 heights are 1e[+]308: no data"),
        ("bump.npy", b"text", "bump.npy is no grid of numbers: it is damaged, or holds Python objects; get the file"),
        ("bump.txt", b"", "bump.txt is empty"),
        ("bump.txt", b"# nothing but this", "grid of heights"),
        ("bump.csv", b"version https://git-lfs.github.com/spec/v1\noid", "bump.csv is a pointer of Git LFS"),
        ("bump.csv", b"<!DOCTYPE html>\n<html>", "bump.csv is an HTML page"),
        ("bump.csv", b"0, 0\n0, 1", "bump.csv: heights must be a grid of 8 × 8 or more, got shape .2, 2.; correct the"),
        ("bump.csv", b"0;0,5\n0;-9999\n0;0", "1 of 6 heights are -9999: no data"),
        ("bump.csv", b"0;0,5\n0;500\n0;0", "heights rise by 500 mm over a grid 2 mm wide: .* unit_mm = 1 "),
        ("bump.csv", b"0;0,0005\n0;0\n0;0", "heights rise by 0.0005 mm over a grid 2 mm wide"),
        ("bump.npz", b"PK\x03\x04", "bump.npz is no grid of numbers"),
    ],
)
def test_a_file_without_a_surface_is_refused_with_its_reason(name, content, message, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    settings = ObjectSettings("heights", file=str(tmp_path / name), spacing_mm=1.0)
    scene = dataclasses.replace(load_scene("relief"), object=settings)
    with pytest.raises(PlanError, match=message.replace("(", "\\(")):
        resolve(scene)


FACET = b"""facet normal 0 0 1
  outer loop
    vertex 0 0 0
    vertex 1e0 0 0.
    vertex 0 +1 -.0
  endloop
endfacet
"""
BINARY = b"solid of a program that begins so".ljust(80) + b"\x02\0\0\0" + 2 * (48 * b"\0" + b"\x01\0")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"solid a part\n" + 2 * FACET + b"endsolid a part\n", None),
        (b"solid\r\n" + FACET.replace(b"\n", b"\r\n") + b"endsolid\nsolid b\n" + FACET + b"endsolid", None),
        (b" SOLID a\n" + FACET.upper().replace(b"0 0 1", b"nan nan nan", 1) + b"ENDSOLID", None),
        (BINARY, None),
        (b"solid a\n" + FACET + FACET[:40], "line 11: expected vertex and three numbers, got 'vert'"),
        (b"solid a\n" + FACET + FACET[:33], "line 10: the file ends before vertex and three numbers"),
        (b"solid a\n" + FACET, "line 8: the file ends before facet normal and three numbers, or endsolid"),
        (
            b"solid a\n" + FACET.replace(b"1e0 0 0.", b"1e0 O 0."),
            "line 5: expected a second vertex and three numbers, got 'v",
        ),
        (
            b"solid a\n" + FACET.replace(b"+1", b"inf") + b"endsolid",
            "line 6: expected a third vertex and three numbers, g",
        ),
        (b"solid a\n" + FACET.replace(b"  endloop\n", b"") + b"endsolid", "line 7: expected endloop, got 'endfacet'"),
        (b"solid a\n" + FACET + b"endsolid\nsol", "line 10: expected the end of the file, got 'sol'"),
        (b"solid a\nendsolid a\n", "it holds no facet"),
        (bytes(84), "it holds no facet"),
        (bytes(50), "it ends at byte 50, within the 84 bytes of its head"),
        (BINARY[:-1], "183 bytes, by the 2 facets of its head 184"),
        (BINARY + b"\0", "185 bytes, by the 2 facets of its head 184"),
    ],
)
def test_a_damaged_stl_is_named_with_its_line_or_its_bytes(content, why, tmp_path):
    found = stl_damage(content)
    assert found is None if why is None else found.startswith(why)
    if why is not None:
        (tmp_path / "part.stl").write_bytes(content)
        with pytest.raises(ValueError, match=re.escape(f"file: part.stl is a damaged STL: {why}")):
            true_object(ObjectSettings("mesh", file=str(tmp_path / "part.stl")))


def damaged(content, rng):
    """A content with one of the faults that files get on their way."""
    whole, at = bytearray(content), int(rng.integers(len(content)))
    match int(rng.integers(6)):
        case 0:
            del whole[at:]
        case 1:
            whole[at] = int(rng.integers(256))
        case 2:
            del whole[at : at + int(rng.integers(1, 200))]
        case 3:
            whole[at:at] = rng.bytes(20)
        case 4:
            del whole[:at]
        case 5:
            words = content.split(b" ")
            words[int(rng.integers(len(words)))] = (b"nan", b"1e400", b"abc", b"-1", b"9999999")[at % 5]
            whole = bytearray(b" ".join(words))
    return bytes(whole)


BINARY = pytest.mark.slow(reason="the binary form of the same kind")


@pytest.mark.parametrize(
    "name",
    [
        *("a.stl", "a.obj", "a.ply", "a.npy", "a.npz", "a.csv", "a.txt"),
        *(pytest.param(name, marks=BINARY) for name in ("b.stl", "b.ply")),
    ],
)
def test_of_fifteen_damaged_files_each_is_read_or_named(name, tmp_path):
    if name.startswith("b") or not name.endswith(("npy", "npz", "csv", "txt")):
        trimesh = pytest.importorskip("trimesh")
        whole = trimesh.load_mesh(cap(tmp_path, name).file, process=False)
        kind = {"a.stl": {"file_type": "stl_ascii"}, "a.ply": {"file_type": "ply", "encoding": "ascii"}}
        content = whole.export(**kind.get(name, {"file_type": name[2:]}))
        content = content.encode() if isinstance(content, str) else content
        settings = ObjectSettings("mesh", unit_mm=1000, spacing_mm=2)
    else:
        content = Path(write(tmp_path, name, BUMP_MM, spacing=1.0)).read_bytes()
        settings = ObjectSettings("heights", spacing_mm=1.0)
    rng, named = np.random.default_rng(0), 0
    for number in range(15):
        path = tmp_path / f"odd{number}.{name[2:]}"
        path.write_bytes(damaged(content, rng))
        try:
            true_object(dataclasses.replace(settings, file=str(path)))
        except ValueError as error:
            assert str(error).startswith(f"file: {path.name}"), error
            named += 1
    assert named > 5


def test_a_decimal_comma_between_semicolons(tmp_path):
    point, comma = tmp_path / "point.csv", tmp_path / "comma.csv"
    np.savetxt(point, BUMP_MM, fmt="%.6f", delimiter=",")
    comma.write_text(point.read_text().replace(",", ";").replace(".", ","))
    found = [kappa_over(ObjectSettings("heights", file=str(f), spacing_mm=1.0), 0.004, 0.0) for f in (point, comma)]
    np.testing.assert_array_equal(*found)


def test_a_grid_without_spacing_and_an_archive_without_heights(tmp_path):
    settings = ObjectSettings("heights", file=write(tmp_path, "bump.npy", BUMP_MM))
    with pytest.raises(ValueError, match="spacing_mm: missing"):
        true_object(settings)
    np.savez(tmp_path / "other.npz", a=BUMP_MM, b=BUMP_MM)
    with pytest.raises(ValueError, match='expected an array "heights", got a, b'):
        true_object(dataclasses.replace(settings, file=str(tmp_path / "other.npz")))


def facets(rows, columns):
    """Facets (n, 3) between the vertices of a grid, which go along its rows."""
    corner = np.array([columns * i + j for i in range(rows - 1) for j in range(columns - 1)])[:, None]
    return np.concatenate((corner + np.array((0, columns, 1)), corner + np.array((1, columns, columns + 1))))


def cap(folder, name, *, inside_out=False):
    """A cap of a ball of 50 mm in metres, its top at x = 10 mm, y = 5 mm, as a file of facets."""
    trimesh = pytest.importorskip("trimesh")
    vertices = 1e-3 * np.column_stack([(X + 10).ravel(), (Y + 5).ravel(), np.sqrt(2500 - X**2 - Y**2).ravel()])
    faces = facets(*X.shape)
    mesh = trimesh.Trimesh(vertices, faces[:, ::-1] if inside_out else faces, process=False)
    mesh.export(folder / name)
    return ObjectSettings("mesh", file=str(folder / name), unit_mm=1000, spacing_mm=2, origin_mm=(10, 5))


@pytest.mark.parametrize("name", ["cap.stl", "cap.obj", "cap.ply"])
def test_a_mesh_is_read_in_its_unit_and_placed_by_its_origin(name, tmp_path):
    settings = cap(tmp_path, name)
    T = np.array(true_object(settings).T_base_object)
    foot = true_object(settings).closest(T[:3, 3] + (0.01, 0.0, 0.02))
    centre = T[:3, 3] + (0.0, 0.0, -0.05)
    assert np.linalg.norm(foot.point - centre) == pytest.approx(0.05, abs=1e-7)
    assert foot.kappa == pytest.approx((20.0, 20.0), rel=5e-3)


def test_the_plan_says_what_was_put_in_order_in_a_mesh_and_the_spacing_that_helps(tmp_path, capsys):
    """A dome in facets of 4 mm that share no vertex, two of them turned over; the spacing that is named is typed."""
    trimesh = pytest.importorskip("trimesh")
    scene = dome(tmp_path, True)
    x, y = (one.ravel() for one in np.meshgrid(*[np.linspace(-24, 24, 13)] * 2, indexing="ij"))
    faces = facets(13, 13)
    faces[[30, 100]] = faces[[30, 100], ::-1]
    apart = np.column_stack((x, y, 30 - (x * x + y * y) / 80))[faces].reshape(-1, 3)
    apart += np.random.default_rng(0).uniform(-1e-5, 1e-5, apart.shape)
    trimesh.Trimesh(apart, np.arange(len(apart)).reshape(-1, 3), process=False).export(tmp_path / "dome.ply")
    words = ["plan", scene, "--json", "--set", 'object.file="dome.ply"', "--set", "task.length_mm=10"]
    keys = {"object.origin_mm": "[0, 0]"}

    def planned(**more):
        sets = [word for key, value in (keys | more).items() for word in ("--set", f"{key}={value}")]
        assert main([*words, *sets]) == 0
        return json.loads(capsys.readouterr().out)

    usual = planned(**{"object.spacing_mm": 1})
    found = usual["object"]
    assert (found["turned"], found["merged"], found["vertices"], found["open_edges"]) == (2, 695, 169, 48)
    order, spacing = (next(w for w in usual["warnings"] if w.startswith(k)) for k in ("object.file", "object.spacing"))
    assert re.search(r"695 vertices merged with others up to \d\d nm away; 2 of 288 facets turned over", order)
    better = re.search(r"with object.spacing_mm = ([\d.]+) it is ([\d.]+) 1/m", spacing)
    typed = planned(**{"object.spacing_mm": better[1]})
    assert typed["object"]["curvature_error_per_m"] == pytest.approx(float(better[2]), rel=0.1)
    assert typed["object"]["curvature_error_per_m"] < 0.7 * found["curvature_error_per_m"]
    assert not [w for w in typed["warnings"] if "a better" in w or "with object.spacing" in w]


def test_what_is_said_about_a_mesh_that_cannot_be_taken(tmp_path, monkeypatch):
    inside_out = cap(tmp_path, "cap.stl", inside_out=True)
    (tmp_path / "bad.stl").write_bytes(b"solid nothing")
    for file, message in (
        ("cap.stl", r"cap.stl: no facet of the mesh faces \+z"),
        ("gone.stl", "gone.stl: cannot be read: No such file"),
        ("cap.step", "expected a mesh in a file of .stl, .obj, .ply, got cap.step"),
        ("bad.stl", "bad.stl"),
    ):
        scene = dataclasses.replace(
            load_scene("relief"), object=dataclasses.replace(inside_out, file=str(tmp_path / file))
        )
        with pytest.raises(PlanError, match=message):
            resolve(scene)
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(UsageError, match=r"a mesh needs trimesh: pip install .*\[mesh\]"):
        true_object(dataclasses.replace(inside_out, spacing_mm=3.0))


def test_a_saved_scene_takes_its_heights_along(tmp_path):
    scene = load_scene("relief", {"task.length_mm": 4.0, "task.width_mm": 2.0})
    write_scene(canprobe.plan(scene), tmp_path)
    assert (tmp_path / "relief.npz").is_file()
    there = load_scene(tmp_path / "scene.toml")
    assert there.object.file == str(tmp_path / "relief.npz")
    assert true_object(there.object).closest((-0.12, -0.12, 0.4)).point == pytest.approx(
        true_object(scene.object).closest((-0.12, -0.12, 0.4)).point, abs=0.0
    )


@pytest.mark.parametrize(("unit_mm", "size"), [(500, "20 mm by 15 mm"), (1e3 / 25.4, "narrower than 7 spacings")])
def test_a_mesh_narrower_than_the_pad_is_refused_with_its_size_and_unit(unit_mm, size, tmp_path):
    mesh = dataclasses.replace(cap(tmp_path, "cap.stl"), unit_mm=unit_mm, origin_mm=None, spacing_mm=1)
    with pytest.raises(PlanError, match=r"unit_mm = .* the unit of the file") as refused:
        resolve(dataclasses.replace(load_scene("relief"), object=mesh))
    assert size in str(refused.value)


def test_heights_narrower_than_the_pad_are_refused_and_without_an_array_nothing_is(tmp_path):
    heights = ObjectSettings("heights", file=write(tmp_path, "bump.npy", BUMP_MM), spacing_mm=0.8)
    scene = dataclasses.replace(load_scene("relief"), object=heights)
    with pytest.raises(PlanError, match=r"32 mm by 24 mm, narrower than the pad of 25\.4 mm that touches it"):
        resolve(scene)
    assert resolve(dataclasses.replace(scene, object=dataclasses.replace(heights, spacing_mm=0.9))).truth.object


def dome(folder, whole):
    """A shallow dome of 48 mm by 48 mm, or the disc in it, as a scene for the relief's path."""
    trimesh = pytest.importorskip("trimesh")
    x, y = (one.ravel() for one in np.meshgrid(*[np.linspace(-24, 24, 49)] * 2, indexing="ij"))
    faces = facets(49, 49)
    faces = faces[(whole | (np.hypot(x, y) <= 24))[faces].all(axis=1)]
    trimesh.Trimesh(np.column_stack((x, y, -(x * x + y * y) / 400)), faces, process=False).export(folder / "dome.stl")
    text = (scenes_folder() / "relief.toml").read_text().replace("width_mm = 6", "width_mm = 2")
    text = text.replace('"heights"', '"mesh"').replace("relief.npz", "dome.stl")
    (folder / "dome.toml").write_text(text)
    return str(folder / "dome.toml")


def test_a_path_beyond_the_border_of_a_mesh_is_refused(tmp_path, capsys):
    scene = dome(tmp_path, False)
    assert main(["plan", scene, "--set", "task.length_mm=42"]) == 0
    assert main(["plan", scene, "--set", "task.length_mm=49"]) == 2  # inside of the square round the disc
    assert re.search(r"at \(-1\d\d\.\d, .* mm the path leaves the object .* shorten task", capsys.readouterr().err)


def test_a_probe_that_leaves_a_mesh_is_stopped_and_touches_nothing_beyond(tmp_path):
    """The true arm is a third longer than the plan knows, so that its path is too."""
    longer = re.sub(
        r"(?m)^([ad]_mm = )(.*)$",
        lambda m: f"{m[1]}{1.3 * float(m[2])}",
        packaged_files("cells")["puma260"].read_text(),
    )
    (tmp_path / "longer.toml").write_text(longer)
    changes = {"object.origin_mm": "[0, 18.4]", "plant.true_cell": '"longer.toml"', "outputs.figures": "false"}
    changes |= {"task.heading_deg": 90, "task.length_mm": 10, "object.rotation_deg": "[0, 0, 0]"}
    changes |= {"shape.also": "[]", "cycle.rate_hz": 200}
    words = [word for key, value in changes.items() for word in ("--set", f"{key}={value}")]
    scene, out = Path(dome(tmp_path, True)), tmp_path / "run"
    scene.write_text(scene.read_text().replace("width_mm = 2", 'strategy = "straight"'))
    assert main(["run", str(scene), "--bus", "direct", "--duration", "3", "--out", str(out), *words]) == 1
    truth = read_npz(out / "truth.npz")
    points = truth["contact_point_m"][truth["in_contact"]]
    assert points[:, 1].max() == pytest.approx(-0.1225 + 0.024 - 0.0184, abs=1e-6)  # the border
