"""The judge of masters: every rule finds the master that has its fault, and no other rule does."""

from __future__ import annotations

import pytest
from scripted_masters import Master, bad_masters

from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.tools.judge import RULES, BusFrame, judge_frames

BAD = list(bad_masters())


def judged(master):
    nodes = {node_id: Description(load_eds("puma260_joint", node_id)) for node_id in master.nodes}
    frames = (BusFrame(*frame) for frame in master.run())
    return judge_frames(frames, nodes)


def numbers(judge):
    return tuple(rule.number for rule in judge.rules if rule.count)


def test_a_good_master_raises_no_rule():
    judge = judged(Master())
    assert [(rule.number, rule.findings[0].what) for rule in judge.rules if rule.count] == []


@pytest.mark.parametrize("master", BAD, ids=lambda master: f"{master.numbers[0]:02}-{master.__name__}")
def test_a_bad_master_raises_its_rule_alone(master):
    judge = judged(master())
    assert numbers(judge) == master.numbers, [rule.findings[0].what for rule in judge.rules if rule.count]
    (rule,) = (rule for rule in judge.rules if rule.count)
    assert rule.findings[0].frames, "the frames that show it"


def test_every_rule_has_a_bad_master():
    assert {number for master in BAD for number in master.numbers} == {rule.number for rule in RULES}
