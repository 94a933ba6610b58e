"""Study `faults`: runs follow from their seeds, the score sees what it must, and a few runs are without failure."""

import json
import os

import numpy as np
import pytest

from canprobe.cell.master.supervision import limits_of
from canprobe.cell.master.supervisor import Supervisor
from canprobe.cell.tasks import touch
from canprobe.cli import main
from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault
from canprobe.lab.studies import witnessed_run
from canprobe.lab.studies.fault_cases import DRAWN_KINDS, KINDS, PHASES, FaultCase
from canprobe.lab.studies.fault_runs import carry_out, draw_case, peak, phase_windows, run_seed
from canprobe.lab.studies.fault_scenes import FORCE_MAX_N, SCENARIOS, seeded_plan
from canprobe.lab.studies.fault_scores import Peak, score_force
from canprobe.lab.studies.faults import findings, table_rows
from canprobe.lab.studies.faults_vcan import HOLD_S, ProcessFault, draw_process_case, score_end
from canprobe.lab.studies.faults_vcan import findings as findings_on_vcan

FEATURES = "press, features"
S = 1_000_000_000


def test_a_seed_is_the_same_run_again():
    assert run_seed(5) == run_seed(5)
    assert draw_case(5).faults != draw_case(6).faults


def test_every_kind_every_phase_and_every_node_is_drawn():
    cases = [draw_case(seed) for seed in range(400)]
    faults = [fault for case in cases for fault in case.faults]
    assert {fault.kind for fault in faults} == set(KINDS)
    assert {fault.node_id for fault in faults} == {1, 2, 3, 4, 5, 6, 16}
    assert {case.phase for case in cases} == set(PHASES)
    assert max(len(case.faults) for case in cases) == 3
    assert {case.scenario for case in cases} == set(SCENARIOS)
    assert {case.timed for case in cases} == {case.files for case in cases} == {True, False}
    for case in cases:
        windows = phase_windows(case.scenario, case.timed)
        assert all(windows["bring-up"][0] <= fault.start_ns < windows["stop"][1] for fault in case.faults)
        assert case.timed or case.phase != "bring-up"


@pytest.mark.parametrize("timed", [False, True])
@pytest.mark.parametrize(
    ("scenario", "without"), [("listen", {"approach", "retreat"}), ("free", {"retreat"}), (FEATURES, set())]
)
def test_the_phases_of_a_scenario_follow_each_other(scenario, without, timed):
    windows = phase_windows(scenario, timed)
    assert list(windows) == [phase for phase in PHASES if phase not in without]
    edges = [edge for window in windows.values() for edge in window]
    assert edges == sorted(edges) and edges[1:-1:2] == edges[2::2]
    assert all(last > first for first, last in windows.values())


def test_the_peak_force_follows_from_what_the_probe_can_reach():
    reach = peak(FEATURES)
    assert reach is not None and peak("free") is None and peak("listen") is None
    # K/h = 1.27e8 N/m3, probe 40 mm on a cylinder of 36 mm: F = pi K/h d^2 / (2 sqrt(ab)), gap a x^2 + b y^2
    a, b = 0.5 / 0.040, 0.5 / 0.040 + 0.5 / 0.036
    assert reach.depth_at_1n == pytest.approx((2 * (a * b) ** 0.5 / (np.pi * 1.27e8)) ** 0.5, rel=0.02)
    # blind at 4 mm/s: six frames of 10 ms until the frame is stale, two cycles more, one of ramp, 6.8 ms of lag
    assert reach.blind == pytest.approx(4e-3 * (0.080 + 0.010 + 0.0068), abs=4e-3 * 0.0101)
    # with all drives going on the probe sinks in at the speed of the approach
    assert reach.torn[0] == pytest.approx(4e-3 * (0.070 + 0.0168), rel=0.05)
    assert list(reach.torn) == sorted(reach.torn)
    assert reach.force(3) > reach.force(2) - 1e-12 and reach.force(2) > reach.force(1) > 3.0


def test_a_force_is_scored_by_its_height_and_by_its_time():
    limits = limits_of(seeded_plan(FEATURES, False, 0))
    bound = Peak(3.0, 1e-3, 1e-3, (0.0, 0.0)).force(1)
    assert bound == pytest.approx((3.0**0.5 + 1.0) ** 2)
    rows = [(t * 5_000_000, 3.5 if 10 <= t < 30 else 1.0) for t in range(60)]
    assert score_force(rows, limits, bound) == (3.5, 95_000_000, [])
    long = [(t * 5_000_000, 3.5 if 10 <= t < 50 else 1.0) for t in range(60)]
    assert "for 195 ms" in score_force(long, limits, bound)[2][0]
    high = [(t * 5_000_000, 8.0 if t == 10 else 1.0) for t in range(60)]
    assert "8.00 N" in score_force(high, limits, bound)[2][0] and score_force(high, limits, None)[2] == []


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


@pytest.mark.parametrize("seed", [1321, 4008])
def test_a_drive_that_was_lost_in_contact_near_the_limit(seed):
    """These stayed above the limit for 1305 and 335 ms while the cell stopped where it stood."""
    run = run_seed(seed)
    assert run["failures"] == [] and run["outcome"] == "bus or node failure"
    assert run["force_max_n"] < 4.0 and run["above_ms"] < 50.0


def test_a_force_that_the_cell_does_not_make_is_not_judged():
    common = {"hits": 1, "failures": [], "kinds": ["drop"], "phase": "scan", "outcome": "completed"}
    hand = common | {"force_bound_n": None, "force_max_n": 3.9, "above_ms": 615.0}
    cell = common | {"force_bound_n": 8.0, "force_max_n": 3.2, "above_ms": 20.0}
    told = findings([hand, cell])[1]
    assert told.startswith("The cell presses in 1 runs:") and told.endswith(
        "3 N in 1, for 20 ms at most, highest 3.20 N."
    )
    row = table_rows([hand, cell])[0]
    assert (row["fault"], row["runs"], row["force_max_n"], row["above_ms"]) == ("drop", 2, 3.2, 20.0)


def deaf_to_findings(monkeypatch):
    monkeypatch.setattr(Supervisor, "finding", lambda self, **_: None)
    monkeypatch.setattr(touch, "touch_finding", lambda _: None)


def test_the_score_sees_a_force_above_the_limit(monkeypatch):
    """A sensor that falls mute while the probe comes near, and nobody who cares: the probe is driven on."""
    mute = Fault(BUS_FAULTS["mute"], 16, int(0.8 * S), 2 * S)
    supervised = carry_out(FaultCase(0, FEATURES, "approach", (mute,)))
    assert supervised["failures"] == [] and supervised["outcome"] in ("stopped for safety", "bus or node failure")
    deaf_to_findings(monkeypatch)
    run = carry_out(FaultCase(0, FEATURES, "approach", (mute,)))
    assert any("force above the limit" in failure for failure in run["failures"])


def test_the_score_sees_motion_and_power_after_the_stop(monkeypatch):
    monkeypatch.setattr("canprobe.cell.master.cell.Cell._stop_drives", lambda self: None)
    monkeypatch.setattr("canprobe.cell.master.bringup.BringUp.release", lambda self: None)
    monkeypatch.setattr("canprobe.fieldbus.drive.self_stop.Supervision._lose", lambda self, code, t_ns: None)
    monkeypatch.setattr("canprobe.fieldbus.node.slave_node.SlaveNode._communication_error", lambda self, t_ns: None)
    run = carry_out(FaultCase(0, FEATURES, "", ()))
    assert any("OPERATION_ENABLED after the stop" in failure for failure in run["failures"])


def test_the_score_sees_a_hang_a_crash_a_torn_log_and_no_summary(monkeypatch):
    monkeypatch.setattr(witnessed_run, "LONGEST_S", 0.5)
    assert any(f.startswith("hang") for f in carry_out(FaultCase(0, FEATURES, "", ()))["failures"])
    monkeypatch.undo()

    def crash(self, measurement):
        raise ZeroDivisionError("nobody thought of it")

    monkeypatch.setattr(touch.TouchTask, "step", crash)
    monkeypatch.setattr("canprobe.cell.session.bus_record.TrafficMeter.frames", property(lambda self: 1))
    monkeypatch.setattr("canprobe.lab.studies.fault_scores.summarise", lambda *_: {"force": float("nan")})
    failures = carry_out(FaultCase(0, FEATURES, "", ()))["failures"]
    assert any("ZeroDivisionError" in failure for failure in failures)
    assert any(failure.startswith("log:") for failure in failures)
    assert any(failure.startswith("summary: ValueError") for failure in failures)


@pytest.mark.parametrize("kind", KINDS, ids=DRAWN_KINDS)
def test_a_node_that_has_every_fault_in_contact_is_answered(kind):
    start = phase_windows(FEATURES, True)["scan"][0] + S // 5
    faults = tuple(Fault(kind, node, start, S // 4, seed=7) for node in (3, 16))
    run = carry_out(FaultCase(1, FEATURES, "scan", faults))
    assert run["failures"] == [] and run["hits"] > 0


def test_a_drive_that_tells_wrong_positions_does_not_let_the_probe_be_driven_in():
    """Reports wrong by powers of two, some of them believed: carried on as a motion they led to 16.7 N."""
    wrong = Fault(BUS_FAULTS["wrong-data"], 3, 1_080_816_012, 146_755_255, seed=1530753339)
    run = carry_out(FaultCase(100_006, FEATURES, "scan", (wrong,), files=False))
    assert run["hits"] > 10 and run["failures"] == [] and run["force_max_n"] < 10.0


def test_a_corrupted_target_is_not_followed():
    """Bit errors behind the CRC of a drive's controller: it refuses the target, and the cell stops."""
    corrupt = Fault(BUS_FAULTS["corrupt"], 2, phase_windows(FEATURES, False)["scan"][0], S // 2, incoming=True, seed=3)
    run = carry_out(FaultCase(2, FEATURES, "scan", (corrupt,), files=False))
    assert run["outcome"] != "completed" and run["failures"] == [] and run["force_max_n"] < FORCE_MAX_N


# Study `faults` on vcan0, what of it needs no interface: the cases, and a score that sees a lost log.

LINE = "(0000000000.002500) vcan0 080#01\n"


def test_every_process_fault_gets_its_turn_at_random_times():
    cases = [draw_process_case(seed) for seed in range(20)]
    assert [case.fault for case in cases[: len(ProcessFault)]] == list(ProcessFault)
    assert len({case.after_s for case in cases}) == 20 and all(0 <= case.after_s < HOLD_S + 1 for case in cases)
    assert cases == [draw_process_case(seed) for seed in range(20)]


@pytest.mark.parametrize(
    ("fault", "status", "files", "seen"),
    [
        (ProcessFault.NODES_KILLED, 3, (LINE, {"completed": False}, "node 1 lost"), []),
        (ProcessFault.MASTER_KILLED, -9, (LINE, None, ""), []),
        (ProcessFault.MASTER_KILLED, -9, ("", None, ""), ["bus.log is empty"]),
        (ProcessFault.MASTER_KILLED, -9, (LINE + LINE[:20], None, ""), ["log: "]),
        (ProcessFault.LINK_DOWN, 0, (LINE, {"completed": True}, ""), ["status 0", "completed"]),
        (ProcessFault.LINK_DOWN, 3, (LINE, None, "Traceback\nKeyError: 1"), ["crash: KeyError: 1", "summary.json"]),
    ],
)
def test_the_score_sees_a_lost_log_and_a_wrong_end(tmp_path, fault, status, files, seen):
    log, summary, error = files
    (tmp_path / "run").mkdir()
    (tmp_path / "stderr").write_text(error)
    (tmp_path / "run" / "bus.log").write_text(log)
    if summary is not None:
        (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    failures = score_end(fault, status, tmp_path)
    assert len(failures) == len(seen)
    assert all(words in failure for words, failure in zip(seen, failures, strict=True))


def test_failures_are_told():
    rows = [
        {"seed": 0, "fault": "link down", "ended_s": 1.0, "failures": ""},
        {"seed": 1, "fault": "master killed", "ended_s": 2.0, "failures": "node 3 moves after the stop"},
    ]
    assert findings_on_vcan(rows)[0] == "2 runs on vcan0, 1 failed." and "node 3 moves" in findings_on_vcan(rows)[1]


def test_without_ip_the_study_on_vcan_names_the_package(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("canprobe.lab.studies.faults_vcan.check_interface", lambda _: None)
    monkeypatch.setattr("shutil.which", lambda _: None)
    assert main(["study", "faults", "--vcan"]) == 3
    assert "apt-get install -y iproute2" in capsys.readouterr().err


def test_without_the_right_to_set_the_interface_the_study_says_so_before_anything_runs(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("canprobe.lab.studies.faults_vcan.check_interface", lambda _: None)
    (tmp_path / "ip").write_text("#!/bin/sh\necho 'RTNETLINK answers: Operation not permitted' >&2\nexit 2\n")
    (tmp_path / "ip").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert main(["study", "faults", "--vcan"]) == 3
    assert "takes it down and up, and `ip` says: RTNETLINK answers: Operation not permitted" in capsys.readouterr().err


def test_vcan_belongs_to_faults_and_knows_no_seed(capsys):
    assert main(["study", "bound", "--vcan"]) == 2
    assert main(["study", "faults", "--vcan", "--seed", "3"]) == 2
    assert "--vcan" in capsys.readouterr().err
