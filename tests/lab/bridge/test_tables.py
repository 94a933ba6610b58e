"""Tables of a run: every number in its place, with its unit, also from Parquet."""

from __future__ import annotations

import runpy
from importlib import resources

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from canprobe.cell.results.run_files import load_table, to_frame, unit_of
from canprobe.errors import UsageError


@pytest.fixture
def run(recorded):
    return recorded.folder, recorded.result


def test_every_number_of_the_log_is_in_the_table_under_its_time(run):
    _, result = run
    table = result.to_pandas()
    assert len(table) == result.summary["cycle"]["cycles"] and table.index.name == "t_s"
    np.testing.assert_array_equal(table.index, result.log["t_s"])
    for axis in range(6):
        np.testing.assert_array_equal(table[f"q_rad_{axis}"], result.log["q_rad"][:, axis])
    np.testing.assert_array_equal(table["force_n"], result.log["force_n"])
    assert table.attrs["scene"] == "cylinder"
    assert result.to_pandas("truth").attrs["units"]["contact_point_m_2"] == "m"
    assert table.shape[1] == sum(int(np.prod(column.shape[1:])) for column in result.log.values()) - 1


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("t_s", "s"),
        ("K_covariance_per_m2", "1/m^2"),
        ("K_per_m", "1/m"),
        ("speed_m_s", "m/s"),
        ("T_base_contact_m", "m"),
        ("q_rad", "rad"),
        ("contact_mm", "mm"),
        ("force_n", "N"),
        ("torque_permille", "permille"),
        ("phase", "1"),
    ],
)
def test_units_are_read_off_the_names(name, unit):
    assert unit_of(name) == unit


@pytest.mark.parametrize("what", ["log", "truth", "estimates"])
def test_a_table_comes_back_from_parquet_and_from_the_folder_of_the_run(run, tmp_path, what):
    folder, result = run
    table = result.to_pandas(what)
    result.to_parquet(tmp_path / "table.parquet", what)
    again = load_table(tmp_path / "table.parquet")
    pd.testing.assert_frame_equal(again, table)
    assert again.attrs == table.attrs
    if what != "estimates":
        pd.testing.assert_frame_equal(load_table(folder / f"{what}.npz"), table)


def test_other_readers_of_parquet_find_the_units_too(run, tmp_path):
    """By pandas alone, which keeps them in attrs, and by pyarrow alone, field by field."""
    _, result = run
    result.to_parquet(tmp_path / "log.parquet")
    assert pd.read_parquet(tmp_path / "log.parquet").attrs["units"]["force_n"] == "N"
    schema = pq.read_schema(tmp_path / "log.parquet")
    assert schema.field("q_rad_5").metadata[b"unit"] == b"rad"
    assert {schema.field(name).type for name in ("t_s", "q_rad_5")} == {schema.field("force_n").type}


def test_what_is_no_table_is_refused_in_a_line(tmp_path):
    with pytest.raises(UsageError, match="columns of 2, 3 rows"):
        to_frame({"a": np.zeros(2), "b": np.zeros(3)})
    (tmp_path / "a.parquet").write_text("nothing")
    for name, said in (("a.parquet", "expected Parquet"), ("b.parquet", "No such file"), ("b.npz", "No such file")):
        with pytest.raises(UsageError, match=f"{name}.*{said}"):
            load_table(tmp_path / name)


@pytest.mark.slow(reason="a whole example")
def test_the_example_runs_as_it_stands(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    example = resources.files("canprobe") / "lab" / "examples" / "first_look.py"
    names = runpy.run_path(str(example))
    contact = names["result"].summary["contact"]
    off = names["scan"].force_n - 2.0
    assert np.sqrt(np.nanmean(off**2)) == pytest.approx(contact["force_measured_rms_error_n"], abs=1e-3)
    assert names["rms"] == pytest.approx(contact["force_rms_error_n"], abs=1e-3)
    assert names["estimates"]["kappa_per_m_0"].iloc[-1] == pytest.approx(1 / 0.036, rel=0.05)
    assert "'force_n': 'N', 'contact_mm_2': 'mm', 'q_rad_0': 'rad'" in capsys.readouterr().out
