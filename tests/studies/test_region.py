"""Study `region`: how its limits are chosen, and that its seeds and cases are its own."""

from __future__ import annotations

import json

import numpy as np
import pytest

from canprobe.cli import main
from canprobe.studies import region
from canprobe.studies.bound import AT, REGION, SEEDS, all_cases, reasons_outside


def case_row(method="ml", ratio=1.0, bias=0.0, coverage=0.95, observed=1.0, **at):
    values = {"path": 0.5, "bound": 0.01, "κσ": 5e-4, "cubic": 0.1, "spread": 0.02} | at
    scores = {"method": method, "ratio": ratio, "bias": bias, "coverage": coverage, "observed": observed}
    return scores | {AT + name: value for name, value in values.items()}


def test_a_limit_is_the_end_of_the_last_level_that_holds():
    rows = [case_row(**{"κσ": k}) for k in (5e-5, 5e-4, 4e-3)]
    rows += [case_row(**{"κσ": 9e-3}, coverage=0.5), case_row(**{"κσ": 2e-2})]
    levels = list(region.levels_of("κσ", rows))
    assert [row["holds"] for row in levels] == [True, True, True, False, True]
    assert region.chosen(levels)["κσ"] == 5e-3
    rows[2]["ratio"] = 2.0  # a level further in fails: the limit comes in
    assert region.chosen(list(region.levels_of("κσ", rows)))["κσ"] == 1e-3


@pytest.mark.parametrize("wrong", [{"ratio": 1.3}, {"bias": 0.4}, {"coverage": 0.85}, {"observed": 0.9}])
def test_a_level_does_not_hold_with_anything_wrong(wrong):
    assert region.pooled([case_row(), case_row()])["holds"]
    assert not region.pooled([case_row() | wrong, case_row() | wrong])["holds"]
    nothing = case_row(observed=0.0) | dict.fromkeys(("ratio", "bias", "coverage"))
    assert not region.pooled([nothing])["holds"]


def test_cases_outside_by_another_limit_say_nothing_about_one():
    rows = [case_row(), case_row(coverage=0.1, cubic=5.0)]
    assert all(row["cases"] == 1 and row["holds"] for row in region.levels_of("path", rows))


def test_no_limit_goes_beyond_what_is_meant():
    rows = [case_row(path=p) for p in (0.04, 0.5, 1.0, 1.5, 2.0)]
    assert region.chosen(list(region.levels_of("path", rows)))["path"] == region.MEANT["path"]


def test_a_case_is_outside_for_what_it_exceeds():
    inside = {name: 0.999 * limit for name, limit in REGION.items()}
    assert reasons_outside(inside) == []
    assert reasons_outside(inside | {"cubic": 1.1 * REGION["cubic"], "path": float("nan")}) == ["path", "cubic"]


def test_seeds_are_not_those_of_the_table():
    assert region.FIRST_SEED >= SEEDS
    assert set(all_cases()) < set(region.pilot_cases())


def test_the_quick_pilot_runs_from_the_command_line(tmp_path, capsys):
    assert main(["study", "region", "--quick", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {row["limit"] for row in document["rows"]} == set(REGION)
    assert len(document["findings"]) == len(REGION)
    assert (tmp_path / "region.png").stat().st_size > 10_000


def test_a_path_that_is_hardly_wider_than_the_noise_is_outside():
    """5 mm of weave under 0.1 mm of noise: its sides are 0.37 mm from the middle, RMS."""
    from canprobe.studies.bound import NOISES, Case, criteria

    case = Case("cylinder", "weave", 0.04, 0.005, *NOISES[2])
    narrow = criteria(case, case.ground, np.zeros((3, 3)), 0.0)
    assert narrow["spread"] == pytest.approx(0.268, abs=0.002)
    assert reasons_outside(narrow) == ["spread"]
