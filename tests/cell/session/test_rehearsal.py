"""What runs before a run in real time: everything that a cycle does, in few cycles."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest

import canprobe
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session, rehearse, run_beginning, shortened
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.fieldbus.eds.packaged import eds_path

MOST_CYCLES = 1200


@pytest.mark.parametrize("name", ["press", "calibrate", "free", "listen"])
def test_a_scene_is_done_in_few_cycles(name):
    with Session(shortened(load_scene(name, {"cycle.rate_hz": 200.0}))) as session:
        session.run(make_task(session.plan))
    assert len(session.cell.log) < MOST_CYCLES


def test_a_scan_is_felt_estimated_and_left():
    answers = []
    with Session(shortened(load_scene("cylinder", {"cycle.rate_hz": 200.0}))) as session:
        task = make_task(session.plan)

        def step(measurement):
            command = task.step(measurement)
            answers.append(command.estimate is not None)
            return command

        session.run(step)
    assert sum(answers) >= 3 and len(session.cell.log) < MOST_CYCLES
    phases = set(session.cell.log.arrays()["phase"].tolist())
    assert {Phase.APPROACH, Phase.SETTLE, Phase.SCAN, Phase.RETREAT} <= phases


def test_a_shorter_scene_stays_as_short():
    scene = load_scene("press", {"cycle.rate_hz": 200.0})
    short = replace(scene, task=replace(scene.task, duration_s=0.01, clearance_mm=0.1, touches=2))
    assert shortened(short).task == short.task


def test_what_goes_wrong_in_it_is_of_no_interest():
    scene = load_scene("press", {"cycle.rate_hz": 200.0})
    rehearse(canprobe.plan(replace(scene, limits=replace(scene.limits, force_max_n=2.1))))


def test_real_nodes_are_emulated_in_it():
    scene = load_scene("press", {"cycle.rate_hz": 200.0})
    plan = canprobe.plan(
        replace(scene, arm=replace(scene.arm, emulated=False), bus=replace(scene.bus, interface="socketcan"))
    )
    with Session(replace(plan, setup=resolve(shortened(plan.scene)))) as session:
        session.run(make_task(session.plan))
    assert session.opened and not session.cell.notes.lines()


def test_joints_keep_within_their_drives_in_it_as_in_the_plan(tmp_path):
    text = eds_path("puma260_joint").read_text()
    head, mark, rest = text.partition("[607F]")
    section, end, tail = rest.partition("\n[")
    section = re.sub("AccessType=.*", "AccessType=ro", re.sub("DefaultValue=.*", "DefaultValue=2000", section))
    (tmp_path / "slow.eds").write_text(head + mark + section + end + tail)
    scene = load_scene("press", {"cycle.rate_hz": 200.0})
    plan = canprobe.plan(replace(scene, arm=replace(scene.arm, eds=str(tmp_path / "slow.eds"))))
    assert "607Fh: drives that fault below the speeds of their joints" in plan.warnings[0]
    session = run_beginning(plan)
    assert session.plan.setup.arm.model.qd_max.tolist() == plan.setup.arm.model.qd_max.tolist()
    assert not session.cell.notes.lines()
