"""A joint's stop that a touch would meet is refused by the plan, for an arm of other people; one beyond is not."""

from __future__ import annotations

import math
from dataclasses import replace
from random import Random

import numpy as np
import pytest

pytest.importorskip("pinocchio", reason="the URDFs come with pin")

from combinations import ARMS, _task_of, draw_posture, robots

import canprobe
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.toml_files import toml_key
from canprobe.errors import PlanError
from canprobe.mechanics.robot.urdf import from_urdf

HEAD = """
[scene]
name = "stops"
[outputs]
figures = false
[cell]
name = "arm"
[cycle]
rate_hz = 200
[bus]
interface = "direct"
"""


def scan_of_an_ur5(folder):
    """A scan by another arm, in a posture in which it moves well."""
    urdf = "ur5_robot.urdf"
    file, base, tip = next(arm for arm in ARMS if arm[0].endswith(urdf))
    (folder / urdf).write_bytes((robots() / file).read_bytes())
    arm = from_urdf(folder / urdf, base, tip)
    text = f'{HEAD}[arm]\nurdf = "{urdf}"\nbase = "{base}"\ntip = "{tip}"\n'
    q = draw_posture(Random(urdf), arm.chain, arm.joints)
    for node_id, (joint, start) in enumerate(zip(arm.joints, q.tolist(), strict=True), start=1):
        text += f"[joints.{toml_key(joint.name)}]\ncounts_per_turn = 4096\ngear = 100\n"
        text += f"start_deg = {joint.shown(start):.3f}\nnode_id = {node_id}\n"
    text += '[sensor]\narray = "inch16"\nnode_id = 16\n[probe]\ncentre_offset_mm = 80\n'
    path = folder / "scene.toml"
    path.write_text(text + _task_of(Random(3), "scan", text, folder, 40.0))
    return load_scene(path)


def with_stop(scene, name, end, value_deg):
    """The scene with one stop of a joint somewhere else."""
    joint = replace(scene.joints[name], **{f"{end}_deg": value_deg})
    return replace(scene, joints={**scene.joints, name: joint})


def test_a_stop_on_the_way_of_the_run_is_refused_and_one_beyond_it_is_not(tmp_path):
    scene = scan_of_an_ur5(tmp_path)
    run = canprobe.run(scene, bus="direct", files=False)
    model, limits = run.plan.setup.arm.model, run.plan.setup.limits
    q = run.log["q_target_rad"]
    q = q[np.isfinite(q).all(axis=1)]
    i = int(np.argmax(np.ptp(q, axis=0)))
    joint, step = model.joints[i], math.radians(1.0)
    for end, extreme, out in (("min", q[:, i].min(), -1.0), ("max", q[:, i].max(), 1.0)):
        if abs(extreme - q[0, i]) < 2.0 * step:
            continue  # it begins there
        stop = extreme + out * limits.joint_margin[i]
        with pytest.raises(PlanError, match=f"joint {i + 1} would move"):
            canprobe.plan(with_stop(scene, joint.name, end, joint.shown(stop - 0.1 * out * step)))
        canprobe.plan(with_stop(scene, joint.name, end, joint.shown(stop + 3.0 * out * step)))
