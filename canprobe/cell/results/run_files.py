"""Readers of the files of a run's folder, which check names, shapes and sizes of their columns.

Replay, the view, tables and measured traffic read a run with them. A folder may be cut off,
edited, or of another version of canprobe; the message then names file and column, and the version that wrote it.

    summary.json   one object with `schema`; `written_by` names the version of canprobe
    scene.toml     read by `canprobe.cell.scene.load`
    log.npz        a row for each cycle: floats, `t_s` rises; columns of users' controllers may have any further shape
    tactile.npz    a row for each tactile frame
    truth.npz      a row for each SYNC

A process that was killed leaves ``rows/`` in the place of the last three, and the readers then read that.

A column of a log may hold a vector or a matrix per row. A table (pandas, Parquet; the extra `data`) has one number per
cell: `q_rad` (n, 6) becomes `q_rad_0` … `q_rad_5`, `K_per_m` (n, 2, 2) becomes `K_per_m_0_0` … `K_per_m_1_1`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.npz import NpzColumns, read_npz
from canprobe.cell.rows import ROWS_FOLDER, read_left_rows
from canprobe.cell.scene.load import SAVED_AS, load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.setup import Setup
from canprobe.cell.scene.toml_files import written_by_other
from canprobe.cell.tasks.task import Phase
from canprobe.errors import SceneError, UsageError, check_schema, needed_module, regular_file
from canprobe.fieldbus.bus.files import read_document, whole_file

if TYPE_CHECKING:
    import pandas


SCHEMA = 2
"""Version of ``summary.json``."""
SUMMARY, LOG, TACTILE, TRUTH = "summary.json", "log.npz", "tactile.npz", "truth.npz"
_MOST_SUMMARY_BYTES = 16 << 20
_LATEST_S = 1e9
_WHOLE_NUMBERS = {"q_age": 1 << 31, "statusword": 0xFFFF, "tactile_age": 1 << 31, "phase": max(Phase)}
"""Columns of ``log.npz`` and their largest value."""

Columns = dict[str, NDArray[Any]] | NpzColumns
_Shapes = Mapping[str, tuple[int | str, ...]]
"""By column: the shape of a row; sizes of the cell stand there by name."""

_OF_LOG: _Shapes = {
    **dict.fromkeys(("t_s", "tactile_age", "phase", "force_n", "force_sigma_n", "target_force_n"), ()),
    **dict.fromkeys(("carrier_rad", "carrier_m"), ()),
    **dict.fromkeys(("q_rad", "q_m", "q_age", "statusword", "torque_permille"), ("joints",)),
    **dict.fromkeys(("contact_mm", "normal"), (3,)),
    "force_sigma_parts_n": (4,),
    "kappa_per_m": (2,),
    "T_base_contact_m": (4, 4),
    "K_per_m": (2, 2),
    "K_covariance_per_m2": (3, 3),
}
_OF_TACTILE: _Shapes = {
    **dict.fromkeys(("t_s", "t_sample_s", "t_sigma_s"), ()),
    "taxels": ("rows", "columns"),
    "window": (4,),
    "features": (7,),
}
_OF_TRUTH: _Shapes = {
    **dict.fromkeys(("t_s", "force_n"), ()),
    **dict.fromkeys(("q_rad", "q_m"), ("joints",)),
    **dict.fromkeys(("direction1", "direction2", "contact_normal", "contact_point_m"), (3,)),
    "kappa_per_m": (2,),
}
_OF_INTEGERS = {"taxels": "u", "window": "i"}
"""Kinds of numbers, as numpy's `dtype.kind` names them, of known columns that are no floats."""


def read_summary(folder: Path) -> dict[str, Any] | None:
    """The summary of a run; None where a run left none, as when it was killed.

    Raises:
        UsageError: when it is another kind of file, or of a newer canprobe.
    """
    file = folder / SUMMARY
    if not file.exists():
        return None
    summary = read_document(file, _MOST_SUMMARY_BYTES, json.loads, "the summary of a run")
    if not isinstance(summary, dict):
        raise UsageError(f"{file}: expected the summary of a run, got {type(summary).__name__}")
    where = f"{file}{written_by_other(summary.get('written_by'))}"
    check_schema(where, summary.get("schema"), SCHEMA, "run the scene again with this canprobe")
    return summary


def check_run_folder(folder: Path, *names: str) -> None:
    """Raise UsageError where a folder, or a file of these names in it, is not there."""
    expected = "expected one that `canprobe run --out DIR` wrote"
    if not folder.is_dir():
        raise UsageError(f"{folder}: no such folder; {expected}")
    for name in names:
        if not is_recorded(folder / name):
            raise UsageError(f"{folder}: no {name} in this folder; {expected}")


def read_scene(folder: Path) -> Scene:
    """The scene of a run.

    Raises:
        UsageError: when the folder has none, or is not there.
        SceneError: when it cannot be loaded; the message names the version that wrote it, where that is another one.
    """
    check_run_folder(folder, SAVED_AS)
    file = folder / SAVED_AS
    try:
        return load_scene(file)
    except SceneError as error:
        if (named := _named(file)) == str(file) or any(line.startswith(named) for line in error.problems):
            raise
        raise SceneError([f"{named}{problem.removeprefix(str(file))}" for problem in error.problems]) from error


def read_log(file: Path, setup: Setup | None = None) -> Columns:
    """The columns of ``log.npz``.

    Args:
        file: its path.
        setup: setup of the run, with which shapes are checked; without one, columns may have any shape, as those of
            users' controllers do.

    Raises:
        UsageError: when it cannot be read, or a column is not as a run writes it.
    """
    columns = _checked(_columns(file, "the log of a run"), file, _OF_LOG, setup)
    times = _times(columns, "t_s", file)
    if len(times) and times[0] == 0.0:
        raise UsageError(
            f"{file}: expected t_s on the clock of bus.log, got times since the first SYNC, as an earlier canprobe"
            " wrote them; run the scene again"
        )
    if (np.diff(times) <= 0.0).any():
        raise UsageError(f"{_named(file)}: t_s: expected times that rise from cycle to cycle, got others")
    for name, most in _WHOLE_NUMBERS.items() if setup is not None else ():
        known = columns[name][np.isfinite(columns[name])] if name in columns else np.empty(0)
        if ((known < 0.0) | (known > most)).any():
            raise UsageError(f"{_named(file)}: {name}: expected numbers from 0 to {most}, got others")
    return columns


def read_tactile(file: Path, setup: Setup | None = None) -> Columns:
    """The columns of ``tactile.npz``; for arguments and errors see `read_log`."""
    columns = _checked(_columns(file, "the tactile frames of a run"), file, _OF_TACTILE, setup)
    if not columns:
        return columns
    for name in ("t_s", "t_sample_s"):
        _times(columns, name, file)
    if setup is not None:
        needed(columns, _OF_TACTILE, file)
        first, size = columns["window"][:, :2], columns["window"][:, 2:]
        if ((first < 0) | (size < 0) | (first + size > columns["taxels"].shape[1:])).any():
            raise UsageError(f"{_named(file)}: window: expected windows within the array, got others")
    return columns


def read_truth(file: Path, setup: Setup | None = None) -> Columns:
    """The columns of ``truth.npz``; see `read_log`."""
    return _checked(_columns(file, "the true values of a run"), file, _OF_TRUTH, setup)


def needed(columns: Columns, names: Iterable[str], file: Path) -> None:
    """Raise UsageError for columns that a file lacks."""
    if missing := [name for name in names if name not in columns]:
        raise UsageError(
            f"{_named(file)}: expected the columns of a run, got none called {', '.join(missing)}; run it again"
        )


READERS = {LOG: read_log, TACTILE: read_tactile, TRUTH: read_truth}
"""Reader of each file of columns, by its name."""


def is_recorded(file: Path) -> bool:
    """Whether a run has written a file of columns, or was killed and has left its rows."""
    return file.exists() or any((file.parent / ROWS_FOLDER).glob(f"{file.stem}*.npy*"))


def _columns(file: Path, what: str) -> Columns:
    """The columns of a file; without it, those of the rows that a killed run has left."""
    if file.exists() or not is_recorded(file):
        return read_npz(file, what)
    try:
        return read_left_rows(file.parent, file.stem)
    except (OSError, ValueError) as error:
        raise UsageError(f"{file.parent / ROWS_FOLDER}: expected {what}; cannot be read: {error}") from error


def _checked(columns: Columns, file: Path, shapes: _Shapes, setup: Setup | None) -> Columns:
    """The columns, after a check of their kinds and lengths; with a setup, of the shapes of known ones too."""
    sizes = _sizes(setup)
    heads = columns.heads if isinstance(columns, NpzColumns) else columns
    rows = next((len(column) for column in heads.values() if column.ndim), 0)
    for name, column in heads.items():
        known = setup is not None and rows and name in shapes
        kinds, row = (_OF_INTEGERS.get(name, "f"), shapes[name]) if known else ("biuf", column.shape[1:])
        wanted = (rows, *(sizes.get(size) if isinstance(size, str) else size for size in row))
        fits = len(column.shape) == len(wanted) and all(
            size in (None, got) for size, got in zip(wanted, column.shape, strict=True)
        )
        if not fits or column.dtype.kind not in kinds:
            shape = ", ".join("any" if size is None else str(size) for size in wanted) + "," * (len(wanted) == 1)
            raise UsageError(
                f"{_named(file)}: {name}: expected {_KINDS[kinds]} of shape ({shape}), got {column.dtype} of shape"
                f" {column.shape}"
            )
    return columns


_KINDS = {"f": "floats", "u": "counts (uint8)", "i": "integers", "biuf": "numbers"}


def _sizes(setup: Setup | None) -> dict[str, int]:
    """The sizes of a cell's rows, by the names in `_Shapes`; without those of parts that it lacks."""
    if setup is None:
        return {}
    arm, array = setup.arm, setup.array
    return ({} if arm is None else {"joints": arm.model.n}) | (
        {} if array is None else {"rows": array.pad.rows, "columns": array.pad.columns}
    )


def _times(columns: Columns, name: str, file: Path) -> NDArray[Any]:
    """A column of times, s, checked."""
    needed(columns, (name,), file)
    times = columns[name]
    if times.ndim != 1 or times.dtype.kind != "f" or not (np.abs(times) < _LATEST_S).all():
        raise UsageError(f"{_named(file)}: {name}: expected a time in seconds in each row, got others")
    return times


def _named(file: Path) -> str:
    """Name of a file in messages: its path, and the version that wrote it, where that is another one."""
    try:
        summary = read_summary(file.parent)
    except UsageError:
        summary = None
    return str(file) if summary is None else f"{file}{written_by_other(summary.get('written_by'))}"


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
