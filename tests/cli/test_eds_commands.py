"""`canprobe eds check` and `canprobe emulate --eds`, as far as they go without a bus."""

import json
from pathlib import Path

import pytest

from canprobe import api
from canprobe.cell.session import served
from canprobe.cli import main

MESSY = Path(__file__).parents[1] / "fieldbus" / "eds" / "messy"


@pytest.mark.parametrize("name", ["puma260_joint", "tactile_array"])
def test_our_own_files_are_clean(name, capsys):
    assert main(["eds", "check", name]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line.split(": ")[1].startswith("clean, ")


def test_warnings_are_told_apart_and_leave_status_0(capsys):
    assert main(["eds", "check", str(MESSY / "numbers.eds")]) == 0
    *rows, last = capsys.readouterr().out.splitlines()
    assert all(row.startswith("warning: line ") for row in rows)
    assert "[2003] DefaultValue: 010 is octal by CiA 306, 8" in rows[0]
    assert last.endswith(f": 0 faults, {len(rows)} warnings; can be served")


def test_faults_give_status_2_with_section_and_line(capsys):
    assert main(["eds", "check", str(MESSY / "broken.eds")]) == 2
    *rows, last = capsys.readouterr().out.splitlines()
    assert rows[0] == "fault: line 24 [1000] DefaultValue: 'many' is not a value of type UNSIGNED32"
    assert last.endswith(": 2 faults, 0 warnings; cannot be served")


def test_json_has_faults_and_warnings_apart(capsys):
    assert main(["eds", "check", "--json", str(MESSY / "broken.eds")]) == 2
    document = json.loads(capsys.readouterr().out)
    assert (document["servable"], len(document["faults"]), document["warnings"]) == (False, 2, [])
    assert document["faults"][1]["section"] == "1005"
    assert main(["eds", "check", "--json", str(MESSY / "drive402.eds")]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["servable"], document["device_profile"], document["faults"]) == (True, 402, [])
    assert {row["section"] for row in document["warnings"]} >= {"6041", "6061", "6064", "607A"}


def test_the_node_id_decides_what_nodeid_sums_give(tmp_path, capsys):
    """A sum that leaves its data type for high node ids only."""
    path = tmp_path / "sum.eds"
    path.write_text(
        "[DeviceInfo]\n[1400]\nParameterName=x\nObjectType=9\n"
        "[1400sub2]\nParameterName=x\nDataType=5\nAccessType=rw\nDefaultValue=$NODEID+0xF0\n"
    )
    assert main(["eds", "check", str(path), "--node-id", "15"]) == 0
    assert main(["eds", "check", str(path), "--node-id", "16"]) == 2
    assert "line 9 [1400sub2] DefaultValue" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("eds check nofile.eds", "'nofile.eds': no such file"),
        ("emulate --channel vcan0", "name a SCENE, or else --eds FILE"),
        ("emulate free --eds puma260_joint --node-id 1 --channel vcan0", "name a SCENE, or else --eds FILE"),
        ("emulate --eds puma260_joint --channel vcan0", "1 --eds, but 0 --node-id"),
        ("emulate --eds puma260_joint --node-id 1", "--channel is missing"),
        ("emulate --eds puma260_joint --node-id 1 --channel a=vcan0", "one channel, without a name"),
        ("emulate --eds puma260_joint --node-id 1 --channel vcan0 --seed 3", "--seed belongs to a scene"),
        ("emulate free --node-id 1 --channel vcan0", "--node-id belongs to --eds"),
        (
            "emulate --eds puma260_joint --node-id 1 --eds tactile_array --node-id 1 --channel vcan0",
            "node id 1 is given",
        ),
        ("emulate --eds puma260_joint --node-id 0 --channel vcan0", "from 1 to 127"),
    ],
)
def test_wrong_usage_is_one_clear_line(words, told, capsys):
    assert main(words.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert told in err and err.count("\n") == 1


def test_a_file_that_cannot_be_served_is_told_fault_by_fault(capsys):
    assert main(["emulate", "--eds", str(MESSY / "broken.eds"), "--node-id", "5", "--channel", "vcan0"]) == 2
    assert capsys.readouterr().err.count("not a usable EDS file: line ") == 2


def test_pairs_of_file_and_node_id_reach_the_api(monkeypatch):
    calls = []
    monkeypatch.setattr(served, "emulate_eds", lambda files, target, **_: calls.append((files, target)))
    pairs = ["--eds", "a.eds", "--node-id", "5", "--eds", "b.dcf", "--node-id", "20"]
    assert main(["emulate", *pairs, "--bus", "virtual", "--channel", "c", "--bitrate", "500000"]) == 0
    assert calls == [([("a.eds", 5), ("b.dcf", 20)], api.Target("virtual", "c", 500_000))]


def test_a_dcf_is_checked_for_the_node_that_it_configures(capsys):
    assert main(["eds", "check", str(MESSY / "configured.dcf")]) == 0
    assert "clean" in capsys.readouterr().out
    assert main(["eds", "check", str(MESSY / "configured.dcf"), "--node-id", "5"]) == 0
    assert "NodeID: the file configures node 7; read for node 5" in capsys.readouterr().out
