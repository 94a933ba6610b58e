"""A second plant, whose arm and contact are MuJoCo's: a Panda with a ball at its flange, and an object.

    python tests/support/mujoco_cell.py     # the table of docs/external-arm.md

The arm is the Franka Panda of gymnasium-robotics (after github.com/vikashplus/franka), without its hand; geometry,
masses, actuators and damping are that file's. The contact is MuJoCo's soft contact of two bodies, with friction. Of
canprobe's plant one thing remains, the sensor: the pressure on the taxels at MuJoCo's depth, point and normal. The
object's curvature there, which the sensor needs and a contact of two points does not have, is that of the scene.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import canprobe
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.model import Plan
from canprobe.cell.plant.contact import PlantState, ProbeState, SolvedContact
from canprobe.cell.plant.elastic_contact import NO_CONTACT, Indentation, depth_for_force
from canprobe.cell.plant.pressure import pad_coordinates
from canprobe.cell.results.open_cell import OpenCell
from canprobe.cell.scene.setup import Touch
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.fieldbus.bus.port import Port
from canprobe.lab.studies.region_scores import scores_of
from canprobe.lab.studies.result import CHI2_95_OF_3
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.flange import flange_joints, flange_pose
from canprobe.mechanics.robot.model import joints_to_units
from canprobe.mechanics.touch.objects import Cylinder, Sphere
from canprobe.mechanics.touch.shapes import Nearest, PlacedShape
from canprobe.mechanics.types import Floats

Q_START = np.array((0.0, 0.2, 0.0, -2.2, 0.0, 0.83, 0.785))
FLANGE_M = (0.0, 0.0, 0.107)
"""Place of the flange behind the last joint, after Franka's data sheet."""
STIFFER = 16.0
"""Gain of the joints over that of the file, whose arm gives way by 0.6 mm/N at the flange and lags by 0.1 s."""
IMPEDANCE = 0.05
"""MuJoCo's d of the contact at the working depth. A soft constraint resists acceleration as `d / (1 - d)` of the mass
of the bodies does, which no layer of rubber has: a small d makes that small."""


@dataclass(frozen=True)
class Layer:
    """How MuJoCo's contact is to be near one depth: force and exponent are those of the elastic layer there.

    Attributes:
        force_n, depth_m: a working point of the layer.
        damping_n_s_m: force by the speed of indentation.
        friction: coefficient between probe and object.
    """

    force_n: float
    depth_m: float
    damping_n_s_m: float = 20.0
    friction: float = 0.2

    def solver(self, inverse_mass: float) -> tuple[list[float], list[float]]:
        """MuJoCo's solref and solimp for bodies whose inverse masses have this sum, 1/kg.

        At rest MuJoCo's normal force is `k r d / ((1 - d) m⁻¹)` at a depth r, where `k = -solref[0] d / dmax²` and the
        impedance d grows with r by solimp (Computation, "Solver parameters"). A linear d(r) whose slope is
        `d / r / (2 + d / (1 - d))` makes force grow by the square of depth at the working point, as the layer's does.
        """
        rise = 1.0 / (2.0 / IMPEDANCE + 1.0 / (1.0 - IMPEDANCE))
        width = 2.5
        d_min, d_max = IMPEDANCE - rise, IMPEDANCE - rise + width * rise
        mass = IMPEDANCE / ((1.0 - IMPEDANCE) * inverse_mass)
        stiffness = self.force_n / self.depth_m / mass * d_max**2 / IMPEDANCE
        return [-stiffness, -self.damping_n_s_m / mass * d_max], [d_min, d_max, width * self.depth_m, 0.5, 1.0]


def panda(
    layer: Layer, T_flange_probe: Floats, radius_m: float, geom: dict[str, Any], *, timestep_s: float = 1e-3
) -> mujoco.MjModel:
    """The cell's model.

    Args:
        layer: the contact.
        T_flange_probe: (4, 4) centre of the ball on the flange, m.
        radius_m: radius of the ball.
        geom: the object, as keywords of MuJoCo's `add_geom`.
        timestep_s: step of the simulation.
    """
    found = find_spec("gymnasium_robotics")
    assert found is not None and found.submodule_search_locations is not None
    folder = Path(found.submodule_search_locations[0], "envs", "assets", "kitchen_franka", "franka_assets")
    names = "assets.xml", "actuator.xml", "chain.xml"
    spec = mujoco.MjSpec.from_string(
        '<mujoco><include file="assets.xml"/><include file="actuator.xml"/>'
        '<worldbody><include file="chain.xml"/></worldbody></mujoco>',
        include={name: (folder / name).read_bytes() for name in names},
    )
    spec.meshdir = str(folder / "meshes")
    spec.option.timestep, spec.option.cone = timestep_s, mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    last = spec.body("panda0_link7")
    for finger in list(last.bodies):
        spec.delete(finger)
    for hand in [one for one in last.geoms if one.meshname.startswith("hand")]:
        spec.delete(hand)
    for actuator in [one for one in spec.actuators if "finger" in one.name]:
        spec.delete(actuator)
    for part in spec.geoms:
        part.contype = part.conaffinity = 0
    last.add_site(name="flange", pos=FLANGE_M)
    probe = last.add_body(name="probe", pos=np.add(FLANGE_M, T_flange_probe[:3, 3]).tolist())
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(T_flange_probe[:3, :3]).ravel())
    probe.quat = quat.tolist()
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    ball = probe.add_geom(name="ball", type=sphere, size=[radius_m, 0.0, 0.0], mass=0.3, contype=1, conaffinity=1)
    ball.priority, ball.condim, ball.friction = 1, 3, [layer.friction, 0.005, 0.0001]
    spec.worldbody.add_geom(name="object", contype=1, conaffinity=1, **geom)
    light = spec.compile()
    ball.solref, ball.solimp = layer.solver(float(light.body_invweight0[light.body("probe").id, 0]))
    model = spec.compile()
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    model.actuator_gainprm[:, 0] *= STIFFER
    model.actuator_biasprm[:, 1] *= STIFFER
    model.actuator_biasprm[:, 2] = -math.sqrt(STIFFER) * model.dof_damping[dofs]
    model.dof_damping[dofs] = 0.0  # that of the file is its servos', which would have to push against it
    return model


@dataclass(frozen=True)
class Felt:
    """The contact of ball and object in the last step, SI, frame of the simulation."""

    depth_m: float
    force_n: float
    friction_n: float
    point: Floats  # on the object
    normal: Floats  # outward of the object


def felt(model: mujoco.MjModel, data: mujoco.MjData) -> Felt | None:
    """MuJoCo's contact of ball and object; None without one."""
    ball = model.geom("ball").id
    for i, contact in enumerate(data.contact[: data.ncon]):
        if ball not in contact.geom or contact.dist >= 0.0:
            continue
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, i, wrench)
        normal = np.array(contact.frame[:3]) * (1.0 if contact.geom[1] == ball else -1.0)
        point = np.array(contact.pos) - 0.5 * contact.dist * normal  # MuJoCo's lies half-way into the object
        return Felt(-contact.dist, wrench[0], float(np.hypot(*wrench[1:3])), point, normal)
    return None


def geom_of(shape: PlacedShape, T_world_base: Floats) -> dict[str, Any]:
    """A scene's sphere or cylinder as keywords of `add_geom`, at its place in the simulation."""
    assert isinstance(shape, Sphere | Cylinder)
    T = T_world_base @ shape.T_base_object
    centre = T[:3, 3] - shape.radius * T[:3, 2]
    if isinstance(shape, Sphere):
        return {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [shape.radius, 0.0, 0.0], "pos": centre.tolist()}
    ends = np.concatenate((centre - 0.15 * T[:3, 0], centre + 0.15 * T[:3, 0]))
    return {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [shape.radius, 0.0, 0.0], "fromto": ends.tolist()}


class MujocoCell:
    """An arm in MuJoCo for a plan, and its contact for the plan's emulated array.

    Args:
        plan: plan of a cell with an external arm and a sphere or a cylinder.
        arm_type: `MujocoArm` of docs/example.
        friction: of the contact, which is otherwise as stiff as the scene's layer at the scene's force.

    Attributes:
        arm: the arm, to be given to the cell.
        now_ns: time of the cell, once its port is known.
    """

    def __init__(self, plan: Plan, arm_type: Any, friction: float = Layer.friction) -> None:
        setup = plan.setup
        arm, task, shape, stiffness = setup.needed_arm(), setup.task, setup.truth.object, setup.truth.stiffness
        assert isinstance(task, Touch) and shape is not None
        self._model, self._shape, self._radius = arm.model, shape, setup.probe.radius
        start = flange_pose(arm.model, arm.q_start)
        self._T_base_world = forward(arm.model.chain, arm.q_start) @ np.linalg.inv(start)
        near = shape.closest(shape.T_base_object[:3, 3])
        depth = depth_for_force(task.force, (float(near.kappa[0]), float(near.kappa[1])), self._radius, stiffness)
        layer = Layer(task.force, depth, friction=friction)
        geom = geom_of(shape, np.linalg.inv(self._T_base_world))
        self.simulated = panda(layer, setup.truth.T_flange_probe, self._radius, geom)
        self.now_ns: Callable[[], int] = lambda: 0
        self.arm = arm_type(self.simulated, "flange", lambda: self.now_ns(), Q_START)  # noqa: PLW0108 - another one later
        self.arm.place(start)
        self._probe = self.simulated.body("probe").id

    def stand_in(self, session: Session) -> None:
        """Take the place of the arm and the contact in the plant of a session, by the time of its bus."""

        def around(port: Port) -> Port:
            self.now_ns = port.clock.now_ns
            return port

        session.around, plant = around, session.buses.world.plant
        plant.arm = self  # type: ignore[assignment]
        plant.motor_counts = lambda axis: self.motors()[0][axis]
        plant._solver = self  # type: ignore[assignment]

    def advance(self, t_ns: int) -> None:
        """Move the simulation on to the cell's time."""
        self.arm.advance(self.now_ns())

    def motors(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Coordinates of the flange now, in counts; rates are not looked at."""
        counts = joints_to_units(self._model, flange_joints(self._model, self.arm.read()[0]))
        return tuple(counts.tolist()), (0.0,) * len(counts)

    def solve(self, state: PlantState, first_image_s: float | None) -> SolvedContact:
        """The contact now, as the plant's own solver gives it; states of the past are not known any more."""
        T, data = self._T_base_world, self.arm.data
        q = tuple(flange_joints(self._model, self.arm.read()[0]).tolist())
        axes = T[:3, :3] @ data.xmat[self._probe].reshape(3, 3)
        centre = T[:3, :3] @ data.xpos[self._probe] + T[:3, 3]
        probe = ProbeState(tuple(centre.tolist()), tuple(map(tuple, axes.T.tolist())), (0.0, 0.0, 0.0))
        found, near = felt(self.simulated, data), self._shape.nearest(probe.centre)
        contact, depth = NO_CONTACT, self._radius - near.distance
        if found is not None:
            point, normal = T[:3, :3] @ found.point + T[:3, 3], T[:3, :3] @ found.normal
            contact, depth = Indentation(found.force_n), found.depth_m
            there = tuple(point.tolist()), tuple(normal.tolist())
            near = Nearest(*there, self._radius - depth, near.kappa, near.directions)
        x, y, z = (-np.array(near.normal) @ axes).tolist()
        push = tuple((contact.force * np.array(near.normal)).tolist())
        uv = pad_coordinates((x, y, z), self._radius)
        return SolvedContact(q, probe, near, depth, 0.0, contact, uv, (x, y, z), push)


@dataclass(frozen=True)
class Scan:
    """Figures of a scan, against the plant that it ran on.

    Attributes:
        completed: it ended by itself.
        force_error, force_highest: error of the true force, RMS over the scan, and the highest one, shares of the goal.
        reading_bias, reading_error: what the array read less the true force, mean and RMS, shares of the goal.
        contact_fraction: share of the scan in contact.
        kappa_per_m: mean estimated curvatures.
        kappa_error_per_m, stated_per_m: RMS error of the answers in the loop, and what they state (Frobenius).
        held: share of the answers whose stated region of 95 % holds the true curvature.
        depth_m: mean depth.
    """

    completed: bool
    force_error: float
    force_highest: float
    reading_bias: float
    reading_error: float
    contact_fraction: float
    kappa_per_m: list[float]
    kappa_error_per_m: float
    stated_per_m: float
    held: float
    depth_m: float


PLACE = {"cell": "external", "arm.mount_mm": [-620, -122.5, 0], "arm.start_mm": [500, 0, 504], "shape.also": []}
"""The cell of an external arm, whose base frame is where a Panda reaches the object well."""


def scan(name: str, arm_type: Any = None, *, friction: float = Layer.friction, **keys: Any) -> Scan:
    """Scan the object of a packaged scene.

    Args:
        name: name of the scene.
        arm_type: `MujocoArm` of docs/example; None: on canprobe's own plant, with its emulated external arm.
        friction: of MuJoCo's contact.
        **keys: keys of the scene, with two underscores for a dot.
    """
    plan = canprobe.plan(name, PLACE | {key.replace("__", "."): value for key, value in keys.items()})
    task: Any = make_task(plan)
    simulated = MujocoCell(plan, arm_type, friction) if arm_type is not None else None
    cell = OpenCell(plan, RunOptions(arm=None if simulated is None else simulated.arm), task=task)
    if simulated is not None:
        simulated.stand_in(cell.session)
    with cell:
        result = cell.run(task)
    summary, session = result.summary, cell.session
    contact, goal = summary["contact"], summary["contact"]["force_target_n"]
    answers = [row for row in scores_of(session, task.shape.records)[0] if row]
    _, errors, stated, squares, _ = np.array(answers).T
    first, last = task.record().scan_cycles
    return Scan(
        summary["completed"],
        contact["force_rms_error_n"] / goal,
        contact["force_max_n"] / goal,
        contact["force_true_bias_n"] / goal,
        contact["force_true_rms_error_n"] / goal,
        contact["contact_fraction"],
        summary["shape"]["kappa_est_per_m"],
        math.sqrt(errors.mean()),
        math.sqrt(stated.mean()),
        float(np.mean(squares < CHI2_95_OF_3)),
        float(session.buses.truth["depth_m"][first:last].mean()),
    )


SCAN_S = 3.0
"""Length of a scan of tests and of the table, s: 75 mm of path, of which the last 55 are scored."""
HEADINGS = (
    *("object", "plant", "force off by (RMS)", "highest", "reading less true force (mean, RMS)"),
    *("curvature, 1/m", "off by (RMS)", "stated", "regions that hold it"),
)


def main(*names: str) -> None:
    """Print a table of scans on both plants."""
    from mujoco_arm import MujocoArm

    print("| " + " | ".join(HEADINGS) + " |\n|" + " --- |" * len(HEADINGS))
    plants = ("canprobe's", {}), ("MuJoCo's", {"arm_type": MujocoArm})
    rubbing = "MuJoCo's, friction 0.5", {"arm_type": MujocoArm, "friction": 0.5}
    for name in names:
        for plant, given in (*plants, rubbing):
            found = scan(name, **given, task__duration_s=SCAN_S)
            first, second = found.kappa_per_m
            cells = (
                *(name, plant, f"{found.force_error:.1%}", f"{found.force_highest:.0%}"),
                *(f"{found.reading_bias:+.1%}, {found.reading_error:.1%}", f"{first:.2f}, {second:.2f}"),
                *(f"{found.kappa_error_per_m:.2f}", f"{found.stated_per_m:.2f}", f"{found.held:.0%}"),
            )
            print("| " + " | ".join(cells).replace("%", " %") + " |", flush=True)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[2] / "docs" / "example" / "arm"))
    main(*(sys.argv[1:] or ("sphere", "cylinder")))
