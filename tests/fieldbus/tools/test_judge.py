"""The judge of masters: every rule finds the master that has its fault, and no other rule does."""

from __future__ import annotations

import random

import pytest
from scripted_masters import MASTERS, DrivesMuteAxis, Master, MutePassedOver

from canprobe.fieldbus import Description, load_eds
from canprobe.fieldbus.tools.judge import RULES, BusFrame, Judge

GOOD = [master for master in (Master, *MASTERS) if master.number is None]
BAD = [master for master in MASTERS if master.number is not None]


def descriptions(*node_ids):
    return {node_id: Description(load_eds("puma260_joint", node_id)) for node_id in node_ids}


def judged(master):
    return Judge(descriptions(*master.nodes)).hear(BusFrame(*frame) for frame in master.run())


def found(judge):
    return {number: case.findings[0].what for number, case in judge.cases.items() if case.count}


@pytest.mark.parametrize("master", GOOD, ids=lambda master: master.__name__)
def test_a_good_master_raises_no_rule(master):
    assert found(judged(master())) == {}


@pytest.mark.parametrize("master", BAD, ids=lambda master: f"{master.number:02}-{master.__name__}")
def test_a_bad_master_raises_its_rule_alone(master):
    judge = judged(master())
    assert [*found(judge)] == [master.number], found(judge)
    (case,) = (case for case in judge.cases.values() if case.count)
    assert case.findings[0].frames, "the frames that show it"


def test_every_rule_has_a_bad_master():
    assert {master.number for master in BAD} == {rule.number for rule in RULES if rule.group != "motor"}


@pytest.mark.parametrize(("master", "number", "judged_times"), [(DrivesMuteAxis, 46, 0), (MutePassedOver, 46, 1)])
def test_a_mute_axis_that_is_alone_has_no_others_to_stop(master, number, judged_times):
    assert judged(master()).cases[number].looked == judged_times


@pytest.mark.parametrize("seed", range(3))
def test_any_frames_are_judged_without_an_error(seed):
    """Frames of a master, of which some are cut, changed, lost or come twice, and others that mean nothing."""
    rng = random.Random(seed)
    frames = []
    for t_ns, can_id, sent, _ in random.Random(seed).choice(GOOD)().run():
        others = (sent[: rng.randrange(9)], rng.randbytes(rng.randrange(9)), sent + b"\xff" * 3)
        data = rng.choice(others) if rng.random() < 0.1 else sent
        frames += [(t_ns, can_id, data)] * rng.choices((0, 1, 2), (1, 30, 1))[0]
        if rng.random() < 0.2:
            known = rng.choice((0, 0x80, 0x81, 0x100, 0x181, 0x201, 0x581, 0x601, 0x701, 0x77F, 0x7E5))
            other = rng.choice((known, rng.randrange(0x800), known | 0x40000000, rng.randrange(1 << 29) | 0x80000000))
            frames.append((t_ns, other, rng.randbytes(rng.choice((0, 1, 2, 6, 7, 8)))))
    judge = Judge(descriptions(1, 2)).hear(BusFrame(*frame) for frame in frames)
    assert judge.frame_count == len(frames)
    judge.report("", {})
