"""Study `workprec`: the plant's integrators against the reference, and the words of the study."""

import sys

import numpy as np
import pytest

from canprobe.cell.scene.setup import Dynamics
from canprobe.cli import main
from canprobe.lab.studies import workprec
from canprobe.lab.studies.workprec import ENOUGH, IntegrationCase

CYCLES = 3
PAD = 1.27e8


@pytest.fixture(scope="module")
def truth():
    return workprec.observed(PAD, np.array(workprec.solve(IntegrationCase(PAD, "radau", 1e-10, False, CYCLES, 1))))


def errors_of(truth, method, step_us, held):
    found = workprec.integrated(
        PAD, workprec.trial(PAD, CYCLES)[1], Dynamics(integrator=method, step_ns=round(1000 * step_us)), held=held
    )
    return workprec.errors(truth, workprec.observed(PAD, found))


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
    return found | {"stands": stands, "verdict": workprec.verdict(found)}


def test_the_knee_is_the_cheapest_that_is_accurate_enough():
    rows = [row("a", 5.0, 1.01 * ENOUGH["force_percent"]), row("b", 7.0, 0.9), row("c", 6.0, None), row("d", 9.0, 1e-5)]
    assert [r["verdict"] for r in rows] == ["coarse", "enough", "broke down", "enough"]
    assert workprec.knee(rows, PAD)["method"] == "b"
    assert workprec.knee(rows[:1], PAD) is None


def test_the_choice_is_accurate_over_the_span_and_stands():
    def over_the_span(method, cost, step, **changes):
        return [row(method, cost, 0.5, step=step, stiffness=k, **changes) for k in workprec.SPAN]

    good = over_the_span("rosenbrock", 9.0, 625.0)
    rows = [*good, *over_the_span("rk4", 2.0, 625.0, stands=False), row("rosenbrock", 1.0, 0.5, step=1250.0)]
    rows.append(row("rosenbrock", 1.0, 3.0, step=1250.0, stiffness=1.27e9))
    assert workprec.choice(rows) == ("rosenbrock", 625.0)
    assert "is rosenbrock at 625 µs; the default is rosenbrock at 625 µs" in workprec.findings(rows, {})[0]
    assert workprec.choice(rows[3:]) is None
    said = "\n".join(workprec.findings(rows, {PAD: dict.fromkeys(ENOUGH, 1e-9)}))
    assert "cheapest that is accurate enough rosenbrock at 1250 µs, held, 1 µs a cycle" in said
    assert "the default, rosenbrock at 625 µs, held, 9 µs a cycle (force 0.5 %" in said


def test_quick_cells_cover_every_method_and_free_dynamics_too():
    quick = workprec.cases(True)
    assert {c.method for c in quick if c.held} == set(workprec.METHODS)
    assert any(not c.held for c in quick)
    assert len(quick) < len(workprec.cases(False)) / 4


def test_a_cell_measures_states_and_cost():
    answer = workprec.measure(IntegrationCase(PAD, "rosenbrock", 1250.0, True, CYCLES, 1))
    assert np.shape(answer["states"]) == (CYCLES, 12)
    assert answer["cost_us"] > 10.0


@pytest.mark.parametrize(("method", "step_us", "quiet"), [("rosenbrock", 625.0, True), ("rk4", 1250.0, False)])
def test_explicit_steps_rattle_at_rest_and_linearly_implicit_ones_do_not(method, step_us, quiet):
    for stiffness in (workprec.STIFFEST, PAD):
        assert workprec.stands(IntegrationCase(stiffness, method, step_us, True, 40, 1)) is quiet


def test_without_mujoco_it_is_refused_at_once(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name, package=None: None)
    assert main(["study", "workprec", "--quick", "--out", str(tmp_path)]) == 2
    assert "needs the package mujoco" in capsys.readouterr().err
