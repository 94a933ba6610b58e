"""A surface map as a file, with all of S of the answers of its scan: ``surface.npz``, plain arrays, no pickle.

The file has the nodes of the map (`canprobe.mechanics.touch.map`), from which the surface is solved when it is asked.
Base frame; n nodes, k answers:

===========================  ===========  ==============================================================================
``format_version``           ()           4
``pad_radius_m``             ()           radius of the probe; NaN where the contacts are points
``pad_stiffness_n_m3``       ()           stated stiffness of its layer; NaN likewise
``stiffness_n_m3``           ()           stiffness that the contacts show; NaN likewise
``stiffness_log_sigma``      ()           standard deviation of its logarithm; NaN likewise
``sigma_lateral_m``          ()           usual standard deviation of a contact along the surface
``sigma_height_m``           ()           standard deviation of a height; infinite: not used
``sigma_normal_rad``         ()           standard deviation of a normal; infinite: not used
``path_per_sample_m``        (3,)         path per independent height, normal, image; 0: every contact is independent
``sigma_common``             (4,)         of lag (m), relative scale of the pad, its offsets (m); 0: none
``sigma_place_m``            ()           of where the whole surface is along its normals, by tool and arm
``centre_m``                 (n, 3)       centre of the probe; the contact point where there is none
``normal``                   (n, 3)       outward unit normal of the object
``pad_axes``                 (n, 3, 3)    rows: axes x, y, z of the probe
``heading``                  (n, 3)       direction of the path, shorter where passes differ in it
``root_force_n``             (n,)         mean √force, √N
``lateral_variance_m2``      (n,)         variance of the error along the surface
``height_variance_m2``       (n,)         variance of the height
``normal_variance_rad2``     (n,)         variance of the normal by itself
``patch_m2``                 (n,)         √det of the second moments of the patch; NaN without an image
``contacts``                 (n,)         number of contacts
``path_m``                   (n,)         path that they stand for
``answer_t_s``               (k,)         time of an answer of the estimator in the loop, on the clock of the log
``answer_T_base_contact_m``  (k, 4, 4)    its contact frame
``answer_S``                 (k, 4, 4)    S in that frame; not observed: NaN
``answer_covariance``        (k, 10, 10)  covariance of the upper triangle of S, row by row; not observed: NaN, infinite
===========================  ===========  ==============================================================================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.npz import read_npz, write_npz
from canprobe.cell.tasks.shape import ShapeRecord
from canprobe.errors import UsageError
from canprobe.mechanics.touch import MapNoise, PadLayer, SurfaceMap
from canprobe.mechanics.touch.map import nodes as column
from canprobe.mechanics.touch.map.stiffness import Stiffness
from canprobe.mechanics.types import Floats

SURFACE, FORMAT_VERSION = "surface.npz", 4
_OF_LAYER = ("pad_radius_m", "pad_stiffness_n_m3", "stiffness_n_m3", "stiffness_log_sigma")
_OF_NOISE = ("sigma_lateral_m", "sigma_height_m", "sigma_normal_rad")
_PER_MAP: dict[str, tuple[int, ...]] = {
    **dict.fromkeys((*_OF_LAYER, *_OF_NOISE), ()),
    "path_per_sample_m": (3,),
    "sigma_common": (4,),
    "sigma_place_m": (),
}
_PER_NODE: dict[str, tuple[slice | int, tuple[int, ...]]] = {
    "centre_m": (column.CENTRE, (3,)),
    "normal": (column.NORMAL, (3,)),
    "pad_axes": (slice(column.X_PAD.start, column.Z_PAD.stop), (3, 3)),
    "heading": (column.HEADING, (3,)),
    "root_force_n": (column.ROOT_FORCE, ()),
    "lateral_variance_m2": (column.LATERAL2, ()),
    "height_variance_m2": (column.HEIGHT2, ()),
    "normal_variance_rad2": (column.NORMAL2, ()),
    "patch_m2": (column.PATCH, ()),
    "contacts": (column.COUNT, ()),
    "path_m": (column.PATH, ()),
}
"""Columns of a node and their shape, by name."""
_POSITIVE = (*_OF_NOISE, "lateral_variance_m2", "height_variance_m2", "normal_variance_rad2", "contacts", "path_m")
_MAY_BE_INFINITE = ("sigma_height_m", "sigma_normal_rad", "height_variance_m2", "normal_variance_rad2")
_PER_ANSWER = {"answer_t_s": (), "answer_T_base_contact_m": (4, 4), "answer_S": (4, 4), "answer_covariance": (10, 10)}
"""Columns of an answer and their shape; form 3 has none of them."""
_COLUMNS = ("format_version", *_PER_MAP, *_PER_NODE, *_PER_ANSWER)
_MAX_LENGTH_ERROR = 1e-6


def save_surface_map(surface_map: SurfaceMap, path: str | PathLike[str], answers: Sequence[ShapeRecord] = ()) -> None:
    """Write a map and all of S of answers to exactly this file (numpy would append ``.npz`` to a name without it)."""
    pad, noise, rows = surface_map.pad, surface_map.noise, surface_map.nodes.rows
    found = surface_map.stiffness if len(rows) else None
    layer = (*(pad or (math.nan, math.nan)), *(found or (math.nan, math.nan)))
    columns: dict[str, NDArray[np.generic]] = {"format_version": np.array(FORMAT_VERSION)}
    columns |= {name: np.array(value) for name, value in zip(_OF_LAYER, layer, strict=True)}
    usual = (noise.lateral, noise.height, noise.normal)
    columns |= {name: np.array(value) for name, value in zip(_OF_NOISE, usual, strict=True)}
    columns["path_per_sample_m"] = np.array([noise.height_path, noise.normal_path, noise.image_path])
    columns["sigma_common"], columns["sigma_place_m"] = np.array(noise.common), np.array(noise.place)
    columns |= {name: rows[:, where].reshape(-1, *shape) for name, (where, shape) in _PER_NODE.items()}
    matrices = [(one.t_s, one.estimate.T_frame_contact, *one.estimate.matrix()) for one in answers]
    for i, (name, shape) in enumerate(_PER_ANSWER.items()):
        columns[name] = np.array([one[i] for one in matrices]).reshape(-1, *shape)
    write_npz(Path(path), columns)


def load_surface_map(path: str | PathLike[str]) -> SurfaceMap:
    """Read a map that `save_surface_map` or ``canprobe run`` has written.

    Args:
        path: path of the file, or of the folder of a run.

    Returns:
        The map; it takes more contacts.

    Raises:
        UsageError: no such file, not a surface map, another version, or a column that is missing, unknown or wrong;
            the message names the file and the column.
    """
    file = Path(path)
    if file.is_dir():
        file = file / SURFACE
    if not file.exists():
        raise UsageError(f"{file}: no such file; a run writes {SURFACE} where its scene asks for a shape")
    columns = read_npz(file, "an npz file with a surface map")
    if (version := columns.get("format_version")) is None:
        raise UsageError(f"{file}: expected a surface map, got a file without 'format_version'")
    if version.shape != () or version not in (FORMAT_VERSION - 1, FORMAT_VERSION):
        raise UsageError(
            f"{file}: expected format_version {FORMAT_VERSION}, got {version} of another canprobe; make the map again"
            f' of the run\'s contacts: canprobe.replay("{file.parent}").surface_map'
        )
    newer = () if version == FORMAT_VERSION else tuple(_PER_ANSWER)
    if missing := [name for name in _COLUMNS if name not in columns and name not in newer]:
        raise UsageError(f"{file}: missing {', '.join(missing)}")
    if unknown := [name for name in columns if name not in _COLUMNS]:
        raise UsageError(f"{file}: unknown {', '.join(unknown)}; expected {', '.join(_COLUMNS)}")
    n = len(columns["contacts"]) if columns["contacts"].ndim else 0
    wanted = _PER_MAP | {name: (n, *shape) for name, (_, shape) in _PER_NODE.items()}
    values = {name: _checked(file, name, columns[name], shape) for name, shape in wanted.items()}
    if n and not np.allclose(np.linalg.norm(values["normal"], axis=1), 1.0, rtol=0.0, atol=_MAX_LENGTH_ERROR):
        raise UsageError(f"{file}: normal: expected unit vectors, got others")
    rows = np.zeros((n, column.COLUMNS))
    for name, (where, shape) in _PER_NODE.items():
        rows[:, where] = values[name].reshape(n, math.prod(shape)) if shape else values[name]
    radius, stated, found, sigma = (float(values[name]) for name in _OF_LAYER)
    lateral, height, normal = (float(values[name]) for name in _OF_NOISE)
    lag, scale, x, y = values["sigma_common"].tolist()
    of_height, of_normal, of_image = values["path_per_sample_m"].tolist()
    common, place = (lag, scale, x, y), float(values["sigma_place_m"])
    noise = MapNoise(lateral, height, normal, of_height, of_normal, of_image, common, place)
    return SurfaceMap.of_nodes(
        rows,
        None if math.isnan(radius) else PadLayer(radius, stated),
        noise,
        None if math.isnan(found) else Stiffness(found, sigma),
    )


def _checked(file: Path, name: str, values: NDArray[np.generic], shape: tuple[int, ...]) -> Floats:
    """A column of the right kind and shape, with numbers that a map can have."""
    if values.shape != shape or values.dtype != np.float64:
        raise UsageError(
            f"{file}: {name}: expected float64 of shape {shape}, got {values.dtype} of shape {values.shape}"
        )
    found = values.astype(np.float64)
    if name in _OF_LAYER or name == "patch_m2":
        right = np.isnan(found) | (np.isfinite(found) & (found > 0.0 if name != "patch_m2" else found >= 0.0))
        expected = "numbers above 0, or NaN"
    elif name in _POSITIVE:
        right = (found > 0.0) & (np.isfinite(found) | (name in _MAY_BE_INFINITE))
        expected = "numbers above 0"
    else:
        right, expected = np.isfinite(found), "finite numbers"
    if not right.all():
        raise UsageError(f"{file}: {name}: expected {expected}, got {found[~right].ravel()[0]}")
    return found
