"""A joint's stop that a touch would meet is refused by the plan, for arms of other people; one beyond is not."""

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


def scene_of(folder, urdf, kind):
    """A touch of an arm in a posture in which it moves well."""
    file, base, tip = next(arm for arm in ARMS if arm[0].endswith(urdf))
    (folder / urdf).write_bytes((robots() / file).read_bytes())
    arm = from_urdf(folder / urdf, base, tip)
    text = f'{HEAD}[arm]\nurdf = "{urdf}"\nbase = "{base}"\ntip = "{tip}"\n'
    q = draw_posture(Random(urdf), arm.chain, arm.joints)
    for node_id, (joint, start) in enumerate(zip(arm.joints, q.tolist(), strict=True), start=1):
        units = "kind = 'prismatic'\ncounts_per_m = 1e6" if joint.prismatic else "counts_per_turn = 4096\ngear = 100"
        start_key = f"start_{'mm' if joint.prismatic else 'deg'} = {joint.shown(start):.3f}"
        text += f"[joints.{toml_key(joint.name)}]\n{units}\n{start_key}\nnode_id = {node_id}\n"
    text += '[sensor]\narray = "inch16"\nnode_id = 16\n[probe]\ncentre_offset_mm = 80\n'
    path = folder / "scene.toml"
    path.write_text(text + _task_of(Random(3), kind, text, folder, 40.0))
    return load_scene(path)


def with_stop(scene, name, end, value):
    """The scene with one stop of a joint somewhere else, deg or mm."""
    joint = scene.joints[name]
    key = f"{end}_{'mm' if joint.kind == 'prismatic' else 'deg'}"
    return replace(scene, joints={**scene.joints, name: replace(joint, **{key: value})})


OTHERS = pytest.mark.slow(reason="the stops of other arms")


@pytest.mark.parametrize(
    ("urdf", "kind"),
    [
        ("ur5_robot.urdf", "scan"),
        pytest.param("panda.urdf", "scan", marks=OTHERS),
        pytest.param("xarm7.urdf", "scan", marks=OTHERS),
        pytest.param("xarm7.urdf", "calibrate", marks=OTHERS),
    ],
)
def test_a_stop_on_the_way_of_the_run_is_refused_and_one_beyond_it_is_not(tmp_path, urdf, kind):
    scene = scene_of(tmp_path, urdf, kind)
    run = canprobe.run(scene, bus="direct", files=False)
    model, limits = run.plan.setup.arm.model, run.plan.setup.limits
    columns = [run.log[key] for key in ("q_target_rad", "q_target_m", "q_target") if key in run.log]
    q = columns[0] if len(columns) == 1 else np.where(np.isfinite(columns[0]), columns[0], columns[1])
    q = q[np.isfinite(q).all(axis=1)]
    ways = np.ptp(q, axis=0) / model.radian
    i = int(np.argmax(ways))
    joint, step = model.joints[i], model.radian[i] * math.radians(1.0)
    for end, extreme, out in (("min", q[:, i].min(), -1.0), ("max", q[:, i].max(), 1.0)):
        if abs(extreme - q[0, i]) < 2.0 * step:
            continue  # it begins there
        stop = extreme + out * limits.joint_margin[i]
        with pytest.raises(PlanError, match=f"joint {i + 1} would move"):
            canprobe.plan(with_stop(scene, joint.name, end, joint.shown(stop - 0.1 * out * step)))
        canprobe.plan(with_stop(scene, joint.name, end, joint.shown(stop + 3.0 * out * step)))
