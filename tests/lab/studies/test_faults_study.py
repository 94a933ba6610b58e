"""Study `faults`: a run follows from its number, the score sees what it must, and a few runs are without failure."""

import json
import os

import numpy as np
import pytest

from canprobe.cell.emulated.array_faults import CELL_FAULTS
from canprobe.cell.master.supervisor import Supervisor
from canprobe.cell.planning.motion import parked_posture
from canprobe.cell.session.child_process import ERRORS
from canprobe.cell.tasks import touch
from canprobe.cli import main
from canprobe.fieldbus.tools.faults import Fault
from canprobe.lab.studies import witnessed_run
from canprobe.lab.studies.fault_cases import (
    ARM_FILES,
    CASES,
    PHASES,
    PLANTS,
    TASKS,
    FaultCase,
    WrongFile,
    task_plan,
    wrong_files,
)
from canprobe.lab.studies.fault_runs import FaultRun, phase_windows, run_case, run_wrong_file
from canprobe.lab.studies.faults import QUICK_KINDS, findings, quick_numbers, table_rows
from canprobe.lab.studies.faults_vcan import HOLD_S, PROCESS_FAULTS, draw_process_case, score_end
from canprobe.lab.studies.faults_vcan import findings as findings_on_vcan
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.model import joints_to_units, units_to_joints

S = 1_000_000_000
BEYOND = {"stuck-image", "replayed-image", "gain-lost", "brake-stuck"}
"""Kinds whose force nothing but the array notices, and the array is wrong."""


def thrown(kind, node, phase, *, for_s=0.25, task="press", number=1, **values):
    """A run of a task with one fault from the beginning of a phase on."""
    fault = Fault(CELL_FAULTS[kind], node, phase_windows(task, "ideal")[phase][0], round(for_s * S), values, seed=7)
    return FaultRun(task_plan(task, "ideal").with_seed(number), (fault,))


def test_a_number_is_the_same_run_again():
    wanted = ("press", "contact", "ideal", "drop")
    cases = map(FaultCase.of, range(CASES))
    case = next(case for case in cases if (case.task, case.phase, case.plant, case.kind.name) == wanted)
    assert run_case(case) == run_case(case)


def test_every_kind_of_the_registry_is_drawn_in_every_task_phase_and_plant_at_a_node_that_can_have_it():
    windows = {phase: (k * S, (k + 1) * S) for k, phase in enumerate(PHASES)}
    cases = [FaultCase.of(number) for number in range(3 * CASES)]
    places = {(case.kind.name, case.task, case.phase, case.plant) for case in cases[:CASES]}
    assert len(places) == CASES == len(CELL_FAULTS) * len(TASKS) * len(PHASES) * len(PLANTS)
    faults = [(case, case.fault((1, 2, 3, 4, 5, 6), 16, windows)) for case in cases]
    assert {fault.node_id for _, fault in faults} == {1, 2, 3, 4, 5, 6, 16}
    for case, fault in faults:
        assert windows[case.phase][0] <= fault.start_ns < windows[case.phase][1]
        assert case.kind.needs == "node" or (case.kind.needs == "array") is (fault.node_id == 16)
        for name, value in fault.values.items():
            assert case.kind.parameters[name].low <= value <= case.kind.parameters[name].high
    assert {fault.duration_ns < 2 * S for _, fault in faults} == {True, False}


@pytest.mark.parametrize("task", ["press", pytest.param("calibrate", marks=pytest.mark.slow(reason="a second task"))])
def test_the_phases_of_a_task_follow_each_other(task):
    windows = phase_windows(task, "ideal")
    assert tuple(windows) == PHASES
    edges = [edge for window in windows.values() for edge in window]
    assert edges == sorted(edges)
    assert all(last - first > 0.1 * S for first, last in windows.values())


@pytest.mark.slow(reason="a whole study in its quick form")
def test_the_quick_study_runs_from_the_command_line(tmp_path, capsys):
    assert main(["study", "faults", "--quick", "--workers", "1", "--out", str(tmp_path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    rows = {row["fault"]: row for row in document["rows"]}
    assert set(rows) == {*QUICK_KINDS, "all"} and rows["all"]["runs"] == len(quick_numbers())
    assert {name for name, row in rows.items() if row["failures"]} <= BEYOND | {"all"}
    assert all(row["force_max_n"] <= 1.2 * 5.0 for name, row in rows.items() if name not in BEYOND | {"all"})
    assert rows["all"]["force_max_n"] == max(rows[name]["force_max_n"] for name in QUICK_KINDS)
    assert document["findings"][0].startswith(f"{rows['all']['runs']} runs")
    (files,) = document["more"]
    assert [row["file"] for row in files["rows"]] == ["true gear × ½"]
    assert (tmp_path / "faults.png").is_file() and (tmp_path / "faults_files.csv").is_file()


def test_one_run_is_told_by_its_number(capsys):
    assert main(["study", "faults", "--seed", "0", "--json"]) == 0
    told = capsys.readouterr()
    outcome = json.loads(told.out)
    assert outcome["number"] == 0 and outcome["fault"] in told.err
    assert main(["study", "estimators", "--seed", "3"]) == 2


def deaf_to_findings(monkeypatch):
    monkeypatch.setattr(Supervisor, "finding", lambda self, **_: None)
    monkeypatch.setattr(touch, "touch_finding", lambda _: None)


def test_the_score_sees_a_force_above_the_limit_and_when_a_fault_is_noticed(monkeypatch):
    """A sensor that falls mute while the probe comes near, and nobody who cares: the probe is driven on."""
    supervised = thrown("mute", 16, "approach", for_s=5.0).result()
    assert supervised["failures"] == [] and supervised["named"]
    assert supervised["outcome"] in ("stopped for safety", "bus or node failure")
    assert 0.0 < supervised["noticed_ms"] < 50.0 and supervised["left_n"] == 0.0
    deaf_to_findings(monkeypatch)
    run = thrown("mute", 16, "approach", for_s=5.0).result()
    assert any(failure.startswith("true force of ") for failure in run["failures"])
    assert run["force_share"] == run["force_max_n"] / 5.0 > 1.5 and run["above_ms"] > 100.0


def test_a_fault_that_mattered_is_not_reported_as_completed():
    run = FaultRun(task_plan("press", "ideal").with_seed(0))
    assert run.result()["failures"] == []
    highest = max(range(len(run.witness.rows)), key=lambda k: run.witness.rows[k][1])
    t_ns, force = run.witness.rows[highest]
    run.witness.rows[highest] = (t_ns, 5.5)
    assert [failure.partition(",")[0] for failure in run.result()["failures"]] == ["completed"]
    run.witness.rows[highest] = (t_ns, force)
    run.witness.rows[:] = [(t_ns, force + 2.5 * (force > 2.0)) for t_ns, force in run.witness.rows]  # 0.6 s of a hold
    result = run.result()
    assert 2.3 < result["above_measured_n"] < 2.8 and result["failures"][-1].startswith("completed")


def test_the_score_sees_motion_and_power_after_the_stop(monkeypatch):
    monkeypatch.setattr("canprobe.cell.master.arm_power.ArmPower.disable", lambda self: None)
    monkeypatch.setattr("canprobe.cell.master.bringup.BringUp.release", lambda self: None)
    monkeypatch.setattr("canprobe.fieldbus.drive.parts.Supervision._lose", lambda self, code, t_ns: None)
    monkeypatch.setattr("canprobe.fieldbus.node.slave_node.SlaveNode._communication_error", lambda self, t_ns: None)
    run = FaultRun(task_plan("press", "ideal").with_seed(0)).result()
    assert any("OPERATION_ENABLED after the stop" in failure for failure in run["failures"])


def test_the_score_sees_a_hang_a_crash_a_torn_log_and_no_summary(monkeypatch, tmp_path):
    plan = task_plan("press", "ideal").with_seed(0)
    monkeypatch.setattr(witnessed_run, "LONGEST_S", 0.5)
    assert any(f.startswith("hang") for f in FaultRun(plan).result()["failures"])
    monkeypatch.undo()

    def crash(self, measurement):
        raise ZeroDivisionError("nobody thought of it")

    monkeypatch.setattr(touch.TouchTask, "step", crash)
    monkeypatch.setattr("canprobe.cell.session.buses.TrafficMeter.frames", property(lambda self: 1))
    monkeypatch.setattr("canprobe.lab.studies.fault_runs.summarise", lambda *_: {"force": float("nan")})
    failures = FaultRun(plan, folder=tmp_path).result()["failures"]
    assert any("ZeroDivisionError" in failure for failure in failures)
    assert any(failure.startswith("log:") for failure in failures)
    assert any(failure.startswith("summary: ValueError") for failure in failures)


MORE = pytest.mark.slow(reason="more kinds of a study")


@pytest.mark.parametrize(
    ("kind", "node"),
    [
        ("drop", 3),
        ("freeze", 3),
        ("sto", 2),
        *(
            pytest.param(*more, marks=MORE)
            for more in (("delay", 2), ("corrupt", 16), ("reboot", 5), ("wrong-data", 3))
        ),
    ],
)
def test_a_node_that_has_a_fault_in_contact_is_answered(kind, node):
    run = thrown(kind, node, "contact").result()
    assert run["failures"] == [] and run["hits"] > 0


def test_a_corrupted_target_is_not_followed():
    """Bit errors behind the CRC of a drive's controller: it refuses the target, and the cell stops."""
    start_ns = phase_windows("press", "ideal")["contact"][0]
    corrupt = Fault(CELL_FAULTS["corrupt"], 2, start_ns, S // 2, incoming=True, seed=3)
    run = FaultRun(task_plan("press", "ideal").with_seed(2), (corrupt,)).result()
    assert run["outcome"] != "completed" and run["failures"] == [] and run["force_max_n"] < 5.0


def test_the_table_names_the_worst_run_of_each_kind():
    common = {"hits": 1, "failures": [], "kind": "drop", "phase": "contact", "plant": "ideal", "named": True}
    common |= {"above_ms": 0.0, "left_n": 0.0, "fault": "drop at node 3", "number": 7}
    mild = common | {"task": "press", "outcome": "completed", "reason": "", "noticed_ms": None}
    hard = common | {"task": "weave", "outcome": "stopped for safety", "reason": "node 3: lost", "noticed_ms": 15.0}
    mild |= {"force_max_n": 3.2, "force_share": 0.64}
    hard |= {"force_max_n": 8.0, "force_share": 1.6, "above_ms": 30.0, "left_n": 2.0, "failures": ["true force"]}
    row = table_rows([mild, hard])[0]
    assert (row["fault"], row["runs"], row["force_max_n"], row["worst"]) == ("drop", 2, 8.0, "weave, contact, ideal")
    assert (row["press_n"], row["weave_n"], row["explore_n"]) == (3.2, 8.0, None)
    assert (row["noticed_ms"], row["unnoticed"], row["pressing"], row["left_n"]) == (15.0, 1, 1, 2.0)
    assert (row["above_ms"], row["named"], row["failures"]) == (30.0, 100.0, 1)
    told = findings([mild, hard])
    assert "in 50.00% of the runs" in told[1] and "highest 1.60 ×" in told[1]
    assert told[3].endswith("true force (canprobe study faults --seed 7)")


# Files that are wrong.


@pytest.mark.parametrize("what", ARM_FILES)
def test_an_arm_with_a_wrong_file_stands_where_it_is_thought_to_stand_at_first(what):
    case = WrongFile(what, 3, "ideal")
    setup = case.plan().setup
    believed, true, q0 = setup.arm.model, setup.truth.model, parked_posture(setup, setup.arm)
    assert joints_to_units(true, q0) == pytest.approx(joints_to_units(believed, q0), abs=1e-6)
    step = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    moved = units_to_joints(true, joints_to_units(believed, q0 + step)) - q0
    factor = {"true gear × ½": 2.0, "true gear × 2": 0.5, "other sign": -1.0, "zero off by 5°": 1.0}[what]
    assert moved == pytest.approx(factor * step, abs=1e-9)
    turn = forward(true.chain, q0)[:3, :3].T @ forward(believed.chain, q0)[:3, :3]
    angle = np.degrees(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
    assert angle == pytest.approx(5.0 if what == "zero off by 5°" else 0.0, abs=1e-4)


def test_a_first_touch_with_a_wrong_file_has_its_row():
    every = wrong_files(6)
    assert len(every) == len(set(every)) == (4 * 6 + 5) * 2
    refused = run_wrong_file(WrongFile("stiffness of the file × 10", 0, "ideal"))
    assert refused["outcome"] == "refused by the plan" and refused["failures"] == []
    weak = run_wrong_file(WrongFile("calibration of an array that reads × 0.7", 0, "ideal"))
    assert pytest.approx(weak["force_max_n"], rel=0.15) == 3.0 / 0.7


# Study `faults` on vcan0, what of it needs no interface: the cases, and a score that sees a lost log.

LINE = "(0000000000.002500) vcan0 080#01\n"


def test_every_process_fault_gets_its_turn_at_random_times():
    cases = [draw_process_case(seed) for seed in range(20)]
    assert [case.fault for case in cases[: len(PROCESS_FAULTS)]] == list(PROCESS_FAULTS)
    assert len({case.after_s for case in cases}) == 20 and all(0 <= case.after_s < HOLD_S + 1 for case in cases)
    assert cases == [draw_process_case(seed) for seed in range(20)]


@pytest.mark.parametrize(
    ("fault", "status", "files", "seen"),
    [
        ("nodes killed", 3, (LINE, {"completed": False}, "node 1 lost"), []),
        ("master killed", -9, (LINE, None, ""), []),
        ("master killed", -9, ("", None, ""), ["bus.log is empty"]),
        ("master killed", -9, (LINE + LINE[:20], None, ""), ["log: "]),
        ("link down", 0, (LINE, {"completed": True}, ""), ["status 0", "completed"]),
        ("link down", 3, (LINE, None, "Traceback\nKeyError: 1"), ["crash: KeyError: 1", "summary.json"]),
    ],
)
def test_the_score_sees_a_lost_log_and_a_wrong_end(tmp_path, fault, status, files, seen):
    log, summary, error = files
    (tmp_path / "run").mkdir()
    (tmp_path / ERRORS).write_text(error)
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
    assert main(["study", "estimators", "--vcan"]) == 2
    assert main(["study", "faults", "--vcan", "--seed", "3"]) == 2
    assert "--vcan" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("number", "kind"),
    [
        (2611, "wrong-data"),
        *(
            pytest.param(*more, marks=pytest.mark.slow(reason="more runs that once pressed too hard"))
            for more in ((644, "remapped"), (1713, "emcy"), (673, "wrong-data"), (1720, "encoder-jump"))
        ),
    ],
)
def test_a_stop_in_a_motion_presses_no_harder_than_the_motion(number, kind):
    """45.8 N: one step back had set the speed from which each drive then braked by itself. 13.1 N: a statusword that
    stands beside an impossible position was believed, and the arm was stopped at once. 15.9 N: a hold went back to a
    guess of where a joint was. 35.8 N: one wrong report said that a joint stands, which had its quick stop then. 7.0 N:
    a lift-off began behind the targets, with a jump against the motion.
    """
    case = FaultCase.of(number)
    assert case.kind.name == kind, "the registry has changed: the numbers mean other runs"
    run = run_case(case)
    assert run["failures"] == [] and run["force_max_n"] < 3.0
