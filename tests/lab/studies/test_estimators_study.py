"""Study `estimators`, and `canprobe study` round it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from canprobe.cli import main
from canprobe.lab.studies import estimators
from canprobe.lab.studies.estimators import (
    GROUNDS,
    NOISES,
    EstimatorSetting,
    findings,
    measure_costs,
    measure_errors,
    on_the_move,
    settings,
)
from canprobe.lab.studies.ground import SURFACES
from canprobe.lab.studies.result import StudyResult, as_document, table_lines, write_study
from canprobe.lab.studies.sweep import FORMS, STUDIES
from canprobe.mechanics.touch.estimate.fit import METHODS

FEW = [EstimatorSetting("chen1996", 160, 10), EstimatorSetting("ml", 160), EstimatorSetting("recursive", 160)]


@pytest.fixture
def few(monkeypatch):
    monkeypatch.setattr(estimators, "settings", lambda quick=False: list(FEW))


def test_errors_and_costs_of_every_setting(few):
    ground = on_the_move(*GROUNDS[0])
    errors = [measure_errors((GROUNDS[0], NOISES[1], False, seed)) for seed in range(3)]
    size = np.linalg.norm(ground.K)
    worst = {s.method: np.linalg.norm(found, axis=1).max() / size for s, *found in zip(FEW, *errors, strict=True)}
    assert worst["recursive"] < 0.03
    assert worst["ml"] < 0.05
    costs = np.array(measure_costs((NOISES[1], False, 2)))
    assert costs.shape == (len(FEW), 2, 2)
    assert (costs > 0).all()


@pytest.mark.slow(reason="a whole study in its quick form")
def test_the_quick_study_runs_from_the_command_line(tmp_path, capsys):
    assert main(["study", "estimators", "--quick", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["rows"]) == len(NOISES) * len(settings(quick=True))
    assert {r["method"] for r in document["rows"]} == set(METHODS)
    assert all(r["bound_percent"] > 0 and r["sample_us"] > 0 for r in document["rows"])
    assert {"commit", "machine", "model", "seeds"} <= set(document["facts"])
    (bound,) = document["more"]
    assert {r["surface"] for r in bound["rows"]} == set(SURFACES)
    ratios = [r["ratio"] for r in bound["rows"] if r["inside"] and r["method"] == "ml"]
    assert 0.6 < np.median(ratios) < 1.3
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {
        "cells.jsonl",
        *(f"{n}.{e}" for n in ("estimators", "bound") for e in ("csv", "txt", "json", "png")),
    }


def test_ratios_are_to_the_paper_in_the_same_run():
    shared = {"surface": GROUNDS[0][0], "error_percent": 1.0, "answer_us": 100.0}
    rows = [
        shared | {"method": s.method, "window_samples": s.window, "lag_samples": s.lag, "sample_us": cost,
                  "sigma_point_um": noise[0] * 1e6}
        for noise in NOISES
        for s, cost in zip(FEW, (50.0, 25.0, 5.0), strict=True)
    ]  # fmt: skip
    said = findings(rows)
    assert [r["ratio_to_chen1996"] for r in rows[:3]] == [1.0, 0.5, 0.1]
    assert any("1/20 of an answer of ml" in line for line in said)


def result(draw=lambda path: path.write_bytes(b"")):
    return StudyResult("demo", [{"name": "a", "x_mm": 1.25}, {"name": "b", "x_mm": float("nan")}], ["so"], {}, draw)


def test_what_does_not_apply_is_null_and_a_dash(tmp_path):
    assert as_document(result())["rows"][1]["x_mm"] is None
    assert table_lines(result()) == ["name  x mm", "a     1.25", "b        –"]
    names = [path.name for path in write_study(result(), tmp_path / "deep")]
    assert names[:3] == ["demo.csv", "demo.txt", "demo.json"]
    assert (tmp_path / "deep/demo.csv").read_text().splitlines() == ["name,x_mm", "a,1.25", "b,"]


def test_a_table_spells_units_and_shows_four_digits_or_all_before_the_point():
    row = {"stiffness_n_m3": 1.27e8, "force_max_n": 12345.67, "error_per_m": 0.123456, "cycles": 72000, "held": True}
    table = StudyResult("demo", [row], [], {}, lambda path: None)
    heads, cells = (line.split("  ") for line in table_lines(table))
    assert [head.strip() for head in heads if head] == [
        "stiffness N/m³", "force max N", "error 1/m", "cycles", "held",
    ]  # fmt: skip
    assert [cell.strip() for cell in cells if cell] == ["1.27e+08", "12346", "0.1235", "72000", "yes"]


def test_list(capsys):
    assert main(["study", "--list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in (*STUDIES, *FORMS))
    assert main(["study", "--list", "--json"]) == 0
    described = json.loads(capsys.readouterr().out)
    assert described == {**STUDIES, **{typed: words for typed, (_, words) in FORMS.items()}}


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["study", "region"], "did you mean regions?"),
        (["study"], "expected NAME"),
        (["study", "regions", "--soak"], "expected one of faults --vcan"),
        (["study", "faults", "--link"], "realtime --link"),
    ],
)
def test_a_wrong_name_is_told(argv, said, capsys):
    assert main(argv) == 2
    complaint = capsys.readouterr().err
    assert said in complaint
    assert complaint.count("\n") == 1


def test_run_prints_the_table_and_writes_files(monkeypatch, tmp_path, capsys):
    def run(*, quick, sweep):
        return result()

    monkeypatch.setattr(estimators, "run", run)
    assert main(["study", "estimators", "--out", str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rows"][0] == {"name": "a", "x_mm": 1.25}
    assert main(["study", "estimators", "--out", str(tmp_path)]) == 0
    assert "a     1.25" in capsys.readouterr().out
