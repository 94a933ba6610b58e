"""The URDF of a cell's arm, read by Pinocchio and by our own reader, and held against the arm's own kinematics."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pinocchio
import pytest

import canprobe
from canprobe.lab.bridge.description import axis_transforms, link_transforms, robot_description

ARRAYS = Path(canprobe.__file__).parent / "arrays"
MESH = """<visual><geometry><mesh filename="arm.stl" scale="2 2 2"/></geometry></visual>
          <visual><geometry><mesh filename="absent.stl"/></geometry></visual>"""


@pytest.fixture(params=["puma260", "puma560", "gantry", "seven-axis", "prbt"])
def plan(request):
    return canprobe.plan(canprobe.load_scene("free", {"cell": request.param}))


def test_pinocchio_finds_every_frame_where_tf_has_it(plan):
    model = pinocchio.buildModelFromXML(robot_description(plan))
    data, arm = model.createData(), plan.setup.arm.model
    assert list(model.names)[1:] == list(arm.chain.joints)
    np.testing.assert_allclose(model.lowerPositionLimit, arm.q_min)
    np.testing.assert_allclose(model.upperPositionLimit, arm.q_max)
    np.testing.assert_allclose(model.velocityLimit, arm.qd_max)
    for q in np.random.default_rng(3).uniform(arm.q_min, arm.q_max, (5, arm.n)):
        pinocchio.framesForwardKinematics(model, data, q)
        T = np.eye(4)
        axes = {child: T for _, child, T in axis_transforms(arm.chain)}
        for i, (_, link, step) in enumerate(link_transforms(arm.chain, q), start=1):
            T = T @ step
            found = {name: data.oMf[model.getFrameId(name)].homogeneous for name in (link, f"axis_{i}")}
            np.testing.assert_allclose(found[link], T, atol=1e-9)
            np.testing.assert_allclose(found[f"axis_{i}"], T @ axes[f"axis_{i}"], atol=1e-9)
        np.testing.assert_allclose(data.oMf[model.getFrameId("flange")].homogeneous, T, atol=1e-9)


def test_an_arm_is_seen_and_ends_in_its_probe(plan, press_plan):
    assert len(ElementTree.fromstring(robot_description(plan)).findall("link/visual")) >= plan.setup.arm.model.n
    press = ElementTree.fromstring(robot_description(press_plan))
    assert float(press.find("link[@name='probe']/visual/geometry/sphere").get("radius")) == 0.04


def test_a_flat_array_is_drawn_on_the_probe_of_its_scene():
    changes = {"sensor.array": str(ARRAYS / "poweron6x6.toml"), "task.approach_mm_s": 3.0}
    flat = canprobe.plan("press", changes)
    assert flat.setup.array.pad.is_flat
    link = ElementTree.fromstring(robot_description(flat)).find("link[@name='probe']")
    assert float(link.find("visual/geometry/sphere").get("radius")) == 0.04


def test_meshes_of_a_urdf_are_named_by_absolute_paths_where_they_are_found(tmp_path):
    (tmp_path / "arm.stl").write_bytes(b"")
    (tmp_path / "arm.urdf").write_text(
        f"""<robot name="one"><link name="a"/><link name="b">{MESH}</link>
        <joint name="turn" type="revolute"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" velocity="1" effort="5"/></joint></robot>"""
    )
    (tmp_path / "cell.toml").write_text(
        """[cell]
        name = "one"
        [arm]
        urdf = "arm.urdf"
        eds = "puma260_joint.eds"
        [joints.turn]
        node_id = 1
        counts_per_turn = 4096
        gear = 100
        """
    )
    plan = canprobe.plan(canprobe.load_scene("free", {"cell": str(tmp_path / "cell.toml")}))
    (mesh,) = ElementTree.fromstring(robot_description(plan)).findall("link[@name='axis_1']/visual/geometry/mesh")
    assert mesh.attrib == {"filename": (tmp_path / "arm.stl").as_uri(), "scale": "2 2 2"}


def test_without_an_arm_there_is_none():
    assert robot_description(canprobe.plan(canprobe.load_scene("listen"))) is None
