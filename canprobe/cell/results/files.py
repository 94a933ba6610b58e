"""Columns of a run as a table (pandas, Parquet), and a surface map as a file, each with its units.

A column of a log may hold a vector or a matrix per row. A table has one number per cell: `q_rad` (n, 6) becomes
`q_rad_0` … `q_rad_5`, `K_per_m` (n, 2, 2) becomes `K_per_m_0_0` … `K_per_m_1_1`.

Tables need the extra `data` (pandas, pyarrow).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.npz import read_npz
from canprobe.cell.results.run_files import READERS
from canprobe.errors import UsageError, needed_module, regular_file
from canprobe.fieldbus.bus.files import whole_file

if TYPE_CHECKING:
    import pandas

_UNITS = {
    "per_m2": "1/m^2", "per_m": "1/m", "permille": "permille", "m_s": "m/s", "rad": "rad", "deg": "deg", "mm": "mm",
    "hz": "Hz", "ns": "ns", "us": "us", "n": "N", "m": "m", "s": "s",
}  # fmt: skip
_ATTRS = b"PANDAS_ATTRS"  # key under which pandas keeps a frame's attrs in Parquet


def unit_of(name: str) -> str:
    """The unit of a column of a log, of a truth file or of estimates; `1` for a column without unit."""
    return next((unit for suffix, unit in _UNITS.items() if name.endswith(f"_{suffix}")), "1")


def to_frame(columns: Mapping[str, NDArray[Any]], attrs: Mapping[str, Any] | None = None) -> pandas.DataFrame:
    """Columns as a table, by time.

    Args:
        columns: arrays (n,), (n, k) or (n, k, l), one row for each cycle; the suffix of a name is its unit.
        attrs: entries to add to the frame's `attrs`.

    Returns:
        The frame; its index is `t_s` where there is one. `attrs["units"]` maps every column to its unit.

    Raises:
        UsageError: pandas is missing, or columns differ in length.
    """
    values, units = _scalars(columns)
    frame = needed_module("pandas", "data", "a table needs pandas:").DataFrame(values)
    if "t_s" in values:
        frame = frame.set_index("t_s")
    frame.attrs = {**(attrs or {}), "units": units}
    return frame


def load_table(path: Path | str) -> pandas.DataFrame:
    """A table from a `.npz` of a run (`log.npz`, `truth.npz`) or from Parquet.

    Args:
        path: path of the file; the suffix `.npz` names the first kind.

    Returns:
        The frame, by `t_s` where there is one; vectors are spread over columns, and `attrs["units"]` has every unit.

    Raises:
        UsageError: when there is no such file, it is of another kind, or the extra is missing.
    """
    source = Path(path)
    if source.suffix == ".npz":
        return to_frame(READERS.get(source.name, read_npz)(source))
    reader = needed_module("pandas", "data", "a table needs pandas:")
    arrow = needed_module("pyarrow", "data", "Parquet needs pyarrow:")
    try:
        frame: pandas.DataFrame = reader.read_parquet(regular_file(source), engine="pyarrow")
    except (OSError, arrow.ArrowException) as error:
        raise UsageError(f"{source}: expected Parquet: {error}") from error
    return frame.set_index("t_s") if "t_s" in frame else frame


def write_parquet(
    columns: Mapping[str, NDArray[Any]], path: Path | str, attrs: Mapping[str, Any] | None = None
) -> None:
    """Write columns as Parquet; the metadata of each field and the `attrs` of pandas have its unit.

    Raises:
        UsageError: the extra is missing, or columns differ in length.
        ResultsError: the file cannot be written.
    """
    arrow = needed_module("pyarrow", "data", "Parquet needs pyarrow:")
    parquet = needed_module("pyarrow.parquet", "data", "Parquet needs pyarrow:")
    values, units = _scalars(columns)
    arrays = {name: arrow.array(column) for name, column in values.items()}
    fields = [arrow.field(name, array.type, metadata={"unit": units[name]}) for name, array in arrays.items()]
    schema = arrow.schema(fields, metadata={_ATTRS: json.dumps({**(attrs or {}), "units": units})})
    with whole_file(Path(path)) as part:
        parquet.write_table(arrow.Table.from_arrays(list(arrays.values()), schema=schema), part)


def _scalars(columns: Mapping[str, NDArray[Any]]) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Columns with one number per row, and their units."""
    if single := [name for name, values in columns.items() if not values.ndim]:
        raise UsageError(f"columns of a table have a value in each row, {', '.join(single)} has one in all")
    lengths = {len(values) for values in columns.values()}
    if len(lengths) > 1:
        raise UsageError(f"columns of {', '.join(map(str, sorted(lengths)))} rows do not make one table")
    found, units = {}, {}
    for of, values in columns.items():
        for index in np.ndindex(*values.shape[1:]):
            name = "_".join((of, *map(str, index)))
            found[name], units[name] = values[(slice(None), *index)], unit_of(of)
    return found, units
