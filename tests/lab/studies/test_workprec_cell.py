"""The whole cell's half of study `workprec`: refusals, scans, the knee and its words."""

import csv
import json
from types import SimpleNamespace

import pytest

from canprobe.cell.tasks.probing import Phase
from canprobe.lab.studies import workprec_cell
from canprobe.lab.studies.result import as_document, text_of, write_study
from canprobe.lab.studies.workprec_cell import (
    MEASURES,
    BusSetting,
    CellCase,
    default_of,
    findings,
    good,
    measure,
    over_seeds,
    run_cell,
)


class Here:
    """A sweep without processes; answers pass through JSON as in a real one."""

    def map(self, function, cells, *, model=()):
        return [json.loads(json.dumps(function(cell))) for cell in cells]

    time = map

    def say(self, words):
        pass


@pytest.fixture(scope="module")
def quick():
    return run_cell(quick=True, sweep=Here())


@pytest.mark.slow(reason="a whole study in its quick form")
def test_quick_has_scans_and_the_plans_refusals(quick):
    done = [r for r in quick.rows if r["ended"] == "done"]
    assert {r["fidelity"] for r in done} == {"ideal", "dynamic"}
    for row in done:
        assert row["cost_ms_per_s"] > 10.0
        assert 0.0 < row["force_percent"] < 30.0
    felt = [r for r in done if r["method"] == "recursive"]
    assert all(0.0 < r["curvature_percent"] < 30.0 and 0.0 < r["normal_deg"] < 5.0 for r in felt)
    refused = [r for r in quick.rows if r["ended"] == "refused"]
    assert [(r["rate_hz"], r["bus"]) for r in refused] == [(500.0, "classical"), (500.0, "FD")]
    assert all("can0" in r["reason"] for r in refused)
    assert len(done) + len(refused) + sum(r["ended"] == "stopped" for r in quick.rows) == len(quick.rows) == 6
    assert {(r["rate_hz"], r["bus"]) for r in done} == {(200.0, "classical"), (500.0, "8 Mbit/s")}
    assert {(r["rate_hz"], r["stiff"]) for r in done if r["rate_hz"] > 200.0} == {(500.0, "holds")}
    assert {r["stiff"] for r in done if r["rate_hz"] == 200.0} <= {"holds", "stopped"}  # by a hair, either way
    for bus in ("classical", "FD"):
        assert f"Refused by the plan, bus {bus}: 500 Hz window." in quick.findings


@pytest.mark.slow(reason="a whole study in its quick form")
def test_files_of_a_study_with_two_tables(quick, tmp_path):
    whole = SimpleNamespace(**{name: getattr(quick, name) for name in ("columns", "findings", "facts")})
    whole.name, whole.rows, whole.more, whole.draw = "first", [], (quick,), lambda path: path.write_bytes(b"")
    paths = write_study(whole, tmp_path)
    assert {p.stem for p in paths} == {"first", "workprec_cell"}
    with (tmp_path / "workprec_cell.csv").open(encoding="utf-8") as file:
        assert len(list(csv.DictReader(file))) == len(quick.rows)
    assert (tmp_path / "workprec_cell.png").stat().st_size > 10_000
    assert "study workprec_cell" in text_of(whole)
    assert as_document(whole)["more"][0]["study"] == "workprec_cell"


def test_a_scan_that_is_stopped_is_a_row_with_its_reason(monkeypatch):
    def stopped(*_, **__):
        raise workprec_cell.SafetyStop("measured force 9 N above the limit of 5 N")

    monkeypatch.setattr(workprec_cell, "run_scene", stopped)
    answer = measure(CellCase(BusSetting(100.0, "features", "classical"), "chord", "ideal", 1.0, 1))
    assert answer == {"ended": "stopped", "reason": "measured force 9 N above the limit of 5 N"}


def test_the_cost_is_that_of_the_scan_alone(monkeypatch):
    """Ten cycles of 10 ms, the scan from the third to the eighth: 5 s of work in 0.05 s."""

    def run(scene, *, observers, **_):
        for _ in range(10):
            observers[0](SimpleNamespace(measurement=object()))
        observers[0](SimpleNamespace(measurement=None))
        phase = [Phase.APPROACH] * 3 + [Phase.SCAN] * 6 + [Phase.RETREAT]
        log = {"phase": workprec_cell.np.array(phase), "t_s": 0.01 * workprec_cell.np.arange(10)}
        shape = {"kappa_rms_error_percent": 3.0, "normal_rms_deg": 0.1, "cramer_rao_ratio": 1.5}
        summary = {"shape": shape, "contact": {"force_rms_error_n": 0.1, "force_target_n": 2.0}}
        return SimpleNamespace(log=log, summary=summary)

    clock = iter(range(100))
    monkeypatch.setattr(workprec_cell, "run_scene", run)
    monkeypatch.setattr(workprec_cell, "process_time", lambda: float(next(clock)))
    answer = measure(CellCase(BusSetting(100.0, "features", "classical"), "recursive", "ideal", 1.0, 1))
    assert answer["cost_ms_per_s"] == pytest.approx(1e3 * 5.0 / 0.05)
    assert answer["force_percent"] == pytest.approx(5.0)
    assert answer["bound_percent"] == pytest.approx(2.0)


def test_a_row_has_the_spread_of_its_seeds_and_what_differs_beyond_it():
    scans = [{"ended": "done", "reason": "", "cost_ms_per_s": 100.0 + i, "bound_percent": 1.0, "normal_deg": 0.1,
              "curvature_percent": 2.0 + i, "force_percent": 4.0} for i in range(3)]  # fmt: skip
    one = over_seeds(scans)
    assert (one["cost_ms_per_s"], one["curvature_percent"], one["curvature_percent_range"]) == (100.0, 3.0, "2–4")
    alike = over_seeds([{**scan, "curvature_percent": 3.5 + i} for i, scan in enumerate(scans)])
    better = over_seeds([{**scan, "curvature_percent": 0.5 + 0.1 * i} for i, scan in enumerate(scans)])
    assert workprec_cell._differ(one, alike) == []
    assert workprec_cell._differ(one, better) == ["curvature"]
    stopped = over_seeds([*scans, {"ended": "stopped", "reason": "too much"}])
    assert stopped["force_percent"] is None
    assert stopped["reason"] == "1 of 4 seeds stopped: too much"


def row(method, cost, errors, *, rate=400.0, mode="window", fidelity="ideal"):
    named = {
        "rate_hz": rate,
        "mode": mode,
        "bus": "classical",
        "method": method,
        "fidelity": fidelity,
        "stiff": "holds",
    }
    return named | {"cost_ms_per_s": cost, "ended": "done", "reason": "", **dict(zip(MEASURES, errors, strict=True))}


def test_the_knee_is_the_cheapest_whose_errors_are_all_small_enough():
    best, knee = row("ml", 900.0, (1.0, 0.1, 2.0)), row("recursive", 300.0, (1.9, 0.19, 5.9))
    rows = [best, knee, row("chord", 100.0, (1.2, 0.1, 6.1)), row("chord", 50.0, (None, None, 2.0))]
    rows.append(row("chord", 10.0, (0.1, 0.01, 0.2), fidelity="dynamic"))
    rows.append(row("chord", 20.0, (1.0, 0.1, 2.0), rate=200.0) | {"stiff": "stopped"})
    rows.append(row("chord", 20.0, (1.0, 0.1, 2.0), rate=1000.0) | {"bus": "8 Mbit/s"})
    assert good(rows, "ideal") == [knee, best]
    assert default_of(rows, "ideal") is knee
    said = "\n".join(findings(rows))
    assert "40 kN/m, is 400 Hz, window, classical, recursive: 300 ms a second for 1.9 %" in said
    assert "400 Hz 300 ms a second, force 5.9 %, curvature 1.9 %, 40 kN/m: holds" in said
    assert "It is the default." in said
    other = "\n".join(findings([*rows, row("chen1996", 20.0, (1.0, 0.1, 2.0), rate=200.0)]))
    assert "is 200 Hz, window, classical, chen1996" in other
    assert "It is not the default, 400 Hz" in other
    assert "5.9 % of force: 15.0 × that cost." in other


def test_what_was_stopped_and_refused_is_told():
    stopped = row("chord", None, (None, None, None), fidelity="dynamic") | {"ended": "stopped", "reason": "too much"}
    refused = row("any", None, (None, None, None), rate=2000.0, fidelity="any") | {"ended": "refused"}
    said = findings([stopped, refused])
    assert "Stopped for safety, plant dynamic, 1 scans: window chord." in said
    assert "Refused by the plan, bus classical: 2000 Hz window." in said
    assert any("no combination is within" in line for line in said)
