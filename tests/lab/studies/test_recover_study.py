"""Cells that lose something by chance come back; the runs of `study faults --recover`, a few of its seeds."""

from __future__ import annotations

from dataclasses import replace

import pytest

from canprobe.cli import main
from canprobe.lab.studies.recover import findings, run_case, table_rows
from canprobe.lab.studies.recover_runs import Outage, RecoverCase, draw_case, shrink


@pytest.mark.parametrize("seed", [1, 2])
def test_a_cell_comes_back_from_what_a_seed_takes(seed):
    outcome = run_case(draw_case(seed))
    if seed == 2:
        assert outcome == run_case(draw_case(seed)), "a seed is the same run again"
        assert table_rows([outcome])[-1]["runs"] == 1 and findings([outcome])
    assert outcome["failures"] == [], outcome
    assert outcome["jump_counts"] <= 1 and outcome["force_max_n"] <= outcome["force_limit_n"]
    assert outcome["rows_lost"] == 0 and outcome["back"] + outcome["refused"] == outcome["lost"]


def test_a_joint_that_stops_in_a_scan_does_not_press_the_others_into_the_object():
    outcome = run_case(draw_case(182))
    assert outcome["lost"] >= 1 and outcome["force_max_n"] <= outcome["force_limit_n"]


def test_a_failure_is_shrunk_to_the_loss_that_makes_it():
    case = RecoverCase(
        0, "hold", (Outage("reboot", 2, 0.5, 40), Outage("freeze", 3, 0.6, 40), Outage("bus-off", 5, 0.7, 40))
    )
    failing = case.outages[1]

    def fails(some):
        return {"failures": ["it fails"] if failing in some.outages else []}

    assert shrink(case, fails) == replace(case, outages=(failing,))


def test_one_seed_is_repeated_from_the_command_line(capsys):
    assert main(["study", "faults", "--recover", "--seed", "6", "-v"]) == 0
    said = capsys.readouterr().err
    assert "seed 6: hold: reboot of node 1" in said and "the cell is back after" in said
