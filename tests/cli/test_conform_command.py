"""`canprobe conform` as it is typed: reports, exit status, wrong use."""

from __future__ import annotations

import json
from xml.etree import ElementTree

import pytest

from canprobe.cli import main

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
    out = capsys.readouterr().out
    assert "pass   nmt       1 boot-up" in out and "baseline: gone:" in out


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
