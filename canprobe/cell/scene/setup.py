"""The setup of a cell: a scene in SI units, whole, with exactly what its task needs.

`canprobe.cell.scene.resolve.resolve` makes it from a `Scene`, the user's words and units; behind it nobody reads a
millimetre or a degree. Planning, cell, tasks and emulator read a `Setup`, or the `Plan` that carries one. Hardware
stands beside the task because planning, bring-up and emulator do not ask what is done; a task holds the same objects
again, so that it has no optional part (`setup.task.arm is setup.arm`). What a scene leaves to the plan says "auto"
until `make_plan` has closed it.

Lengths are in m, angles in rad, forces in N, pressures in Pa, times in s unless a name says otherwise. Sections of a
scene whose values are SI already (`[bus]`, `[bring_up]`, `[bridge]`) are taken over as they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from canprobe.cell.scene.hardware import Auto
from canprobe.cell.scene.model import (
    BridgeSettings,
    BringUpSettings,
    BusSettings,
    Fidelity,
    Scene,
    ShapeMethod,
    TactileModeName,
    TaskKind,
)
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.raw_image import ImageFormat
from canprobe.mechanics.robot.model import ArmModel, Body
from canprobe.mechanics.robot.tool_calibration import BallApproach
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.patch.array_calibration import NO_FORCE_REFERENCE, ArrayCalibration
from canprobe.mechanics.touch.servo import SurfaceGains
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.touch.strategies import Strategy
from canprobe.mechanics.types import Floats


@dataclass(frozen=True, slots=True)
class Node:
    """What every node has.

    Attributes:
        node_id: 1–126, on all buses together.
        channel: of its bus.
        eds: name or path of its EDS.
        emulated: served by the emulator.
        serial: what 1018h:04 must answer; None: anything.
    """

    node_id: int
    channel: str
    eds: str
    emulated: bool
    serial: int | None


@dataclass(frozen=True, slots=True)
class HomingParameters:
    """How a drive that does not know its zero after power on finds it. Units are rad or m, and s.

    Attributes:
        method: of CiA 402, 6098h.
        order: lower numbers are homed first.
        home: position of the joint at its home position.
        speed: of the search for the switch.
        zero_speed: of the search for its edge or the index pulse.
        acceleration: in homing.
        timeout_s: longest time that it may take.
    """

    method: int
    order: int
    home: float
    speed: float
    zero_speed: float
    acceleration: float
    timeout_s: float


@dataclass(frozen=True, slots=True)
class Drive(Node):
    """One joint drive.

    Attributes:
        zero: how it is homed; None: its encoder is absolute.
        turn_units: position units of a motor turn; None: of a prismatic joint.
        metre_units: position units of a metre; None: of a revolute joint.
        gear: turns of the motor per turn of the joint.
        quirks: of an emulated one; None: it has none.
    """

    zero: HomingParameters | None = None
    turn_units: float | None = None
    metre_units: float | None = None
    gear: float = 1.0
    quirks: Quirks | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """The arm: its chain, and a drive for each of its n joints.

    Attributes:
        model: geometry, limits and motor counts.
        drives: one a joint, from the base.
        q_start: (n,) rad; selects the branch of the inverse kinematics, and is where an emulated arm stands.
        missed_syncs: SYNC periods without a sign of life after which drive and master take each other for dead.
        grouped: two targets share an RPDO through dummy mapping.
        torque: the drives send their torque where they can; the plan gives it up where the bus has no room for it.
        warnings: what its URDF says and hardly means.
    """

    model: ArmModel
    drives: tuple[Drive, ...]
    q_start: Floats
    missed_syncs: int
    grouped: bool | Auto
    torque: bool = True
    warnings: tuple[str, ...] = ()

    @property
    def node_ids(self) -> tuple[int, ...]:
        """Of the drives, joint by joint."""
        return tuple(drive.node_id for drive in self.drives)


@dataclass(frozen=True, slots=True, eq=False)
class RawWire:
    """A device of raw frames, which knows no CANopen.

    Attributes:
        image: how its images lie in frames.
        normal: which of a taxel's values is the normal pressure, from 0.
        unloaded, full_scale: that value without load, and at the pad's full scale; it may fall with pressure.
        tare_images: at the beginning whose mean is the unloaded value of each taxel; 0: `unloaded` is.
        sampling: what an image begins with.
        start, stop: frames that start and stop the device.
        poll: frames that ask for one image.
        latency_s, latency_sigma_s: from the sample to the first frame, as stated, and its standard deviation.
        found_s, found_sigma_s: what a calibration has found beyond that, and its standard deviation.
    """

    image: ImageFormat
    normal: int
    unloaded: int
    full_scale: int
    tare_images: int
    sampling: Literal["free", "polled", "sync"]
    start: tuple[Frame, ...]
    stop: tuple[Frame, ...]
    poll: tuple[Frame, ...]
    latency_s: float
    latency_sigma_s: float
    found_s: float = 0.0
    found_sigma_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Array(Node):
    """The tactile array. What makes a node of it counts only without a `raw` wire.

    Attributes:
        name: of its file.
        mode: what it sends.
        window: taxels along the window that follows the contact.
        rate_hz: of its images.
        pad: its taxels.
        calibration: of the array, with the stiffness of the layer that `Probe` has.
        calibrated: it was stated, or the array is the emulated one; else the array is real and nobody calibrated it.
        raw: what it sends where it is no CANopen node; None: it is one.
    """

    name: str
    mode: TactileModeName
    window: int | Auto
    rate_hz: float
    pad: Pad
    calibration: ArrayCalibration
    calibrated: bool = True
    raw: RawWire | None = None

    @property
    def full_scale(self) -> float:
        """Pressure of a full count, Pa."""
        return self.pad.full_scale_pa

    @property
    def newtons(self) -> str:
        """What the array's newtons are, in words."""
        return self.calibration.newtons if self.calibrated else NO_FORCE_REFERENCE


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """The sphere that carries the array, with its elastic layer.

    Attributes:
        T_flange_probe: (4, 4) of its centre on the flange; z is the pole.
        radius: m.
        stiffness: K/h of the layer, N/m³.
        mass: kg.
    """

    T_flange_probe: Floats
    radius: float
    stiffness: float
    mass: float


@dataclass(frozen=True, slots=True, eq=False)
class SafetyLimits:
    """Where the cell is stopped.

    Attributes:
        force_max: N.
        preload_max: N before the run, which the array's tare takes for zero.
        joint_margin: (n,) kept from the stops of each joint, rad or m; empty without an arm.
        speed_share: of the joints' speed limits.
        late_share: of the last second's cycles, late by half a period.
        workspace: box (2, 3) of the probe's tip in base, m; an open side is infinite; None without any.
    """

    force_max: float
    preload_max: float
    joint_margin: Floats
    speed_share: float
    late_share: float
    workspace: Floats | None


@dataclass(frozen=True, slots=True)
class Shape:
    """The surface estimator.

    Attributes:
        method: in the loop.
        also: methods on the same data afterwards.
        memory: of path, m, whatever the time.
        every_s: between two answers; every sample is taken in.
        patch: complete what the path leaves open by the second moments of the images.
    """

    method: ShapeMethod
    also: tuple[ShapeMethod, ...]
    memory: float
    every_s: float
    patch: bool


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """The way to the first contact.

    Attributes:
        start: expected contact point (3,), base frame, approached along −normal.
        axes: (3, 3) rows heading, across, approach normal (outward); base frame, right-handed.
        speed: m/s.
        clearance: of the probe's surface from `start` before it, m.
        search: beyond `start` where it gives up, m.
    """

    start: Floats
    axes: Floats
    speed: float
    clearance: float
    search: float

    @property
    def normal(self) -> Floats:
        """Outward unit normal that it expects, (3,)."""
        normal: Floats = self.axes[2]
        return normal


@dataclass(frozen=True, slots=True)
class Scan:
    """The path of a scan.

    Attributes:
        strategy: closed curve in the scan plane.
        name: of the strategy.
        speed: of the contact, m/s.
        rolling_share: 0: the pad follows the normal, 1: it keeps its orientation.
        regain: towards the object where contact is lost, m; 0: give up.
    """

    strategy: Strategy
    name: str
    speed: float
    rolling_share: float
    regain: float


@dataclass(frozen=True, slots=True, eq=False)
class Touching:
    """What every task has that touches an object.

    Attributes:
        force: target, N.
        duration_s: of the scan, or of the hold; of a calibration what the plan reckons with.
        lag_s: of the drives behind a ramp.
    """

    arm: Arm
    array: Array
    probe: Probe
    approach: Approach
    force: float
    duration_s: float
    lag_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Touch(Touching):
    """Approach, touch, and follow the surface; without a scan hold the force.

    Attributes:
        gains: of the servo's surface.
        shape: the estimator; None where no shape is estimated.
    """

    gains: SurfaceGains
    scan: Scan | None
    shape: Shape | None


@dataclass(frozen=True, slots=True, eq=False)
class Calibrate(Touching):
    """Touch a ball of known radius from several sides to find the probe's centre on the flange.

    Attributes:
        ball_centre: expected (3,), base frame.
        ball_radius: m.
        ball_sigma: of the expected centre per axis, m.
        approaches: the touches in their order.
    """

    ball_centre: Floats
    ball_radius: float
    ball_sigma: float
    approaches: Sequence[BallApproach]


@dataclass(frozen=True, slots=True, eq=False)
class Listen:
    """Read the array only."""

    array: Array
    probe: Probe
    duration_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Free:
    """Swing the joints about `arm.q_start` without a sensor.

    Attributes:
        swing: amplitude of each joint (n,), rad.
        period_s: of the swing.
    """

    arm: Arm
    swing: Floats
    period_s: float
    duration_s: float


Task = Touch | Calibrate | Listen | Free


@dataclass(frozen=True, slots=True)
class Dynamics:
    """A dynamic arm beyond its geometry.

    Attributes:
        payload: mass of the probe, kg.
        friction: Coulomb coefficient between probe and object.
        integral_s: reset time of the velocity loops; 0: none.
        velocity_feed_forward: share of the reference's speed that the drives add.
        torque_limit_permille: of the continuous torque.
        integrator: a key of the plant's integrators.
        step_ns: its longest step.
        hold_ns: how long mass matrix, bias and contact geometry are held.
    """

    payload: float = 0.3
    friction: float = 0.3
    integral_s: float = 0.02
    velocity_feed_forward: float = 0.0
    torque_limit_permille: int = 2000
    integrator: str = "rosenbrock"
    step_ns: int = 625_000
    hold_ns: int = 2_500_000


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is really there: for the emulator, the check of the motion and the scores. The controller never sees it.

    Attributes:
        object: None where nothing can be touched.
        model: the arm; None without one.
        T_flange_probe: (4, 4) of the probe's centre.
        stiffness: K/h of its layer, N/m³.
        damping: Hunt–Crossley α, s/m.
        bandwidth_hz: −3 dB of every drive.
        fidelity: of the plant.
        dynamics: of a dynamic arm.
        without: effects of the array that are switched off.
        adc_bits: of the array.
        bodies: (n,) of the joints, without the probe; None where nobody knows them, which refuses "dynamic".
        compliance: (n,) of the joints between motor and link, rad/(N m) or m/N; None: all are rigid.
    """

    object: PlacedShape | None
    model: ArmModel | None
    T_flange_probe: Floats
    stiffness: float
    damping: float
    bandwidth_hz: float
    fidelity: Fidelity
    dynamics: Dynamics
    without: tuple[str, ...]
    adc_bits: int
    bodies: tuple[Body | None, ...] | None = None
    compliance: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """One experiment, whole.

    Attributes:
        scene: the user's words, for who writes, sends or changes them. Nobody who plans, drives or emulates reads it.
        saved, files: the scene as it names its files beside it, and their contents by name, as they were read for this
            setup. Who writes the scene, or hands it to another process, takes them, whatever became of the originals.
        name, title, seed: of the scene.
        figures: whether its run is drawn.
        bus: interface, channel, bit rates and what a lockstep bus is like.
        rate_hz: of SYNC and servo.
        realtime: SCHED_FIFO, a reserved processor, locked memory, on a real interface.
        compute_ns: that the plan leaves to the controller in each cycle.
        kind: of the task, as scenes say it.
        truth: what is really there.
    """

    scene: Scene
    saved: Scene
    files: Mapping[str, bytes]
    name: str
    title: str
    seed: int
    figures: bool
    bus: BusSettings
    rate_hz: float
    realtime: bool
    compute_ns: int
    limits: SafetyLimits
    bring_up: BringUpSettings
    bridge: BridgeSettings
    arm: Arm | None
    array: Array | None
    probe: Probe
    kind: TaskKind
    task: Task
    truth: Truth

    @property
    def touch(self) -> Touch | Calibrate | None:
        """The task, where it touches an object."""
        return self.task if isinstance(self.task, Touching) else None

    @property
    def scan(self) -> Scan | None:
        """The path; None where no surface is followed."""
        return self.task.scan if isinstance(self.task, Touch) else None

    @property
    def shape(self) -> Shape | None:
        """The estimator; None where no shape is estimated."""
        return self.task.shape if isinstance(self.task, Touch) else None

    @property
    def emulated_node_ids(self) -> tuple[int, ...]:
        """The nodes that are emulated, ascending."""
        array = self.array
        arrays = (array,) if array is not None and array.raw is None else ()
        nodes = (*(self.arm.drives if self.arm is not None else ()), *arrays)
        return tuple(sorted(node.node_id for node in nodes if node.emulated))

    @property
    def emulates(self) -> bool:
        """Something of it is emulated."""
        return bool(self.emulated_node_ids) or (self.array is not None and self.array.emulated)

    def changed(self, part: Literal["bus", "arm", "array"], **values: Any) -> Setup:
        """With other values of one part, in the task too."""
        new = {part: replace(getattr(self, part), **values)}
        return replace(self, **new, task=replace(self.task, **new) if hasattr(self.task, part) else self.task)
