"""Objects whose surface is read from a file: a grid of heights, or a mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from canprobe.scene.model import ObjectSettings

Array = NDArray[np.float64]

HEIGHTS = (".npy", ".npz", ".csv", ".txt")
_MM = 1e-3


def surface_of_file(settings: ObjectSettings) -> dict[str, Any]:
    """The parameters of `make_object` for a kind that is read from a file, in m.

    Raises:
        ValueError: the file cannot be read, or holds no surface; with what was expected and found.
    """
    assert settings.file is not None
    return _heights(settings, Path(settings.file))


def _heights(settings: ObjectSettings, path: Path) -> dict[str, Any]:
    z, spacing = _grid(path)
    if settings.spacing_mm is not None:
        spacing = settings.spacing_mm / settings.unit_mm
    if spacing is None:
        raise ValueError("spacing_mm: missing: the file holds heights only; give the spacing of their grid")
    if z.ndim != 2:
        raise ValueError(f"file: expected a grid of heights (rows × columns), got shape {z.shape} in {path.name}")
    unit = settings.unit_mm * _MM
    middle = 0.5 * spacing * unit * (np.array(z.shape) - 1)
    origin = np.zeros(2) if settings.origin_mm is None else np.array(settings.origin_mm) * _MM - middle
    return {"heights": z * unit, "spacing": spacing * unit, "origin": origin}


def _grid(path: Path) -> tuple[Array, float | None]:
    """Heights in the file's unit, and their spacing where the file holds it."""
    kind = path.suffix.lower()
    if kind not in HEIGHTS:
        raise ValueError(f"file: expected heights in a file of {', '.join(HEIGHTS)}, got {path.name}")
    try:
        if kind == ".npz":
            with np.load(path) as archive:
                return _of_archive({name: archive[name] for name in archive.files}, path)
        if kind == ".npy":
            return np.asarray(np.load(path), dtype=np.float64), None
        text = path.read_text(encoding="utf-8-sig").splitlines()
        lines = [line.partition("#")[0].replace(";", ",").replace(",", " ").split() for line in text]
        return np.array([[float(word) for word in line] for line in lines if line]), None
    except OSError as error:
        raise ValueError(f"file: {path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, TypeError, EOFError, BadZipFile) as error:
        raise ValueError(f"file: {path.name} is no grid of numbers: {error}") from error


def _of_archive(arrays: dict[str, Any], path: Path) -> tuple[Array, float | None]:
    heights = arrays.get("heights", next(iter(arrays.values())) if len(arrays) == 1 else None)
    if heights is None:
        raise ValueError(f'expected an array "heights", got {", ".join(arrays) or "none"}')
    spacing = float(arrays["spacing"]) if "spacing" in arrays else None
    return np.asarray(heights, dtype=np.float64), spacing
