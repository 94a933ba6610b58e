"""Study `workprec`: the plant's integrators, the whole cell's refusals and scans, and the words of both."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cell.plant.dynamic_arm import Stepping
from canprobe.cell.tasks.probing import Phase
from canprobe.cli import main
from canprobe.lab.studies import workprec, workprec_cell
from canprobe.lab.studies.result import as_document, text_of, write_study
from canprobe.lab.studies.workprec import (
    ENOUGH,
    IntegrationCase,
    cases,
    choice,
    errors,
    findings,
    integrated,
    knee,
    observed,
    solve,
    stands,
    trial,
    verdict,
)
from canprobe.lab.studies.workprec_cell import (
    MEASURES,
    BusSetting,
    CellCase,
    default_of,
    good,
    measure,
    over_seeds,
    run_cell,
)

CYCLES = 3
PAD = 1.27e8


@pytest.fixture(scope="module")
def truth():
    return observed(PAD, np.array(solve(IntegrationCase(PAD, "radau", 1e-10, False, CYCLES, 1))))


def errors_of(truth, method, step_us, held):
    found = integrated(PAD, trial(PAD, CYCLES)[1], Stepping(method, round(1000 * step_us)), held=held)
    return errors(truth, observed(PAD, found))


def test_the_whole_plant_converges_with_the_order_of_its_step(truth):
    coarse, fine = (errors_of(truth, "rosenbrock", step, False)["position_um"] for step in (312.5, 78.125))
    assert np.log2(coarse / fine) / 2 == pytest.approx(2, abs=0.4)
    assert fine < 0.1


def test_holding_dynamics_over_a_cycle_is_an_error_of_its_own(truth):
    held, free = (errors_of(truth, "rk4", 78.125, held) for held in (True, False))
    assert free["force_percent"] < held["force_percent"] < 0.5
    assert free["position_um"] < 1e-3


def row(method, cost, force, *, held=True, step=625.0, stiffness=PAD, stands=True):
    found = {"stiffness_n_m3": stiffness, "held": held, "method": method, "step_us": step, "cost_us": cost}
    found |= {"force_percent": force, "position_um": None if force is None else 0.1 * force, "taxel_counts": 0.0}
    return found | {"stands": stands, "verdict": verdict(found)}


def test_the_knee_is_the_cheapest_that_is_accurate_enough():
    rows = [row("a", 5.0, 1.01 * ENOUGH["force_percent"]), row("b", 7.0, 0.9), row("c", 6.0, None), row("d", 9.0, 1e-5)]
    assert [r["verdict"] for r in rows] == ["coarse", "enough", "broke down", "enough"]
    assert knee(rows, PAD)["method"] == "b"
    assert knee(rows[:1], PAD) is None


def test_the_choice_is_accurate_over_the_span_and_stands():
    def over_the_span(method, cost, step, **changes):
        return [row(method, cost, 0.5, step=step, stiffness=k, **changes) for k in workprec.SPAN]

    good = over_the_span("rosenbrock", 9.0, 625.0)
    rows = [*good, *over_the_span("rk4", 2.0, 625.0, stands=False), row("rosenbrock", 1.0, 0.5, step=1250.0)]
    rows.append(row("rosenbrock", 1.0, 3.0, step=1250.0, stiffness=1.27e9))
    assert choice(rows) == ("rosenbrock", 625.0)
    assert "is rosenbrock at 625 µs; the default is rosenbrock at 625 µs" in findings(rows, {})[0]
    assert choice(rows[3:]) is None
    said = "\n".join(findings(rows, {PAD: dict.fromkeys(ENOUGH, 1e-9)}))
    assert "cheapest that is accurate enough rosenbrock at 1250 µs, held, 1 µs a cycle" in said
    assert "the default, rosenbrock at 625 µs, held, 9 µs a cycle (force 0.5 %" in said


def test_quick_cells_cover_every_method_and_free_dynamics_too():
    quick = cases(True)
    assert {c.method for c in quick if c.held} == set(workprec.METHODS)
    assert any(not c.held for c in quick)
    assert len(quick) < len(cases(False)) / 4


def test_a_cell_measures_states_and_cost():
    answer = workprec.measure(IntegrationCase(PAD, "rosenbrock", 1250.0, True, CYCLES, 1))
    assert np.shape(answer["states"]) == (CYCLES, 12)
    assert answer["cost_us"] > 10.0


@pytest.mark.parametrize(("method", "step_us", "quiet"), [("rosenbrock", 625.0, True), ("rk4", 1250.0, False)])
def test_explicit_steps_rattle_at_rest_and_linearly_implicit_ones_do_not(method, step_us, quiet):
    for stiffness in (workprec.STIFFEST, PAD):
        assert stands(IntegrationCase(stiffness, method, step_us, True, 40, 1)) is quiet


def test_without_mujoco_it_is_refused_at_once(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    assert main(["study", "workprec", "--quick", "--out", str(tmp_path)]) == 2
    assert "needs the package mujoco" in capsys.readouterr().err


class Here:
    """A sweep without processes; answers pass through JSON as in a real one."""

    def map(self, function, cells, *, model=()):
        return [json.loads(json.dumps(function(cell))) for cell in cells]

    time = map

    def say(self, words):
        pass


@pytest.mark.slow(reason="a whole study in its quick form")
def test_the_quick_cell_has_scans_and_the_plans_refusals(tmp_path):
    quick = run_cell(quick=True, sweep=Here())
    done = [r for r in quick.rows if r["ended"] == "done"]
    assert {r["fidelity"] for r in done} == {"ideal", "dynamic"}
    for found in done:
        assert found["cost_ms_per_s"] > 10.0
        assert 0.0 < found["force_percent"] < 30.0
        assert 0.0 < found["curvature_percent"] < 30.0
    refused = [r for r in quick.rows if r["ended"] == "refused"]
    assert [(r["rate_hz"], r["bus"]) for r in refused] == [(500.0, "classical"), (500.0, "FD")]
    assert all("can0" in r["reason"] for r in refused)
    assert len(done) + len(refused) + sum(r["ended"] == "stopped" for r in quick.rows) == len(quick.rows) == 6
    assert {(r["rate_hz"], r["bus"]) for r in done} == {(200.0, "classical"), (500.0, "8 Mbit/s")}
    assert {(r["rate_hz"], r["stiff"]) for r in done if r["rate_hz"] > 200.0} == {(500.0, "holds")}
    names = [path.name for path in write_study(quick, tmp_path)]
    assert names == [f"workprec_cell.{end}" for end in ("csv", "txt", "json", "png")]
    assert (tmp_path / "workprec_cell.png").stat().st_size > 10_000
    assert "study workprec_cell" in text_of(quick) and len(as_document(quick)["rows"]) == 6


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
        log = {"phase": np.array(phase), "t_s": 0.01 * np.arange(10)}
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


def test_a_row_has_the_spread_of_its_seeds():
    scans = [{"ended": "done", "reason": "", "cost_ms_per_s": 100.0 + i, "bound_percent": 1.0, "normal_deg": 0.1,
              "curvature_percent": 2.0 + i, "force_percent": 4.0} for i in range(3)]  # fmt: skip
    one = over_seeds(scans)
    assert (one["cost_ms_per_s"], one["curvature_percent"]) == (100.0, 3.0)
    assert (one["curvature_percent_low"], one["curvature_percent_high"]) == (2.0, 4.0)
    stopped = over_seeds([*scans, {"ended": "stopped", "reason": "too much"}])
    assert stopped["force_percent"] is None
    assert stopped["reason"] == "1 of 4 seeds stopped: too much"


def cell_row(method, cost, errors, *, rate=400.0, bus="classical", fidelity="ideal", stiff="holds"):
    named = {"rate_hz": rate, "mode": "window", "bus": bus, "method": method, "fidelity": fidelity, "stiff": stiff}
    return named | {"cost_ms_per_s": cost, "ended": "done", "reason": "", **dict(zip(MEASURES, errors, strict=True))}


def test_the_knee_of_the_cell_is_the_cheapest_whose_errors_are_all_small_enough():
    best, knee = cell_row("ml", 900.0, (1.0, 0.1, 2.0)), cell_row("recursive", 300.0, (1.9, 0.19, 5.9))
    rows = [best, knee, cell_row("chord", 100.0, (1.2, 0.1, 6.1)), cell_row("chord", 50.0, (None, None, 2.0))]
    rows.append(cell_row("chord", 10.0, (0.1, 0.01, 0.2), fidelity="dynamic"))
    rows.append(cell_row("chord", 20.0, (1.0, 0.1, 2.0), rate=200.0, stiff="stopped"))
    rows.append(cell_row("chord", 20.0, (1.0, 0.1, 2.0), rate=1000.0, bus="8 Mbit/s"))
    assert good(rows, "ideal") == [knee, best]
    assert default_of(rows, "ideal") is knee
    said = "\n".join(workprec_cell.findings(rows))
    assert "40 kN/m: 400 Hz, window, classical, recursive: 300 ms a second for 1.9 %" in said
    assert "400 Hz 300 ms a second, force 5.9 %, curvature 1.9 %, 40 kN/m: holds" in said
    assert "It is the default." in said
    stopped = cell_row("chord", None, (None, None, None)) | {"ended": "stopped", "reason": "too much"}
    assert "1 scans were stopped for safety, 0 settings refused" in workprec_cell.findings([stopped])[-1]
