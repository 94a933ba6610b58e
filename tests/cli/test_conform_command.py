"""`canprobe conform` as it is typed: reports, exit status, wrong use."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import pytest

from canprobe.cli import main
from canprobe.fieldbus.tools.conform import POINTS

ARGS = ["conform", "--node", "5", "--eds", "puma260_joint", "--bus", "lockstep"]


def test_all_reports_of_one_examination(tmp_path, capsys):
    junit, page, log = (tmp_path / name for name in ("c.xml", "c.html", "c.log"))
    assert main([*ARGS, "--json", "--junit", str(junit), "--html", str(page), "--log", str(log)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["tool"] == "conform" and document["counts"]["FAIL"] == 0 and document["counts"]["PASS"] > 90
    assert document["facts"]["vendor"] == "0xca5e" and "SHA-256" in document["facts"]["EDS"]
    names = [case.get("classname") for case in ElementTree.parse(junit).iter("testcase")]
    assert "canprobe.conform.sdo" in names and len(names) == len(document["rows"])
    assert "CiA certificate" in page.read_text(encoding="utf-8")
    assert len(log.read_text(encoding="ascii").splitlines()) > 1000
    baseline = tmp_path / "before.json"
    baseline.write_text(json.dumps(document), encoding="utf-8")
    assert main([*ARGS, "--points", "nmt", "--baseline", str(baseline)]) == 0
    assert "baseline: as in the baseline" in capsys.readouterr().out, "points that were not asked for are not gone"


def test_the_verdict_comes_first_and_the_points_with_full(capsys):
    assert main(ARGS) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 6
    assert re.fullmatch(r"canprobe PUMA 260 joint, node 5 on lockstep: passes, \d+ points", lines[0])
    assert lines[2] == "more points with: --write (8), --motion (6)"
    assert "--full" in lines[-1] and "--html FILE" in lines[-1]
    assert main([*ARGS, "--full", "--points", "nmt,28"]) == 0
    full = capsys.readouterr().out
    assert re.match(r"canprobe PUMA 260 joint, node 5 on lockstep: passes, \d+ points\n", full)
    assert "pass   nmt       1 boot-up" in full and "in all" in full
    assert "1010h" not in full and "tactile" not in full, "left out, and not asked for"


def test_what_fails_comes_with_what_to_type(capsys, monkeypatch):
    def deviates(bench):
        bench.deviates("the TPDO is short")

    point = next(point for point in POINTS if point.title == "83 heard lengths")
    monkeypatch.setattr("canprobe.cli.conform._points", lambda args: [replace(point, run=deviates)])
    assert main(ARGS) == 1
    assert capsys.readouterr().out.splitlines() == [
        "canprobe PUMA 260 joint, node 5 on lockstep: 1 of 1 point FAIL",
        "1 FAIL",
        "FAIL   pdo 83 heard lengths: the TPDO is short [CiA 301, PDO mapping]",
        "all points: type it again with --full, or --html FILE for the frames; after a change --points pdo",
    ]


def test_the_list_and_chosen_points(capsys):
    assert main(["conform", "--list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {row["group"] for row in rows} >= {
        "nmt",
        "sdo",
        "pdo",
        "sync",
        "emcy",
        "heartbeat",
        "lss",
        "drive402",
        "hostile",
    }
    assert main([*ARGS, "--points", "10 write ro,43", "--json"]) == 0
    names = [row["name"] for row in json.loads(capsys.readouterr().out)["rows"]]
    assert names == ["10 write ro", "43 identifier", "43 inhibit time"]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["conform"], "--node N names the device"),
        (["conform", "--bus", "lockstep"], "any, such as --node 1"),
        (["conform", "--node", "5", "--bus", "lockstep"], "name it with --eds"),
        (["conform", "--node", "5", "--bus", "direct"], "no bus in --bus direct"),
        ([*ARGS, "--points", "smo"], "did you mean"),
        ([*ARGS, "--write", "1010h"], "1010h is never written"),
        ([*ARGS, "--baseline", "nowhere.json"], "nowhere.json"),
        ([*ARGS, "--restore", "nowhere.json"], "nowhere.json"),
        ([*ARGS[:3], "--channel", "no0", "--motion"], "--motion needs a yes"),
    ],
)
def test_wrong_use_is_said_in_a_line(arguments, text, capsys, monkeypatch):
    monkeypatch.setattr("sys.stdin.readline", lambda: "no\n", raising=False)
    assert main(arguments) == 2
    err = capsys.readouterr().err
    assert text in err and "Traceback" not in err


def test_a_plan_reads_the_times_of_a_report(tmp_path, capsys):
    path = tmp_path / "conform.json"
    assert main([*ARGS, "--points", "timing", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    path.write_text(json.dumps(document), encoding="utf-8")
    assert main(["plan", "cylinder", "--measured", str(path), "--json"]) == 0
    times = json.loads(capsys.readouterr().out)
    assert times["as_planned"] and {row["node_id"] for row in times["times"]} == {1, 2, 3, 4, 5, 6}
    document["distributions"]["SYNC to TPDO"][7] = 2.6  # ms, at 400 Hz
    path.write_text(json.dumps(document), encoding="utf-8")
    assert main(["plan", "cylinder", "--measured", str(path)]) == 3
    assert "2.600 ms of 2.5 ms, 50 times  longer than the plan allows" in capsys.readouterr().out
    document["facts"]["product"] = "0x1"
    path.write_text(json.dumps(document), encoding="utf-8")
    assert main(["plan", "cylinder", "--measured", str(path)]) == 2
    assert "no node of the plan is a device" in capsys.readouterr().err


def modules(program: str) -> set[str]:
    """Modules that a program imports."""
    shown = "import sys; print('|', *sys.modules)"
    done = subprocess.run([sys.executable, "-c", f"{program}\n{shown}"], capture_output=True, text=True, check=True)
    return set(done.stdout.rpartition("|")[2].split())


@pytest.mark.parametrize("words", [[*ARGS, "--points", "100"], ["judge", "--eds", "puma260_joint", "--node-id", "1"]])
def test_it_needs_neither_numpy_nor_scipy(words, tmp_path):
    """A step of CI waits for the start of each command."""
    (tmp_path / "bus.log").write_text("(0000000000.000000) can0 701#00\n")
    words = words + ["--record", str(tmp_path / "bus.log")] * (words[0] == "judge")
    assert not modules(f"from canprobe.cli import main; main({words})") & {"numpy", "scipy"}
