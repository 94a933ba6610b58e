"""URDFs against Pinocchio: arms that we did not describe, all that is read of them; and what is refused."""

import re
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import Chain, forward, forward_jacobian
from canprobe.mechanics.robot.urdf import from_urdf
from canprobe.mechanics.robot.urdf_visuals import find_mesh, visuals_of, with_meshes_found

ARMS = {
    "panda": ("panda_description/urdf/panda.urdf", "panda_link0", "panda_hand_tcp", 7),
    "kinova": ("kinova_description/robots/kinova.urdf", "base", "j2s6s200_end_effector", 6),
    "so101": ("so_arm_description/urdf/so101.urdf", "base_link", "gripper_frame_link", 5),
    "tiago with its torso": ("tiago_description/robots/tiago.urdf", "base_footprint", "arm_tool_link", 8),
    "a piece of ur5": ("ur_description/urdf/ur5_robot.urdf", "upper_arm_link", "wrist_2_link", 3),
}
TOOL = np.array([[0.36, 0.48, -0.8, 0.01], [-0.8, 0.6, 0.0, -0.02], [0.48, 0.64, 0.6, 0.08], [0.0, 0.0, 0.0, 1.0]])


class Oracle:
    """An arm in Pinocchio: the joints between two links, the others locked at zero; a tool on its tip."""

    def __init__(self, pinocchio, path, names, tip):
        self.path, whole = path, pinocchio.buildModelFromUrdf(str(path))
        locked = [i for i, name in enumerate(whole.names) if i and name not in names]
        self.pin, self.model = pinocchio, pinocchio.buildReducedModel(whole, locked, pinocchio.neutral(whole))
        at = self.model.frames[self.model.getFrameId(tip, pinocchio.FrameType.BODY)]
        placement = at.placement * pinocchio.SE3(TOOL)
        self.tip = self.model.addFrame(
            pinocchio.Frame("tool", at.parentJoint, placement, pinocchio.FrameType.OP_FRAME), False
        )
        self.data, self.names = self.model.createData(), names

    def q(self, q):
        """Its own coordinates: continuous joints have cosine and sine, and its order of joints is its own."""
        v = np.zeros(self.model.nv)
        for name, value in zip(self.names, q, strict=True):
            v[self.column(name)] = value
        return self.pin.integrate(self.model, self.pin.neutral(self.model), v)

    def column(self, name):
        return self.model.joints[self.model.getJointId(name)].idx_v

    @property
    def columns(self):
        return [self.column(name) for name in self.names]

    def tool(self, q, base):
        """(4, 4) tool and (6, n) Jacobian of its origin, in the base link."""
        pin, q = self.pin, self.q(q)
        J = pin.computeFrameJacobian(self.model, self.data, q, self.tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        pin.framesForwardKinematics(self.model, self.data, q)
        T_base = self.data.oMf[self.model.getFrameId(base, pin.FrameType.BODY)].homogeneous
        turn = np.kron(np.eye(2), T_base[:3, :3].T)
        return np.linalg.inv(T_base) @ self.data.oMf[self.tip].homogeneous, turn @ J[:, self.columns]


@pytest.fixture(params=ARMS.values(), ids=ARMS)
def arm(request):
    """What we read, the oracle, and the base link."""
    pinocchio = pytest.importorskip("pinocchio")
    folder = Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"
    if not folder.is_dir():
        pytest.skip("example-robot-data is not installed beside pin")
    file, base, tip, n = request.param
    read = from_urdf(folder / file, base, tip)
    assert read.chain.n == n
    return read, Oracle(pinocchio, folder / file, read.chain.joints, tip), base


def test_poses_and_jacobians_are_those_of_pinocchio(arm):
    read, oracle, base = arm
    rng = np.random.default_rng(0)
    for q in rng.uniform(-3.0, 3.0, (20, read.chain.n)):
        T, J = forward_jacobian(read.chain, q, TOOL)
        T_there, J_there = oracle.tool(q, base)
        assert pytest.approx(T_there, abs=1e-9) == T
        assert pytest.approx(J_there, abs=1e-9) == J


def test_stops_speeds_and_friction_are_those_of_pinocchio(arm):
    read, oracle, _ = arm
    controllers = {j.get("name"): j.find("safety_controller") for j in ElementTree.parse(oracle.path).iterfind("joint")}
    for joint in read.joints:
        its, column = oracle.model.joints[oracle.model.getJointId(joint.name)], oracle.column(joint.name)
        assert joint.prismatic == its.shortname().startswith("JointModelP")
        if its.nq == its.nv:
            low, high = (
                limit[its.idx_q] for limit in (oracle.model.lowerPositionLimit, oracle.model.upperPositionLimit)
            )
            if (safety := controllers[joint.name]) is not None:  # which Pinocchio does not read
                soft = [float(safety.get(f"soft_{end}_limit", 0.0)) for end in ("lower", "upper")]
                low, high = (max(low, soft[0]), min(high, soft[1])) if any(soft) else (low, high)
            assert (joint.q_min, joint.q_max) == (low, high)
        else:
            assert joint.q_max == -joint.q_min == pytest.approx(2 * np.pi)
        assert joint.qd_max == oracle.model.velocityLimit[column]
        effort = oracle.model.effortLimit[column]
        assert joint.rated_torque == (effort if effort > 0.0 else 10.0)
        damping, friction = oracle.model.damping[column], oracle.model.friction[column]
        assert joint.viscous == (damping if damping > 0.0 else 0.3)
        assert joint.coulomb == (friction if friction > 0.0 else 0.5)


def test_bodies_make_the_mass_matrix_and_the_height_of_pinocchio(arm):
    read, oracle, base = arm
    if base == "upper_arm_link":
        return  # Pinocchio counts the joints below the base too
    rng, pin = np.random.default_rng(1), oracle.pin
    for q in rng.uniform(-3.0, 3.0, (3, read.chain.n)):
        mass = np.zeros((read.chain.n,) * 2)
        moments = np.zeros(read.chain.n)
        for k, body in enumerate(read.bodies, start=1):
            if body is None:
                continue
            part = Chain("part", read.chain.joints[:k], read.chain.prismatic[:k], read.chain.fixed[:k], np.eye(4))
            T_com = np.eye(4)
            T_com[:3, 3] = body.com
            T, J = forward_jacobian(part, q[:k], T_com)
            turning = T[:3, :3] @ body.tensor @ T[:3, :3].T
            mass[:k, :k] += body.mass * J[:3].T @ J[:3] + J[3:].T @ turning @ J[3:]
            moments[:k] += 9.81 * body.mass * J[2]
        there = pin.crba(oracle.model, oracle.data, oracle.q(q))
        there = np.triu(there) + np.triu(there, 1).T
        picked = np.ix_(oracle.columns, oracle.columns)
        assert mass == pytest.approx(there[picked], abs=1e-9)
        gravity = pin.computeGeneralizedGravity(oracle.model, oracle.data, oracle.q(q))
        assert moments == pytest.approx(gravity[oracle.columns], abs=1e-8)


# Without the oracle: what a small file means, and what is refused.

LIMIT = '<limit lower="-1" upper="2" velocity="3" effort="4"/>'


def joint(name, parent, child, kind="revolute", inside=LIMIT):
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def robot(*joints, links=None):
    links = links or sorted(set(re.findall(r'link="(.)"', "".join(joints)))) or "a"
    return f'<robot name="r">{"".join(f"""<link name="{x}"/>""" for x in links)}{"".join(joints)}</robot>'


def weighed(mass, diagonal):
    moments = " ".join(f'i{x}{x}="{value}"' for x, value in zip("xyz", diagonal.split(), strict=True))
    inertial = f'<inertial><mass value="{mass}"/><inertia {moments}/></inertial>'
    return PLAIN.replace('<link name="b"/>', f'<link name="b">{inertial}</link>')


def softened(low, high):
    soft = f'<safety_controller soft_lower_limit="{low}" soft_upper_limit="{high}"/>'
    return robot(joint("j", "a", "b", inside=LIMIT + soft))


PLAIN = robot(joint("j", "a", "b"))
NINE = robot(*(joint(f"j{a}", a, b) for a, b in pairwise("abcdefghij")))
BRANCHES = robot(joint("j", "a", "b"), *(joint(end, on, end, "fixed") for on, end in ("bc", "bd", "ae")))


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.replace("<robot ", '<robot xmlns="http://www.ros.org/wiki/urdf" '),
        PLAIN.replace("</robot>", "<gz:plugin a:b='1'/></robot>"),
        f'\n <?xml version="1.0"?>{PLAIN}',
        f'<!-- made by X -->\n<?xml version="1.0" encoding="utf-8"?>{PLAIN}',
        PLAIN.replace("</robot>", '<xacro:property name="w" value="${2}"/><xacro:macro name="m"/></robot>'),
        PLAIN.replace(LIMIT, LIMIT + '<safety_controller k_velocity="1"/>'),
        softened(-9, 9),
        weighed("0", "0 0 0"),
        weighed("1", "1 1 2.01"),
        weighed("1e-9", "-5e-20 -5e-20 0"),
    ],
    ids=["namespace", "prefixes", "blank", "comment", "xacro", "no soft", "wide soft", "no mass", "rounded", "nothing"],
)
def test_a_file_that_urdfdom_takes_is_read_alike(tmp_path, text):
    path = tmp_path / "r.urdf"
    path.write_text(text)
    for read in (from_urdf(path), from_urdf(text)):
        assert read.joints == from_urdf(PLAIN).joints and read.warnings == ()


def test_soft_limits_narrow_the_range():
    (found,) = from_urdf(softened(-0.5, 1.5)).joints
    assert (found.q_min, found.q_max) == (-0.5, 1.5)


def test_limits_that_look_like_degrees_are_warned_of():
    (warning,) = from_urdf(PLAIN.replace('upper="2"', 'upper="170"')).warnings
    assert "j: <limit> from -1 to 170 rad looks like degrees" in warning
    (warning,) = from_urdf(robot(joint("j", "a", "b", "prismatic", LIMIT.replace('"2"', '"170"')))).warnings
    assert "j: <limit> from -1 to 170 m looks like millimetres" in warning


def test_moments_that_no_body_has_are_warned_of_as_they_can_be_moved():
    (warning,) = from_urdf(weighed("1", "1 1 9")).warnings
    assert "link b, with what it carries: no body has principal moments of inertia of 1, 1, 9 kg m^2, of " in warning


def test_a_small_file_from_its_text():
    text = robot(
        joint("one", "a", "b", inside='<origin xyz="0 0 1"/><axis xyz="0 0 -2"/>' + LIMIT),
        joint("stiff", "b", "c", "fixed", '<origin rpy="0 0 1.5707963267948966"/>'),
        joint("two", "c", "d", "prismatic", '<axis xyz="0 1 0"/>' + LIMIT),
    )
    read = from_urdf(text, "a", "d", name="small")
    assert (read.chain.name, read.chain.joints, read.chain.prismatic) == ("small", ("one", "two"), (False, True))
    T = forward(read.chain, (np.pi / 2, 0.25))
    # turned by -90 about z, then the fixed +90: the slide along y of c is base y again
    assert T[:3, :3] == pytest.approx(np.eye(3), abs=1e-12)
    assert T[:3, 3] == pytest.approx((0.0, 0.25, 1.0), abs=1e-12)
    assert (read.joints[0].q_min, read.joints[0].q_max, read.joints[0].qd_max) == (-1.0, 2.0, 3.0)
    assert read.bodies == (None, None)


@pytest.mark.parametrize(
    ("text", "base", "tip", "message"),
    [
        ("<robot", "a", "b", "expected XML"),
        ("<sdf/>", "a", "b", "expected a <robot>, got <sdf>"),
        (PLAIN, "a", "x", "no link 'x'; it has a, b"),
        (PLAIN, "b", "a", "'a' does not hang on 'b', but on 'a'"),
        (robot(joint("j", "a", "b"), joint("k", "b", "a")), "a", "b", "got none: its joints make a loop"),
        (robot(joint("j", "a", "b"), joint("k", "c", "b")), "a", "b", "k: expected a child .* got 'b', as of j"),
        (robot(joint("j", "a", "b"), links="abc"), "a", "b", "one <link> that hangs on no other, got 2: a, c"),
        (robot(joint("j", "a", "b"), links="abb"), "a", "b", "link b: expected one <link> of this name, got two"),
        (robot(joint("j", "a", "b"), links="a"), "a", "b", "j: expected a link of the file in <child>, got 'b'"),
        (robot(joint("j", "x", "b"), links="ab"), "a", "b", "j: expected a link of the file in <parent>, got 'x'"),
        (PLAIN.replace('"-1"', '"3"'), "a", "b", "j: expected lower below upper in its <limit>, got 3 and 2"),
        (softened(3, 4), "a", "b", "j: expected soft limits in -1 to 2 in its <safety_controller>, got 3 and 4"),
        (weighed("-1", "1 1 1"), "a", "b", "link b: expected a value in <mass> that is not negative, got -1"),
        (weighed("1", "-1 1 9"), "a", "b", "link b, with.*principal moments of inertia of -1, 1, 9 .* negative"),
        (NINE, "a", "j", "9 joints move between 'a' and 'j', at most 8 can; .* --base b "),
        (BRANCHES, None, None, r"name the tip \(--tip LINK, or arm.tip\): one of c, d$"),
        (PLAIN.replace('"-1"', '"${-1}"'), "a", "b", "xacro; .*: pip install xacro; xacro arm"),
        (robot(joint("j", "a", "b", "fixed")), "a", "b", "no joint moves between 'a' and 'b'"),
        (robot(joint("j", "a", "b", "floating")), "a", "b", "j: expected revolute, .* got floating"),
        (robot(joint("j", "a", "b", inside='<mimic joint="k"/>' + LIMIT)), "a", "b", "got a mimic of k"),
        (robot(joint("j", "a", "b", inside="")), "a", "b", "j: expected a <limit>"),
        (robot(joint("j", "a", "b", inside='<axis xyz="0 0 0"/>' + LIMIT)), "a", "b", "axis that is not zero"),
        (robot(joint("j", "a", "b", inside='<axis xyz="0 0"/>' + LIMIT)), "a", "b", "three numbers in xyz of <axis>"),
        (robot(joint("j", "a", "b", inside='<limit lower="low"/>')), "a", "b", "a number in lower of <limit>"),
        (robot('<joint name="j" type="fixed"/>'), "a", "b", "j: expected <parent> and <child>"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro/></robot>', "a", "b", "it is a xacro"),
        ("/nowhere/arm.urdf", "a", "b", "URDF /nowhere/arm.urdf: cannot be read"),
    ],
)
def test_what_cannot_be_read_is_refused(text, base, tip, message):
    with pytest.raises(PlanError, match=message):
        from_urdf(text, base, tip)


def test_a_continuous_joint_has_a_turn_to_either_side():
    inside = '<limit velocity="3" effort="4"/>'
    read = from_urdf(robot(joint("j", "a", "b", "continuous", inside)), "a", "b")
    assert (read.joints[0].q_min, read.joints[0].q_max) == pytest.approx((-2 * np.pi, 2 * np.pi))


SHOWN = """<robot name="r"><material name="blue"><color rgba="0 0 1 1"/></material>
  <link name="a"><visual><geometry><mesh filename="package://lab/meshes/a.stl"/></geometry></visual>
    <visual><geometry><cylinder radius="0.1" length="0.4"/></geometry><material name="blue"/></visual></link>
  <link name="b"><visual><origin xyz="0 0 1"/><geometry><mesh filename='b %2F.obj' scale="1 1 -1"/></geometry>
    <material name="red"><color rgba="1 0 0 1"/></material></visual></link>
  <joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint></robot>"""


def test_what_links_look_like_and_where_their_meshes_are(tmp_path):
    urdf = tmp_path / "lab" / "urdf" / "r.urdf"
    for path in (urdf, tmp_path / "lab/meshes/a.stl", urdf.with_name("b %2F.obj")):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(SHOWN)
    stl, can, obj = visuals_of(urdf)
    assert [(v.joint, v.kind, v.size, v.colour) for v in (stl, can, obj)] == [
        (0, "mesh", (1.0, 1.0, 1.0), None),
        (0, "cylinder", (0.1, 0.4), (0, 0, 255)),
        (1, "mesh", (1.0, 1.0, -1.0), (255, 0, 0)),
    ]
    assert obj.T[2, 3] == 1.0
    assert find_mesh(urdf, stl.mesh) == tmp_path / "lab/meshes/a.stl"
    assert find_mesh(urdf, obj.mesh) == urdf.with_name("b %2F.obj")
    assert find_mesh(urdf, "package://lab/no.stl") is None and find_mesh(urdf, "http://lab/a.stl") is None
    copy = tmp_path / "elsewhere.urdf"
    copy.write_bytes(with_meshes_found(urdf))
    again = visuals_of(copy)
    assert [find_mesh(copy, v.mesh) for v in (again[0], again[2])] == [find_mesh(urdf, v.mesh) for v in (stl, obj)]
    assert with_meshes_found(copy) == copy.read_bytes()
    (tmp_path / "lab/meshes/a.stl").unlink()
    copy.write_text(SHOWN.replace("b %2F.obj", "no.obj"))
    assert with_meshes_found(copy) == copy.read_bytes(), "names of meshes that are missing stay"


def test_a_solid_without_its_numbers_is_refused():
    text = SHOWN.replace('length="0.4"', "")
    with pytest.raises(PlanError, match="link a: expected a number in length of <cylinder>, got None"):
        visuals_of(text)
