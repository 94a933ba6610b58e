"""A surface map as a file: ``surface.npz``, plain arrays, no pickle.

Columns (n patches, m path points; base frame; mixed units are SI in the stated order):

=========================  ==========  ==============================================================================
``format_version``         ()          1
``method``                 ()          estimator
``t_s``                    (n,)        instant of the last sample
``travelled_m``            (n,)        path of the contact until then
``T_base_contact_m``       (n, 4, 4)   contact frame to base; z is the inward normal
``S_per_m``                (n, 4, 4)   surface matrix in the contact frame, c34 = −½
``K_covariance_per_m2``    (n, 3, 3)   of (K11, K12, K22); NaN, infinite where not observed
``S_covariance_si``        (n, 9, 9)   of (c14, c24, c44, c13, c23, c33, c11, c12, c22): –, –, m, 1/m …
``pose_known``             (n,)        1 where ``S_covariance_si`` has height and tilt
``observed``               (n, 2)      1 for each principal curvature that was observed
``combinations``           (n, 3, 3)   rows: observed combinations of (K11, √2 K12, K22); NaN beyond the rank
``memory_m``               (n,)        path from which the patch was estimated
``innovation``             (n,)        mean squared whitened residual per degree of freedom
``path_m``                 (m, 3)      contact points
=========================  ==========  ==============================================================================
"""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.npz import read_npz, write_npz
from canprobe.errors import UsageError
from canprobe.mechanics.touch.surface_map import LocalPatch, SurfaceMap
from canprobe.mechanics.types import Floats

FORMAT_VERSION = 1
_PER_PATCH: dict[str, tuple[str, tuple[int, ...]]] = {
    "t_s": ("t_s", ()),
    "travelled_m": ("travelled_m", ()),
    "T_base_contact_m": ("T_base_contact", (4, 4)),
    "S_per_m": ("S", (4, 4)),
    "K_covariance_per_m2": ("K_covariance", (3, 3)),
    "S_covariance_si": ("S_covariance", (9, 9)),
    "pose_known": ("pose_known", ()),
    "observed": ("observed", (2,)),
    "combinations": ("combinations", (3, 3)),
    "memory_m": ("distance_m", ()),
    "innovation": ("innovation", ()),
}
"""Field of a patch and its shape, by column."""
_COLUMNS = ("format_version", "method", "path_m", *_PER_PATCH)


def save_surface_map(surface_map: SurfaceMap, path: str | PathLike[str]) -> None:
    """Write a map to exactly this file (numpy would append ``.npz`` to a name without it)."""
    columns: dict[str, NDArray[np.generic]] = {
        "format_version": np.array(FORMAT_VERSION),
        "method": np.array(surface_map.method),
        "path_m": surface_map.path,
    }
    for name, (field, shape) in _PER_PATCH.items():
        column = np.full((len(surface_map), *shape), np.nan)
        for i, patch in enumerate(surface_map.patches):
            value = np.asarray(getattr(patch, field), np.float64)
            column[(i, slice(len(value))) if value.ndim else i] = value
        columns[name] = column
    write_npz(Path(path), columns)


def load_surface_map(path: str | PathLike[str]) -> SurfaceMap:
    """Read a map that `save_surface_map` or ``canprobe run`` has written.

    Args:
        path: path of the file, or of the folder of a run.

    Returns:
        The map.

    Raises:
        UsageError: no such file, not a surface map, another version, or a column that is missing, unknown or wrong;
            the message names the file and the column.
    """
    file = Path(path)
    if file.is_dir():
        file = file / "surface.npz"
    if not file.exists():
        raise UsageError(f"{file}: no such file; a run writes surface.npz where its scene asks for a shape")
    columns = read_npz(file, "an npz file with a surface map")
    if (version := columns.get("format_version")) is None:
        raise UsageError(f"{file}: expected a surface map, got a file without 'format_version'")
    if version.shape != () or version != FORMAT_VERSION:
        raise UsageError(
            f"{file}: expected format_version {FORMAT_VERSION}, got {version}; write it again with this canprobe"
        )
    if missing := [name for name in _COLUMNS if name not in columns]:
        raise UsageError(f"{file}: missing {', '.join(missing)}")
    if unknown := [name for name in columns if name not in _COLUMNS]:
        raise UsageError(f"{file}: unknown {', '.join(unknown)}; expected {', '.join(_COLUMNS)}")
    method = columns["method"]
    if method.dtype.kind != "U" or method.shape != ():
        raise UsageError(f"{file}: method: expected a name, got {method.dtype} of shape {method.shape}")
    rows = len(columns["t_s"]) if columns["t_s"].ndim else 0
    wanted = {name: (rows, *shape) for name, (_, shape) in _PER_PATCH.items()}
    wanted["path_m"] = (len(columns["path_m"]) if columns["path_m"].ndim else 0, 3)
    for name, shape in wanted.items():
        if columns[name].shape != shape or columns[name].dtype != np.float64:
            raise UsageError(
                f"{file}: {name}: expected float64 of shape {shape}, got {columns[name].dtype} of {columns[name].shape}"
            )
    values = {name: columns[name].astype(np.float64) for name in wanted}
    patches: list[LocalPatch] = []
    try:
        for i in range(len(values["t_s"])):
            patches.append(_patch({field: values[name][i] for name, (field, _) in _PER_PATCH.items()}))
        return SurfaceMap(patches=tuple(patches), path=values["path_m"], method=str(method))
    except UsageError as error:
        raise UsageError(f"{file}: patch {len(patches)}: {error}") from error


def _patch(row: dict[str, Floats]) -> LocalPatch:
    combinations = row["combinations"]
    return LocalPatch(
        T_base_contact=row["T_base_contact"],
        S=row["S"],
        K_covariance=row["K_covariance"],
        S_covariance=row["S_covariance"],
        pose_known=bool(row["pose_known"]),
        observed=row["observed"],
        combinations=combinations[np.isfinite(combinations).all(axis=1)],
        t_s=float(row["t_s"]),
        travelled_m=float(row["travelled_m"]),
        distance_m=float(row["distance_m"]),
        innovation=float(row["innovation"]),
    )
