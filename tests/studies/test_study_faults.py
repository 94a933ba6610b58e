"""Study `faults`: runs follow from their seeds, the score sees what it must, and a few runs are without failure."""

from __future__ import annotations

import json

import pytest

from canprobe.cell.supervisor import Supervisor
from canprobe.cell.tasks import touch
from canprobe.cli import main
from canprobe.emulator.faults import Fault, FaultKind
from canprobe.studies import fault_runs
from canprobe.studies.fault_runs import PHASES, FaultCase, carry_out, draw_case, phase_windows, run_seed

FEATURES = "press, features"
S = 1_000_000_000


def test_a_seed_is_the_same_run_again():
    assert run_seed(5) == run_seed(5)
    assert draw_case(5).faults != draw_case(6).faults


def test_every_kind_every_phase_and_every_node_is_drawn():
    cases = [draw_case(seed) for seed in range(400)]
    faults = [fault for case in cases for fault in case.faults]
    assert {fault.kind for fault in faults} == set(FaultKind)
    assert {fault.node_id for fault in faults} == {1, 2, 3, 4, 5, 6, 16}
    assert {case.phase for case in cases} == set(PHASES)
    assert max(len(case.faults) for case in cases) == 3
    for case in cases:
        first, last = phase_windows(case.scenario)["bring-up"][0], phase_windows(case.scenario)["stop"][1]
        assert all(first <= fault.start_ns <= last for fault in case.faults)


def test_the_quick_study_runs_from_the_command_line(tmp_path, capsys):
    assert main(["study", "faults", "--quick", "--workers", "1", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    everything = document["rows"][-1]
    assert (everything["fault"], everything["runs"], everything["failures"]) == ("all", 8, 0)
    assert document["findings"][0].startswith("8 runs")
    assert (tmp_path / "faults.png").is_file()


def test_one_run_is_told_by_its_seed(capsys):
    assert main(["study", "faults", "--seed", "3", "--json"]) == 0
    told = capsys.readouterr()
    outcome = json.loads(told.out)
    assert outcome["seed"] == 3 and all(fault in told.err for fault in outcome["faults"])
    assert main(["study", "bound", "--seed", "3"]) == 2


def deaf_to_findings(monkeypatch):
    monkeypatch.setattr(Supervisor, "finding", lambda self, **_: None)
    monkeypatch.setattr(touch, "touch_finding", lambda _: None)


def test_the_score_sees_a_force_above_the_limit(monkeypatch):
    """A sensor that falls mute while the probe comes near, and nobody who cares: the probe is driven on."""
    mute = Fault(FaultKind.MUTE, 16, int(0.8 * S), 2 * S)
    supervised = carry_out(FaultCase(0, FEATURES, "approach", (mute,)))
    assert supervised["failures"] == [] and supervised["outcome"] in ("stopped for safety", "bus or node failure")
    deaf_to_findings(monkeypatch)
    run = carry_out(FaultCase(0, FEATURES, "approach", (mute,)))
    assert any("force above the limit" in failure for failure in run["failures"])


def test_the_score_sees_motion_and_power_after_the_stop(monkeypatch):
    monkeypatch.setattr("canprobe.cell.cell.Cell._stop_drives", lambda self: None)
    monkeypatch.setattr("canprobe.cell.bringup.BringUp.release", lambda self: None)
    monkeypatch.setattr("canprobe.emulator.drive_supervision.Supervision._await_sync", lambda self, t_ns: None)
    monkeypatch.setattr("canprobe.emulator.node.SlaveNode._communication_error", lambda self, t_ns: None)
    run = carry_out(FaultCase(0, FEATURES, "", ()))
    assert any("OPERATION_ENABLED after the stop" in failure for failure in run["failures"])


def test_the_score_sees_a_hang_a_crash_and_a_torn_log(monkeypatch):
    monkeypatch.setattr(fault_runs, "LONGEST_S", 0.5)
    assert any(f.startswith("hang") for f in carry_out(FaultCase(0, FEATURES, "", ()))["failures"])
    monkeypatch.undo()

    def crash(self, measurement):
        raise ZeroDivisionError("nobody thought of it")

    monkeypatch.setattr(touch.TouchTask, "step", crash)
    monkeypatch.setattr("canprobe.session.TrafficMeter.frames", property(lambda self: 1))
    failures = carry_out(FaultCase(0, FEATURES, "", ()))["failures"]
    assert any("ZeroDivisionError" in failure for failure in failures)
    assert any(failure.startswith("log:") for failure in failures)


@pytest.mark.parametrize("kind", FaultKind)
def test_a_node_that_has_every_fault_in_contact_is_answered(kind):
    start = phase_windows(FEATURES)["scan"][0] + S // 5
    faults = tuple(Fault(kind, node, start, S // 4, incoming=kind is FaultKind.DEAF, seed=7) for node in (3, 16))
    run = carry_out(FaultCase(1, FEATURES, "scan", faults))
    assert run["failures"] == [] and run["hits"] > 0
