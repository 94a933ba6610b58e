"""Columns of a run as a table: pandas in memory, Parquet on disk, each with its units, and back without loss.

A column of a log may hold a vector or a matrix a row. A table has one number a cell: `q_rad` (n, 6) becomes `q_rad_0` …
`q_rad_5`, `K_per_m` (n, 2, 2) becomes `K_per_m_0_0` … `K_per_m_1_1`. Which column it was stands in the metadata.

Needs the extra `data` (pandas, pyarrow).
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.errors import UsageError
from canprobe.npz_file import read_npz, write_npz
from canprobe.whole_file import whole_file

if TYPE_CHECKING:
    import pandas

_UNITS = {
    "per_m2": "1/m^2",
    "per_m": "1/m",
    "permille": "permille",
    "m_s": "m/s",
    "rad": "rad",
    "deg": "deg",
    "mm": "mm",
    "hz": "Hz",
    "ns": "ns",
    "us": "us",
    "n": "N",
    "m": "m",
    "s": "s",
}
_TRUTH_UNITS = {  # the plant's own columns carry no suffix: they are SI
    "q": "rad",
    "probe_centre": "m",
    "force": "N",
    "depth": "m",
    "depth_rate": "m/s",
    "contact_point": "m",
    "kappa": "1/m",
    "pad_uv": "m",
}
_EXTRA = "pip install 'canprobe[data]'"
_ATTRS = b"PANDAS_ATTRS"  # where pandas itself keeps a frame's attrs in Parquet


def unit_of(name: str) -> str:
    """The unit of a column of a log, of a truth file or of estimates; `1` for what has none."""
    if name in _TRUTH_UNITS:
        return _TRUTH_UNITS[name]
    return next((unit for suffix, unit in _UNITS.items() if name.endswith(f"_{suffix}")), "1")


@dataclass(frozen=True, slots=True)
class _Cell:
    """One column of a table: of which array, and where in it."""

    name: str
    of: str
    index: tuple[int, ...]
    shape: tuple[int, ...]
    values: NDArray[Any]


def to_frame(columns: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any] | None = None) -> pandas.DataFrame:
    """Columns as a table, by time.

    Args:
        columns: arrays (n,), (n, k) or (n, k, l) with one row a cycle; the suffix of a name is its unit.
        attrs: added to the frame's `attrs`.

    Returns:
        The frame; its index is `t_s` where there is one. `attrs["units"]` maps every column to its unit.

    Raises:
        UsageError: pandas is missing, or columns differ in length.
    """
    pandas = _need("pandas", "a table")
    cells = _cells(columns)
    frame = pandas.DataFrame({cell.name: cell.values for cell in cells})
    if "t_s" in columns:
        frame = frame.set_index("t_s")
    frame.attrs = {**(attrs or {}), "units": {cell.name: unit_of(cell.of) for cell in cells}}
    return frame


def load_table(path: Path | str) -> pandas.DataFrame:
    """A table from a `.npz` of a run (`log.npz`, `truth.npz`) or from Parquet.

    Raises:
        UsageError: no such file, another kind of file, or the extra is missing.
    """
    source = Path(path)
    if source.suffix == ".npz":
        return to_frame(read_npz(source))
    columns, attrs = _read_parquet(source)
    return to_frame(columns, {name: value for name, value in attrs.items() if name != "units"})


def npz_to_parquet(npz: Path | str, parquet: Path | str, attrs: Mapping[str, Any] | None = None) -> None:
    """Write a run's `.npz` as Parquet: any tool reads the numbers, and `parquet_to_npz` all of it.

    Raises:
        UsageError: no such file, or the extra is missing.
    """
    write_parquet(read_npz(Path(npz)), parquet, attrs)


def parquet_to_npz(parquet: Path | str, npz: Path | str) -> None:
    """Write a Parquet file of ours as the `.npz` that it came from: same names, shapes, types and bits.

    Raises:
        UsageError: no such file, not one of ours, or the extra is missing.
    """
    columns, _ = _read_parquet(Path(parquet))
    write_npz(Path(npz), columns)


def write_parquet(
    columns: Mapping[str, NDArray[Any]], path: Path | str, attrs: Mapping[str, Any] | None = None
) -> None:
    """Write columns as Parquet; each field's metadata has its unit, and the array and place that it came from.

    Raises:
        UsageError: the extra is missing, or columns differ in length.
        ResultsError: the file cannot be written.
    """
    arrow = _need("pyarrow", "Parquet")
    cells = _cells(columns)
    fields, arrays = [], []
    for cell in cells:
        array = arrow.array(cell.values)
        metadata = {
            "unit": unit_of(cell.of),
            "of": cell.of,
            "index": json.dumps(cell.index),
            "shape": json.dumps(cell.shape),
        }
        fields.append(arrow.field(cell.name, array.type, metadata=metadata))
        arrays.append(array)
    units = {cell.name: unit_of(cell.of) for cell in cells}
    schema = arrow.schema(fields, metadata={_ATTRS: json.dumps({**(attrs or {}), "units": units})})
    parquet = _need("pyarrow.parquet", "Parquet")
    with whole_file(Path(path)) as part:
        parquet.write_table(arrow.Table.from_arrays(arrays, schema=schema), part)


def _cells(columns: Mapping[str, NDArray[Any]]) -> list[_Cell]:
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        raise UsageError(f"columns of {', '.join(map(str, sorted(lengths)))} rows do not make one table")
    return [
        _Cell("_".join((name, *map(str, index))), name, index, values.shape[1:], values[(slice(None), *index)])
        for name, values in columns.items()
        for index in np.ndindex(*values.shape[1:])
    ]


def _read_parquet(path: Path) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    arrow = _need("pyarrow", "Parquet")
    if not path.exists():
        raise UsageError(f"{path}: no such file")
    try:
        table = _need("pyarrow.parquet", "Parquet").read_table(path)
    except (OSError, arrow.ArrowException) as error:
        raise UsageError(f"{path}: expected Parquet: {error}") from error
    columns: dict[str, NDArray[Any]] = {}
    for field in table.schema:
        if field.metadata is None or b"of" not in field.metadata:
            raise UsageError(f"{path}: column {field.name} does not say of which array it is: not a file of ours")
        values = table.column(field.name).to_numpy()
        name, shape = field.metadata[b"of"].decode(), json.loads(field.metadata[b"shape"])
        column = columns.setdefault(name, np.empty((len(values), *shape), values.dtype))
        column[(slice(None), *json.loads(field.metadata[b"index"]))] = values
    return columns, json.loads((table.schema.metadata or {}).get(_ATTRS, b"{}"))


def _need(module: str, purpose: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"{purpose} needs {module}: {_EXTRA}") from error
