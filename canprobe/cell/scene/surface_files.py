"""Objects whose surface is read from a file: a grid of heights, or a mesh."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.npz import unpack_npz
from canprobe.cell.scene.hardware import MM
from canprobe.cell.scene.model import ObjectSettings
from canprobe.cell.scene.stl_files import stl_damage
from canprobe.errors import needed_module, regular_file
from canprobe.mechanics.touch.heights import Heights
from canprobe.mechanics.touch.mesh_curvature import CurvatureError
from canprobe.mechanics.touch.mesh_fit import HeightGrid, MeshHeights, fit_mesh
from canprobe.mechanics.touch.objects import make_object
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

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
    trimesh = needed_module("trimesh", "mesh", "object.file: a mesh needs trimesh:")
    _refuse_other_content(path)
    try:
        damage = stl_damage(path.read_bytes()) if path.suffix.lower() == ".stl" else None
    except OSError as error:
        raise ValueError(f"file: {path}: cannot be read: {error.strerror}") from error
    if damage is not None:
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


def _refuse_other_content(path: Path) -> None:
    """Refuse content that stands in the place of a file which was not downloaded, or not whole."""
    try:
        with regular_file(path).open("rb") as file:
            start = file.read(200)
    except OSError:  # which its reader names
        return
    if not start.strip():
        raise ValueError(f"file: {path.name} is empty: {_RETRY_HINT}")
    if start.startswith(b"version https://git-lfs"):
        raise ValueError(
            f"file: {path.name} is a pointer of Git LFS, not the file: type `git lfs pull` where it is from"
        )
    if start.lstrip().lower().startswith((b"<!doctype html", b"<html")):
        raise ValueError(f"file: {path.name} is an HTML page: download the file itself (raw)")


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
    _refuse_other_content(path)
    try:
        content = regular_file(path).read_bytes()
    except OSError as error:
        raise ValueError(f"file: {path}: cannot be read: {error.strerror}") from error
    try:
        if kind in (".csv", ".txt"):
            return _of_text(content.decode("utf-8-sig")), None
        if content.startswith(b"PK"):
            return _of_archive(unpack_npz(BytesIO(content), mapped=False))
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


def _of_archive(arrays: dict[str, Any]) -> tuple[Floats, float | None]:
    heights = arrays.get("heights", next(iter(arrays.values())) if len(arrays) == 1 else None)
    if heights is None:
        raise ValueError(f'expected an array "heights", got {", ".join(arrays) or "none"}')
    spacing = float(arrays["spacing"]) if "spacing" in arrays else None
    return np.asarray(heights, dtype=np.float64), spacing
