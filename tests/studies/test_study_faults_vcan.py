"""Study `faults` on vcan0, what of it needs no interface: the cases, and a score that sees a lost log."""

from __future__ import annotations

import json

import pytest

from canprobe.child import EmulatorChild
from canprobe.cli import main
from canprobe.studies.fault_processes import HOLD_S, ProcessCase, ProcessFault, _Run, served_scene
from canprobe.studies.faults_vcan import draw_process_case, findings

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
    child = EmulatorChild(served_scene(), None, "vcan0")  # never started
    run = _Run(ProcessCase(0, fault, 0.0), child, tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "stderr").write_text(error)
    (tmp_path / "run" / "bus.log").write_text(log)
    if summary is not None:
        (tmp_path / "run" / "summary.json").write_text(json.dumps(summary))
    run._score(status)
    child.end()
    assert len(run.failures) == len(seen)
    assert all(words in failure for words, failure in zip(seen, run.failures, strict=True))


def test_failures_are_told():
    rows = [
        {"seed": 0, "fault": "link down", "ended_s": 1.0, "failures": ""},
        {"seed": 1, "fault": "master killed", "ended_s": 2.0, "failures": "node 3 moves after the stop"},
    ]
    assert findings(rows)[0] == "2 runs on vcan0, 1 failed." and "node 3 moves" in findings(rows)[1]


def test_vcan_belongs_to_faults_and_knows_no_seed(capsys):
    assert main(["study", "bound", "--vcan"]) == 2
    assert main(["study", "faults", "--vcan", "--seed", "3"]) == 2
    assert "--vcan" in capsys.readouterr().err
