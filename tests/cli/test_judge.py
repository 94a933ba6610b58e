"""`canprobe judge`: a log, and a master that is started beside served nodes."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from xml.etree import ElementTree

import pytest
from network_buses import group  # noqa: F401
from scripted_masters import Master, TargetElsewhere
from undrawn import undrawn_run
from waiting import wait_until

import canprobe
from canprobe.cli import main
from canprobe.fieldbus.bus.candump import CandumpWriter, read_candump

SMALL = Path(__file__).parents[1] / "support" / "small_master.py"
NODE = ("--eds", "puma260_joint", "--node-id", "1")


def log_of(master, path):
    with CandumpWriter(path, "can0") as writer:
        for t_ns, can_id, data, _ in master.run():
            writer.write(can_id, data, t_ns)
    return str(path)


def test_a_log_of_a_bad_master(tmp_path, capsys):
    log = log_of(TargetElsewhere(), tmp_path / "bus.log")
    files = ("--junit", str(tmp_path / "j.xml"), "--html", str(tmp_path / "j.html"))
    assert main(["judge", *NODE, "--record", log, *files]) == 1
    told = capsys.readouterr().out
    assert "FAIL   enable    01 target at enable" in told
    assert "target 15000 while the axis is at 5000: 10000 off, 2000 allowed" in told
    assert "201#0F00983A0000" in told and "hint: read 6064h" in told
    assert main(["judge", *NODE, "--record", log, "--without", "1"]) == 0
    assert "left out: 01 target at enable: left out on request" in capsys.readouterr().out
    failed = ElementTree.parse(tmp_path / "j.xml").findall(".//testcase[failure]")
    assert [(case.get("classname"), case.get("name")) for case in failed] == [
        ("canprobe.judge.enable", "01 target at enable")
    ]
    assert "201#0F00983A0000" in (tmp_path / "j.html").read_text()


def test_what_became_better_is_told_and_only_what_is_new_fails_where_ci_asks_for_that(tmp_path, capsys):
    logs = {"bad": log_of(TargetElsewhere(), tmp_path / "bad.log"), "good": log_of(Master(), tmp_path / "good.log")}
    for (name, log), status in zip(logs.items(), (1, 0), strict=True):
        assert main(["judge", *NODE, "--record", log, "--json"]) == status
        (tmp_path / f"{name}.json").write_text(capsys.readouterr().out)
    assert main(["judge", *NODE, "--record", logs["good"], "--baseline", str(tmp_path / "bad.json")]) == 0
    assert "better: enable 01 target at enable" in capsys.readouterr().out
    junit = tmp_path / "j.xml"
    bad = ["judge", *NODE, "--record", logs["bad"], "--junit", str(junit), "--fail-on"]
    for baseline, status, tag in (("bad", 0, "skipped"), ("good", 1, "failure")):
        compared = ["--baseline", str(tmp_path / f"{baseline}.json")]
        assert main([*bad, "new", *compared]) == status
        assert main([*bad, "deviation", *compared]) == 1
        main([*bad, "new", *compared])
        assert ElementTree.parse(junit).find(".//testcase[@name='01 target at enable']")[0].tag == tag
    capsys.readouterr()
    assert main([*bad, "new"]) == 2
    assert "--baseline FILE names it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("nodes", "told"),
    [
        (
            (*NODE[:2], "--node-id", "9"),
            "no frame of node 9 or to it; nodes that it shows: 1, 2, 127; type --node-id 1",
        ),
        (("listen",), "nodes that it shows: 1, 2, 127; name a scene or a cell with them, or --eds FILE --node-id N"),
    ],
)
def test_a_log_of_other_nodes_says_which_it_has(nodes, told, tmp_path, capsys):
    class TwoNodes(Master):
        nodes = (1, 2)

    log = log_of(TwoNodes(), tmp_path / "good.log")
    assert main(["judge", *nodes, "--record", log]) == 2
    assert told in capsys.readouterr().err


def test_a_log_without_nodes(tmp_path, capsys):
    (tmp_path / "x.log").write_text("(1.000000) can0 123#00\n")
    assert main(["judge", *NODE, "--record", str(tmp_path / "x.log")]) == 2
    assert "is it a log of a CANopen bus?" in capsys.readouterr().err


def test_the_log_of_a_run_has_nothing_to_blame(tmp_path, capsys):
    undrawn_run(canprobe.load_scene("free"), duration_s=0.5, out=tmp_path / "run")
    assert main(["judge", "free", "--record", str(tmp_path / "run" / "bus.log"), "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert sum(row["verdict"] == "PASS" for row in rows) > 15
    with (tmp_path / "screen.txt").open("w") as screen:  # as `candump can0` prints it, without times
        for _, channel, can_id, data in read_candump(tmp_path / "run" / "bus.log"):
            print(f"  {channel}  {can_id:03X}   [{len(data)}]  {data.hex(' ').upper()}", file=screen)
    assert main(["judge", "free", "--record", str(tmp_path / "screen.txt"), "--json"]) == 0
    told = capsys.readouterr()
    assert "has no times, so no interval or time-out is judged" in told.err
    assert sum(row["verdict"] == "PASS" for row in json.loads(told.out)["rows"]) > 12


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--record", "x.log"], "name a SCENE or a cell, or else --eds FILE"),
        ([*NODE, "--record", "x.log", "--passive", "--", "true"], "COMMAND belongs to served nodes"),
        (["--eds", "puma260_joint", "--channel", "x"], "judge: 1 --eds, but 0 --node-id"),
        ([*NODE, "--passive", "--inject", "node 1: mute"], "choose one"),
        ([*NODE, "--record", "x.log", "--without", "32,99"], "expected numbers of rules, got '99'"),
        ([*NODE, "--record", "/nowhere/x.log"], "/nowhere/x.log: No such file"),
        ([*NODE, "--bus", "lockstep", "--channel", "x"], "lockstep"),
    ],
)
def test_wrong_usage(words, told, capsys):
    assert main(["judge", *words]) == 2
    assert told in capsys.readouterr().err


@pytest.mark.realtime
def test_a_command_is_started_and_judged(group, tmp_path, capsys):
    words = ["--passive", "--output", str(tmp_path / "out.txt"), "--log", str(tmp_path / "bus.log"), "--json"]
    assert main(["judge", *NODE, *words, "--seconds", "600", "--", sys.executable, str(SMALL), "1"]) == 1
    document = json.loads(capsys.readouterr().out)
    found = {row["name"] for row in document["rows"] if row["verdict"] == "FAIL"}
    assert {"01 target at enable", "06 first RPDO zero-filled"} <= found
    assert (tmp_path / "out.txt").read_text() == "done\n"
    assert main(["judge", *NODE, "--record", str(tmp_path / "bus.log")]) == 1


@pytest.mark.realtime
def test_a_command_that_fails_and_one_that_never_ends(group, tmp_path, capsys):
    out = ("--passive", "--output", str(tmp_path / "out.txt"))
    assert main(["judge", *NODE, *out, "--", "sh", "-c", "echo no adapter; exit 7"]) == 3
    assert "ended with status 7" in (told := capsys.readouterr().err) and "no adapter" in told
    assert "no master was heard" in told
    assert main(["judge", *NODE, *out, "--seconds", "0.2", "--", "sleep", "30"]) == 124
    assert main(["judge", *NODE, *out, "--seconds", "0.2"]) == 3, "nobody came"
    assert main(["judge", *NODE, *out, "--", "/nowhere/master"]) == 2
    assert "/nowhere/master: cannot be started: No such file" in capsys.readouterr().err


@pytest.mark.realtime
def test_ctrl_c_ends_the_command_while_the_nodes_are_served(group, tmp_path, capsys):
    master = "import can, time\nbus = can.Bus()\nbus.send(can.Message(arbitration_id=0x80, is_extended_id=False))\n"
    master += (
        "try:\n    print('ready', flush=True)\n    time.sleep(600)\nfinally:\n    bus.shutdown()\n    print('in order')"
    )
    out = tmp_path / "out.txt"

    def interrupt():
        wait_until(lambda: out.exists() and "ready" in out.read_text(), lambda: True, str)
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    assert main(["judge", *NODE, "--passive", "--output", str(out), "--", sys.executable, "-c", master]) == 0
    assert "in order" in out.read_text() and "KeyboardInterrupt" in out.read_text()


@pytest.mark.realtime
def test_the_nodes_of_a_scene_are_served(group, capsys):
    assert main(["judge", "free", "--passive", "--seconds", "0.3", "-v"]) == 3
    told = capsys.readouterr()
    assert "serving nodes 1, 2, 3, 4, 5, 6" in told.err and "no master was heard" in told.err
    assert "n/a    enable    01 target at enable" in told.out


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("place", "fault", "found"),
    [
        ("0.0", "motor 1: over-temperature on enabled", {"50 status passed over"}),
        ("held", "motor 1: brown-out on enabled for 100 ms", set()),
    ],
)
@pytest.mark.usefixtures("group")
def test_a_master_of_a_motor_is_judged_while_it_runs(place, fault, found, tmp_path, capsys):
    motor = ("--motor", "damiao:dm4310", "--id", "1", "--mst-id", "0x11", "--inject", fault, "--json")
    master = (sys.executable, str(SMALL.with_name("motor_master.py")), place, "4")
    assert main(["judge", *motor, "--output", str(tmp_path / "out.txt"), "--", *master]) == bool(found)
    document = json.loads(capsys.readouterr().out)
    assert {row["name"] for row in document["rows"] if row["verdict"] == "FAIL"} == found
    assert document["facts"]["fault 1"].startswith(f"motor 1: {fault.split()[2]}")
    assert not (tmp_path / "out.txt").exists() or (tmp_path / "out.txt").read_text() == ""
