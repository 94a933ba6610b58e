"""Points of the user: each kind of step passes and fails, under the gate, and is put back; mistakes in the file."""

from __future__ import annotations

import pytest
from examined import eds_device, failed

from canprobe.errors import UsageError
from canprobe.fieldbus.tools.conform import ExaminationSettings, WriteList
from canprobe.fieldbus.tools.conform.own_points import read_points
from canprobe.fieldbus.tools.reports import Verdict

GOOD = """
[[point]]
name = "identity"
clause = "manual, 1"
steps = [{ read = "1018h:01", equals = 0xCA5E }, { read = "1018:02", mask = 0xFF, low = 0x60, high = 0x60 },
    { read = "2FFFh", abort = "06020000" }]

[[point]]
name = "heartbeat"
needs = ["nmt"]
steps = [{ write = "1017h", value = 50 }, { nmt = "start" }, { expect = "705", data = "05", within_ms = 60 },
    { nmt = "reset-communication" }, { wait_ms = 5 }, { silent = "705", for_ms = 200 }]

[[point]]
name = "window"
steps = [{ write = "6065h", value = 7 }, { read = "6065h", equals = 7 },
    { write = "1018h:01", value = 0xCA5E, abort = "06010002h" }]

[[point]]
name = "SYNC"
steps = [{ nmt = "start" }, { send = "080#01", emcy = "8240h", within_ms = 10 }, { send = "080#" }]

[[point]]
name = "by hand"
steps = [{ ask = "press the button" }]
"""
FAILING = {
    '{ read = "1018h:01", equals = 1 }': "read of 1018h:01: 51806, expected 1",
    '{ read = "1018h:01", high = 1 }': "51806, expected at most 1",
    '{ read = "1018h:01", abort = "06020000" }': "accepted, expected abort 06020000h",
    '{ read = "2FFFh", equals = 1 }': "aborted with 06020000h (no object)",
    '{ expect = "705", within_ms = 20 }': "no frame 705h within 20 ms",
    '{ write = "1017h", value = 20 }, { expect = "705", data = "05" }': "begins with 05, the last was 7f",
    '{ emcy = "8130h" }': "no EMCY 8130h",
    '{ write = "1017h", value = 20 }, { silent = "705", for_ms = 50 }': "a frame 705h comes",
}
WRONG = {
    "point = 1": "expected tables [[point]]",
    "[[point]]\nname = 'a'": "point 1: expected a name and a list of steps",
    "[[point]]\nname = 'a'\nstep = []": "unknown key 'step'; did you mean steps?",
    "[[point]]\nname = 'a'\nneeds = ['luck']\nsteps = [{ wait_ms = 1 }]": "needs: expected some of",
    "[[point]]\nname = 'a'\nsteps = [{ reed = '1000h' }]": "step 1: expected a table with one of read",
    "[[point]]\nname = 'a'\nsteps = [{ read = '1000h', equal = 1 }]": "unknown key 'equal'; did you mean equals?",
    "[[point]]\nname = 'a'\nsteps = [{ read = 'speed' }]": "expected an object such as 2100h:01",
    "[[point]]\nname = 'a'\nsteps = [{ read = '1000h', equals = 'x' }]": "equals: expected a whole number",
    "[[point]]\nname = 'a'\nsteps = [{ write = '1017h' }]": "a value is missing",
    "[[point]]\nname = 'a'\nsteps = [{ nmt = 'go' }]": "expected one of start, stop",
    "[[point]]\nname = 'a'\nsteps = [{ send = '205' }]": "expected a frame such as 205#0102",
    "[[point": "expected TOML",
}


def points(tmp_path, text):
    path = tmp_path / "own.toml"
    path.write_text(text, encoding="utf-8")
    return read_points(path)


def test_steps_that_pass_are_put_back(tmp_path):
    device = eds_device()
    before = dict(device.node.dictionary.values)
    settings = ExaminationSettings(written=WriteList.parse("6065h"), ask=lambda question: "button" in question)
    report = device.run(settings, points(tmp_path, GOOD))
    assert failed(report) == {} and {row.verdict for row in report.rows} == {Verdict.PASS}
    assert [row.name for row in report.rows][:2] == ["201 identity", "202 heartbeat"]
    assert device.node.dictionary.values[0x606500] == before[0x606500]
    assert report.manual == ["press the button: done"]


def test_they_pass_the_same_gate_and_nobody_is_asked_who_is_not_there(tmp_path):
    report = eds_device().run(points=points(tmp_path, GOOD))
    verdicts = {row.name: row.verdict for row in report.rows}
    assert verdicts["203 window"] is verdicts["205 by hand"] is Verdict.NOT_APPLICABLE


@pytest.mark.parametrize("steps", FAILING)
def test_steps_that_fail(steps, tmp_path):
    report = eds_device().run(points=points(tmp_path, f"[[point]]\nname = 'a'\nsteps = [{steps}]"))
    assert FAILING[steps] in failed(report)["own 201 a"]


@pytest.mark.parametrize("text", WRONG)
def test_a_mistake_in_the_file_is_named(text, tmp_path):
    with pytest.raises(UsageError) as refused:
        points(tmp_path, text)
    assert WRONG[text] in str(refused.value) and "own.toml" in str(refused.value)
