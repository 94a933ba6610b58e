"""The geometry that a scene describes, in SI units and the base frame, and what a calibration found of it.

An object's surface may be read from a file: a grid of heights, or a mesh. Readers of STL take what they find, of a file
that was cut a part of the body: so such a file is looked at first.
Source: 3D Systems, StereoLithography Interface Specification, 1989: a text of `facet` statements between `solid` and
`endsolid`, or 80 bytes, the number of facets, and 50 bytes for each of them.
"""

from __future__ import annotations

import logging
import math
import re
import warnings
from collections.abc import Iterator
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from canprobe.cell.npz import NpzColumns
from canprobe.cell.scene.hardware import MM, Vec3
from canprobe.cell.scene.model import ObjectSettings, ProbeSettings, TaskSettings
from canprobe.errors import needed_module, regular_file
from canprobe.mechanics.robot.denavit_hartenberg import rotation_rpy, tool_z_offset
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.touch.heights import Heights
    from canprobe.mechanics.touch.mesh_curvature import CurvatureError
    from canprobe.mechanics.touch.mesh_fit import HeightGrid
    from canprobe.mechanics.touch.pad import Pad
    from canprobe.mechanics.touch.shapes import PlacedShape


def transform(position_mm: Vec3, rotation_deg: Vec3) -> Floats:
    """(4, 4), m, of a position, mm, and roll, pitch and yaw about the fixed axes, deg."""
    T = np.eye(4)
    T[:3, :3] = rotation_rpy(*(math.radians(angle) for angle in rotation_deg))
    T[:3, 3] = np.array(position_mm) * 1e-3
    return T


def T_base_object(settings: ObjectSettings) -> Floats:
    """Pose of the object frame, (4, 4), m: origin on the surface, z outward."""
    return transform(settings.position_mm, settings.rotation_deg)


def true_object(settings: ObjectSettings) -> PlacedShape:
    """The object that a scene describes.

    Raises:
        ValueError: the matrix describes no surface through the object's origin with z outward, or the file
            holds none.
        UsageError: a mesh, and no trimesh is installed.
    """
    from canprobe.mechanics.touch.objects import OBJECT_PARAMETERS, make_object

    if settings.file is not None:
        return object_of_file(settings, T_base_object(settings))
    values: dict[str, object] = {"matrix": np.array(settings.matrix), "angle": math.radians(settings.angle_deg or 0.0)}
    params = {
        name: values[name] if name in values else getattr(settings, f"{name}_mm") * 1e-3
        for name in OBJECT_PARAMETERS[settings.kind]
    }
    return make_object(settings.kind, T_base_object=T_base_object(settings), **params)


def T_flange_probe(probe: ProbeSettings) -> Floats:
    """Frame of the probe's centre on the flange, (4, 4), m; z is the pole."""
    T = tool_z_offset(probe.centre_offset_mm)
    T[:2, 3] = np.array(probe.centre_lateral_mm) * 1e-3
    return T


def approach_normal(task: TaskSettings) -> Floats:
    """Unit outward normal that the approach expects, (3,)."""
    normal = np.array(task.approach_normal)
    unit: Floats = normal / np.linalg.norm(normal)
    return unit


def scan_axes(task: TaskSettings) -> Floats:
    """Axes of the scan plane, (3, 3): rows heading, across, approach normal; right-handed.

    The heading is given in the base xy-plane and carried into the plane perpendicular to the approach normal.
    """
    normal = approach_normal(task)
    heading = math.radians(task.heading_deg)
    along = np.array((math.cos(heading), math.sin(heading), 0.0))
    along -= normal * float(normal @ along)
    along /= np.linalg.norm(along)
    return np.array((along, np.cross(normal, along), normal))


def expected_ball(task: TaskSettings) -> tuple[Floats, float]:
    """Centre (3,), m, base frame, and radius, m, of the ball: its top is at `start_mm`."""
    radius = task.ball_radius_mm * 1e-3
    return np.array(task.start_mm) * 1e-3 - radius * approach_normal(task), radius


HEIGHTS = (".npy", ".npz", ".csv", ".txt")
MESHES = (".stl", ".obj", ".ply")
NO_DATA = (-9999.0, -99999.0, -32768.0, -32767.0, 65535.0)
"""Values that measuring machines and map programs write for missing heights; they count so only as far outliers."""
_MAX_HEIGHT_MM, _FAR = 1e30, 10.0
_MIN_SLOPE, _MAX_SLOPE = 5e-4, 20.0
"""Range of the rise of a surface over the width of its grid; outside of it one of them is in another unit."""
_MIN_WIDTH_MM = 1.0
_RETRY_HINT = "get the file again, or export it again"


def object_of_file(settings: ObjectSettings, T_base_object: Floats) -> PlacedShape:
    """The object whose surface is read from a file.

    Raises:
        ValueError: the file cannot be read, or holds no surface; with what was expected and found.
        UsageError: a mesh, and no trimesh is installed.
    """
    from canprobe.mechanics.touch.mesh_fit import MeshHeights
    from canprobe.mechanics.touch.objects import make_object

    assert settings.file is not None
    path = Path(settings.file)
    if settings.kind == "heights":
        grid = _heights(settings, path)
        try:
            return make_object("heights", T_base_object=T_base_object, **grid)
        except ValueError as error:
            raise ValueError(f"file: {path.name}: {error}; correct the file, or origin_mm") from error
    if path.suffix.lower() not in MESHES:
        raise ValueError(f"file: expected a mesh in a file of {', '.join(MESHES)}, got {path.name}")
    try:
        changed_ns = regular_file(path).stat().st_mtime_ns
    except OSError as error:
        raise ValueError(f"file: {path}: cannot be read: {error.strerror}") from error
    spacing = None if settings.spacing_mm is None else settings.spacing_mm * MM
    fit = _mesh(path, changed_ns, settings.unit_mm * MM, spacing, settings.origin_mm)
    try:
        return MeshHeights(T_base_object, fit)
    except ValueError as error:
        x, y = (1e3 * fit.spacing * (nodes - 1) for nodes in fit.heights.shape)
        way_out = "remove vertices far away, or give origin_mm"
        raise ValueError(f"file: {path.name}: the mesh is {x:.3g} mm by {y:.3g} mm; {error}: {way_out}") from error


def mesh_text(fit: HeightGrid) -> str:
    """A mesh and the surface that was fitted to it, in words."""
    state = fit.state
    closed = "watertight" if state.open_edges == state.odd_edges == 0 else f"{state.open_edges} open edges"
    known = "" if fit.curvature is None else f", curvature within {_off(fit.curvature)} of the mesh's"
    return (
        f"mesh of {state.vertices} vertices and {state.facets} facets, {closed}; fitted every"
        f" {1e3 * fit.spacing:.3g} mm{known}"
    )


def mesh_warnings(fit: HeightGrid) -> Iterator[str]:
    """What was put in order in a mesh, and a curvature that the surface has not from it."""
    state, error = fit.state, fit.curvature
    found = {
        f"{state.merged} vertices merged with others up to {1e9 * state.merged_m:.2g} nm away": state.merged,
        f"{state.turned} of {state.facets} facets turned over, as their neighbours face": state.turned,
        f"{state.odd_edges} edges belong to more than two facets": state.odd_edges,
    }
    if said := "; ".join(text for text, count in found.items() if count):
        yield f"object.file: the mesh was put in order: {said}"
    if error is None or error.is_small:
        return
    spacing = f"object.spacing_mm = {1e3 * fit.spacing:.3g}: the curvature is {_off(error)} off that of the mesh"
    if fit.better is not None:
        yield f"{spacing}; with object.spacing_mm = {1e3 * fit.better[0]:.3g} it is {_off(fit.better[1])} off"
    else:
        yield f"{spacing}, and no other spacing is much better: export the mesh finer, or smoother if it was measured"


def _off(error: CurvatureError) -> str:
    return f"{error.error:.2g} 1/m ({100 * error.share:.2g} %)" if error.curvature > 1.0 else f"{error.error:.2g} 1/m"


def refuse_narrow(settings: ObjectSettings, shape: Heights, pad: Pad) -> None:
    """Raise ValueError for a surface of a file that ends within the pad which is to touch it."""
    x, y = (1e3 * (far - near) for near, far in zip(shape.spline.corner, shape.spline.far, strict=True))
    pad_mm = 2e3 * pad.reach_m
    if settings.file is not None and min(x, y) < pad_mm:
        raise ValueError(
            f"file: {Path(settings.file).name}: its surface is {x:.3g} mm by {y:.3g} mm, narrower than the pad of"
            f" {pad_mm:.3g} mm that touches it; is unit_mm = {settings.unit_mm:g} the unit of the file? If it is, touch"
            " a wider surface"
        )


@lru_cache(maxsize=4)
def _mesh(
    path: Path, changed_ns: int, unit: float, spacing: float | None, origin_mm: tuple[float, float] | None
) -> HeightGrid:
    """The surface of a mesh; of a file that has not changed it is fitted once."""
    from canprobe.mechanics.touch.mesh_fit import fit_mesh

    trimesh = needed_module("trimesh", "mesh", "object.file: a mesh needs trimesh:")
    content = _content(path)
    if path.suffix.lower() == ".stl" and (damage := stl_damage(content)) is not None:
        raise ValueError(f"file: {path.name} is a damaged STL: {damage}; {_RETRY_HINT}")
    logging.getLogger("trimesh").addHandler(logging.NullHandler())  # it logs tracebacks of what it does without
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", message="string or file could not be read to its end")  # numpy goes on
            read = trimesh.load_mesh(path, process=False)
    except Exception as error:  # each of its readers has its own
        why = str(error) or type(error).__name__
        raise ValueError(f"file: {path.name} is no mesh that can be read: {why}; {_RETRY_HINT}") from error
    if not len(getattr(read, "faces", ())):
        raise ValueError(f"file: {path.name} holds no facets: export the body as a mesh of triangles")
    origin = None if origin_mm is None else np.array(origin_mm) * MM
    try:
        return fit_mesh(read.vertices * unit, read.faces, spacing, origin)
    except ValueError as error:
        units = f"; is unit_mm = {1e3 * unit:g} the unit of the file?" if "narrower" in str(error) else ""
        raise ValueError(f"file: {path.name}: {error}{units}") from error


def _content(path: Path) -> bytes:
    """The content of a file; refused is what stands in the place of one which was not downloaded, or not whole."""
    try:
        content = regular_file(path).read_bytes()
    except OSError as error:
        raise ValueError(f"file: {path}: cannot be read: {error.strerror}") from error
    start = content[:200]
    if not start.strip():
        raise ValueError(f"file: {path.name} is empty: {_RETRY_HINT}")
    if start.startswith(b"version https://git-lfs"):
        raise ValueError(
            f"file: {path.name} is a pointer of Git LFS, not the file: type `git lfs pull` where it is from"
        )
    if start.lstrip().lower().startswith((b"<!doctype html", b"<html")):
        raise ValueError(f"file: {path.name} is an HTML page: download the file itself (raw)")
    return content


def _heights(settings: ObjectSettings, path: Path) -> dict[str, Any]:
    z, spacing = _grid(path)
    if settings.spacing_mm is not None:
        spacing = settings.spacing_mm / settings.unit_mm
    if spacing is None:
        raise ValueError("spacing_mm: missing: the file holds heights only; give the spacing of their grid")
    if z.ndim != 2:
        raise ValueError(f"file: {path.name}: expected a grid of heights (rows × columns), got shape {z.shape}")
    if not np.isfinite(z).all():
        row, column = np.argwhere(~np.isfinite(z))[0].tolist()
        raise ValueError(
            f"file: {path.name}: height {z[row, column]} in row {row + 1}, column {column + 1}: fill gaps first"
        )
    huge = np.abs(z) > _MAX_HEIGHT_MM
    gaps = z[np.isin(z, NO_DATA) | huge]
    if huge.any() or (gaps.size and np.ptp(z) > _FAR * np.ptp(_without(z, gaps[0]))):
        raise ValueError(
            f"file: {path.name}: {gaps.size} of {z.size} heights are {gaps[0]:g}: no data; fill gaps first"
        )
    _refuse_other_unit(path, z, spacing, settings.unit_mm)
    unit = settings.unit_mm * MM
    middle = 0.5 * spacing * unit * (np.array(z.shape) - 1)
    origin = np.zeros(2) if settings.origin_mm is None else np.array(settings.origin_mm) * MM - middle
    return {"heights": z * unit, "spacing": spacing * unit, "origin": origin}


def _without(z: Floats, value: float) -> Floats:
    rest: Floats = z[z != value]
    return rest if rest.size else np.zeros(1)


def _refuse_other_unit(path: Path, z: Floats, spacing: float, unit_mm: float) -> None:
    """Refuse heights and spacing of different units: together they give a wall, or a flat surface that is no plane."""
    rise, width = float(np.ptp(z)), spacing * min(z.shape)
    if unit_mm * width < _MIN_WIDTH_MM or (rise > 0.0 and not _MIN_SLOPE < rise / width < _MAX_SLOPE):
        raise ValueError(
            f"file: {path.name}: its heights rise by {unit_mm * rise:.3g} mm over a grid {unit_mm * width:.3g} mm wide:"
            f" are heights and spacing in one unit, and is unit_mm = {unit_mm:g} that unit?"
        )


def _grid(path: Path) -> tuple[Floats, float | None]:
    """Heights in the file's unit, and their spacing where the file holds it."""
    kind = path.suffix.lower()
    if kind not in HEIGHTS:
        raise ValueError(f"file: expected heights in a file of {', '.join(HEIGHTS)}, got {path.name}")
    content = _content(path)
    try:
        if kind in (".csv", ".txt"):
            return _of_text(content.decode("utf-8-sig")), None
        if content.startswith(b"PK"):
            return _of_archive(NpzColumns(BytesIO(content), ""))
        return np.asarray(np.load(BytesIO(content)), dtype=np.float64), None
    except UnicodeDecodeError as error:
        why = f"byte {error.start} is {error.object[error.start]:#04x}, which is no text"
        raise ValueError(f"file: {path.name} is no grid of numbers: {why}; {_RETRY_HINT}") from error
    except Exception as error:  # numpy raises what zip, its decompression and the parser of headers raise
        why = "it is damaged, or holds Python objects" if "pickle" in str(error) else str(error) or type(error).__name__
        raise ValueError(f"file: {path.name} is no grid of numbers: {why}; {_RETRY_HINT}") from error


def _of_text(text: str) -> Floats:
    """The numbers of a text, a row on each line."""
    rows = [line.partition("#")[0] for line in text.splitlines()]
    if any(";" in row for row in rows):  # then a comma is a decimal one
        rows = [row.replace(",", ".").replace(";", " ") for row in rows]
    grid: list[list[float]] = []
    for number, row in enumerate(rows, start=1):
        try:
            values = [float(word) for word in row.replace(",", " ").split()]
        except ValueError as error:
            raise ValueError(f"line {number}: expected numbers, got {str(error).rpartition(': ')[2]}") from error
        if values and grid and len(values) != len(grid[0]):
            raise ValueError(f"line {number}: expected {len(grid[0])} numbers as above, got {len(values)}")
        grid += [values] if values else []
    return np.array(grid)


def _of_archive(arrays: NpzColumns) -> tuple[Floats, float | None]:
    heights = arrays.get("heights", next(iter(arrays.values())) if len(arrays) == 1 else None)
    if heights is None:
        raise ValueError(f'expected an array "heights", got {", ".join(arrays) or "none"}')
    spacing = float(arrays["spacing"]) if "spacing" in arrays else None
    return np.asarray(heights, dtype=np.float64), spacing


_HEAD, _FACET = 84, 50
_NUMBER = rb"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
_STATEMENTS = {
    "facet normal and three numbers, or endsolid": rb"facet\s+normal\s+\S+\s+\S+\s+\S+",  # of no area it may be nan
    "outer loop": rb"outer\s+loop",
    "vertex and three numbers": rb"vertex" + 3 * (rb"\s+" + _NUMBER),
    "a second vertex and three numbers": rb"vertex" + 3 * (rb"\s+" + _NUMBER),
    "a third vertex and three numbers": rb"vertex" + 3 * (rb"\s+" + _NUMBER),
    "endloop": rb"endloop",
    "endfacet": rb"endfacet",
}


def _pattern(text: bytes) -> re.Pattern[bytes]:
    return re.compile(rb"\s*" + text + rb"(?=\s|\Z)", re.IGNORECASE)


_WHOLE = _pattern(rb"\s+".join(_STATEMENTS.values()))
_EACH = {expected: _pattern(statement) for expected, statement in _STATEMENTS.items()}
_SOLID, _ENDSOLID = _pattern(rb"solid(?:[ \t][^\n]*)?"), _pattern(rb"endsolid(?:[ \t][^\n]*)?")


def stl_damage(content: bytes) -> str | None:
    """The damage of an STL file, with the line or the number of bytes; None where the file is whole."""
    facets, size = int.from_bytes(content[80:_HEAD], "little"), len(content)
    if size >= _HEAD and size == _HEAD + _FACET * facets:  # its head may begin with "solid" as well
        return None if facets else "it holds no facet"
    head = content[:1000].lower()
    if head.lstrip().startswith(b"solid") and (b"facet" in head or b"\0" not in head):
        return _text_damage(content)
    if size < _HEAD:
        return f"it ends at byte {size}, within the {_HEAD} bytes of its head"
    return f"{size} bytes, by the {facets} facets of its head {_HEAD + _FACET * facets}"


def _text_damage(text: bytes) -> str | None:
    solid, facets = _SOLID.match(text), 0
    if solid is None:
        return _unexpected(text, 0, "solid and a name")
    at = solid.end()
    while True:
        if (facet := _WHOLE.match(text, at)) is not None:
            at, facets = facet.end(), facets + 1
        elif (end := _ENDSOLID.match(text, at)) is not None:
            if (solid := _SOLID.match(text, end.end())) is None:
                break
            at = solid.end()
        else:
            for expected, statement in _EACH.items():
                if (found := statement.match(text, at)) is None:
                    return _unexpected(text, at, expected)
                at = found.end()
    if text[end.end() :].strip():
        return _unexpected(text, end.end(), "the end of the file")
    return None if facets else "it holds no facet"


def _unexpected(text: bytes, at: int, expected: str) -> str:
    at += len(text[at:]) - len(text[at:].lstrip())
    got = text[at : at + 40].partition(b"\n")[0].strip().decode("ascii", errors="replace")
    if not got:
        at = len(text.rstrip())
    line = text.count(b"\n", 0, at) + 1
    return f"line {line}: expected {expected}, got {got!r}" if got else f"line {line}: the file ends before {expected}"
