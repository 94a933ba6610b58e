"""Study `workprec` in its quick form, and what its words rest on."""

import numpy as np
import pytest

from canprobe.emulator.plant.dynamic_arm import Stepping
from canprobe.studies import workprec
from canprobe.studies.workprec import ENOUGH, Case, cases, errors, findings, knee, verdict
from canprobe.studies.workprec_trial import integrated, observed, reference

CYCLES = 3
PAD = 1.27e8


@pytest.fixture(scope="module")
def truth():
    return observed(PAD, CYCLES, reference(PAD, CYCLES, 1e-10))


def errors_of(truth, method, step_us, held):
    stepping = Stepping(method, round(1000 * step_us))
    return errors(truth, observed(PAD, CYCLES, integrated(PAD, CYCLES, stepping, held)))


def test_the_whole_plant_converges_with_the_order_of_its_step(truth):
    coarse, fine = (errors_of(truth, "rosenbrock", step, False)["position_um"] for step in (312.5, 78.125))
    assert np.log2(coarse / fine) / 2 == pytest.approx(2, abs=0.4)
    assert fine < 0.1


def test_holding_dynamics_over_a_cycle_is_an_error_of_its_own(truth):
    held, free = (errors_of(truth, "rk4", 78.125, held) for held in (True, False))
    assert free["force_percent"] < held["force_percent"] < 0.5
    assert free["position_um"] < 1e-3


def row(method, cost, force, held=True, step=1250.0):
    found = {"stiffness_n_m3": PAD, "held": held, "method": method, "step_us": step, "cost_us": cost}
    found |= {"force_percent": force, "position_um": None if force is None else 0.1 * force, "taxel_counts": 0.0}
    return found | {"verdict": verdict(found)}


def test_the_knee_is_the_cheapest_that_is_accurate_enough():
    rows = [row("a", 5.0, 1.01 * ENOUGH["force"]), row("b", 7.0, 0.9), row("c", 6.0, None), row("d", 9.0, 1e-5)]
    assert [r["verdict"] for r in rows] == ["coarse", "enough", "broke down", "enough"]
    assert knee(rows, PAD)["method"] == "b"
    assert knee(rows[:1], PAD) is None


def test_quick_cells_cover_every_method_held_and_not():
    quick = cases(True)
    assert {(c.method, c.held) for c in quick} == {(m, h) for m in workprec.METHODS for h in (True, False)}
    assert len(quick) < len(cases(False)) / 4


def test_a_cell_measures_states_and_cost():
    answer = workprec.measure(Case(PAD, "rosenbrock", 1250.0, True, CYCLES, 1))
    assert np.shape(answer["states"]) == (CYCLES, 12)
    assert answer["cost_us"] > 10.0


def test_findings_say_whether_the_default_is_the_knee():
    floor = {PAD: {"force_percent": 1e-9, "position_um": 1e-9, "taxel_counts": 1e-9}}
    mine = workprec.default_choice()
    rows = [row("rosenbrock", 7.0, 0.5, step=mine["step_us"]), row("rosenbrock", 20.0, 0.1, held=False,
            step=mine["step_us"])]  # fmt: skip
    said = "\n".join(findings(rows, floor))
    assert "the knee itself" in said
    assert "2.9 × the cost" in said
