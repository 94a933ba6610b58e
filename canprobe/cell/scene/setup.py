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

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from canprobe.cell.scene.hardware import Auto, BringUpSettings, BusSettings, Fidelity, TactileModeName, WhenDisabled
from canprobe.cell.scene.model import BridgeSettings, OutputSettings, Scene, ShapeMethod, TaskKind
from canprobe.errors import UsageError
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.raw_image import ImageFormat
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.mechanics.robot.keep_out import KeepOut
    from canprobe.mechanics.robot.model import ArmModel, Body
    from canprobe.mechanics.robot.tool_calibration import BallApproach
    from canprobe.mechanics.touch import ArrayCalibration, Pad
    from canprobe.mechanics.touch.carrier import CarrierMotion
    from canprobe.mechanics.touch.servo import SurfaceGains
    from canprobe.mechanics.touch.shapes import PlacedShape
    from canprobe.mechanics.touch.strategies import Rectangle, Strategy


@dataclass(frozen=True, slots=True)
class Node:
    """Data that every node of a cell has.

    Attributes:
        node_id: node id, 1–126, different on all buses together.
        channel: channel of its bus.
        eds: name or path of its EDS.
        emulated: served by the emulator.
        serial: serial number that 1018h:04 must have; None: any.
    """

    node_id: int
    channel: str
    eds: str
    emulated: bool
    serial: int | None


@dataclass(frozen=True, slots=True)
class HomingParameters:
    """Parameters of homing, for a drive that does not know its zero after power on. Units are rad or m, and s.

    Attributes:
        method: homing method of CiA 402, 6098h.
        order: lower numbers are homed first.
        home: position of the joint at its home position.
        speed: speed of the search for the switch.
        zero_speed: speed of the search for its edge or the index pulse.
        acceleration: acceleration in homing.
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
    """The drive of a joint.

    Attributes:
        zero: how the drive is homed; None: its encoder is absolute.
        turn_units: position units of a motor turn; None: of a prismatic joint.
        metre_units: position units of a metre; None: of a revolute joint.
        gear: turns of the motor per turn of the joint.
        quirks: what makes the emulated drive difficult; None: nothing does.
    """

    zero: HomingParameters | None = None
    turn_units: float | None = None
    metre_units: float | None = None
    gear: float = 1.0
    quirks: Quirks | None = None


@dataclass(frozen=True, slots=True)
class External:
    """An arm that is not on the bus.

    Attributes:
        address: host and port of its program; None: it is given, or emulated.
        emulated: it is emulated.
        delay_s: dead time from a command to its motion.
        stop_after_s: time without a command after which it stops by itself.
    """

    address: str | None
    emulated: bool
    delay_s: float
    stop_after_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Arm:
    """The arm: its chain, and a drive for each of its n joints.

    The joints of an external arm are the coordinates of its flange, see `canprobe.mechanics.robot.flange`.

    Attributes:
        model: geometry, limits and motor counts.
        drives: one a joint, from the base; none of an external arm.
        q_start: (n,) rad; selects the branch of the inverse kinematics, and is where an emulated arm stands.
        missed_syncs: SYNC periods of silence after which drive and master treat each other as lost.
        grouped: two targets share an RPDO through dummy mapping.
        torque: the drives send their torque where they can; the plan gives it up where the bus has no room for it.
        warnings: values of its URDF that are hardly meant.
        postures: (n,) rad or m by name, that of the start among them.
        temperature: entry of the drives' temperature (index, sub-index), and its unit, °C; None: not stated.
        when_disabled: what it does when its drives are disabled, as the cell file says.
        profile_lag: lag that profile position adds to that of the drives, s; 0 where no drive goes by it.
        external: the arm as one that is not on the bus; None of an arm with drives.
    """

    model: ArmModel
    drives: tuple[Drive, ...]
    q_start: Floats
    missed_syncs: int
    grouped: bool | Auto
    torque: bool = True
    warnings: tuple[str, ...] = ()
    postures: Mapping[str, Floats] = field(default_factory=dict)
    temperature: tuple[int, int, float] | None = None
    when_disabled: WhenDisabled = "unknown"
    profile_lag: float = 0.0
    external: External | None = None

    @property
    def delay_s(self) -> float:
        """Dead time of an external arm, s; 0 with drives."""
        return self.external.delay_s if self.external is not None else 0.0

    @property
    def left_alone(self) -> str:
        """What it does when its drives are disabled, in words."""
        return {
            "brakes": "when its drives are disabled, its brakes hold it",
            "sinks": "when its drives are disabled, it sinks: hold it",
            "unknown": "whether it sinks when its drives are disabled is not stated (arm.when_disabled)",
        }[self.when_disabled]

    @property
    def node_ids(self) -> tuple[int, ...]:
        """Node ids of the drives, joint by joint."""
        return tuple(drive.node_id for drive in self.drives)


@dataclass(frozen=True, slots=True, eq=False)
class RawWire:
    """A device of raw frames, which knows no CANopen.

    Attributes:
        image: layout of its images in frames.
        serial: serial number or name that the cell file gives it, as its frames do not; None: not stated.
        normal: number of the taxel's value that is the normal pressure, from 0.
        unloaded, full_scale: value without load, and at the pad's full scale; it may fall with pressure.
        tare_images: number of images at the beginning whose mean is the unloaded value of each taxel; 0: `unloaded` is.
        sampling: event that an image begins with.
        start, stop: frames that start and stop the device.
        poll: frames that ask for one image.
        latency_s, latency_sigma_s: time from the sample to the first frame, as stated, and its standard deviation.
        found_s, found_sigma_s: latency that a calibration found beyond that, and its standard deviation.
    """

    image: ImageFormat
    serial: int | str | None
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
        name: name of its file.
        mode: what the array sends.
        window: taxels along the window that follows the contact.
        rate_hz: rate of its images.
        pad: its taxels.
        calibration: calibration of the array, with the stiffness of the layer that `Probe` has.
        calibrated: a calibration was stated, or the array is emulated; False: a real array that nobody has calibrated.
        raw: the raw frames that it sends; None: it is a CANopen node.
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
    def newtons(self) -> str:
        """What the array's newtons rest on, in words."""
        from canprobe.mechanics.touch.image.calibration import NO_FORCE_REFERENCE

        return self.calibration.newtons if self.calibrated else NO_FORCE_REFERENCE


@dataclass(frozen=True, slots=True, eq=False)
class Carrier(Node):
    """The turntable or conveyor that the object stands on, with the encoder that is its node.

    Attributes:
        motion: its axis.
        speed: speed that the plan counts with, rad/s or m/s.
        units: units of the position value per rad or m.
        zero: position value at position 0.
    """

    motion: CarrierMotion
    speed: float
    units: float
    zero: int

    @property
    def column(self) -> str:
        """Column of its position in the log."""
        return "carrier_m" if self.motion.point is None else "carrier_rad"

    def frame(self, position: float | None) -> Floats | None:
        """Its frame (4, 4) in base at a position, rad or m; None where that is not known."""
        return None if position is None or math.isnan(position) else self.motion.T_base_carrier(position)

    def text(self, way: float) -> str:
        """A way of it, rad or m, for people."""
        return f"{1e3 * way:.3g} mm" if self.motion.point is None else f"{math.degrees(way):.3g} deg"


@dataclass(frozen=True, slots=True, eq=False)
class Probe:
    """The sphere that carries the array, with its elastic layer; the middle of the flange where the arm carries none.

    Attributes:
        T_flange_probe: (4, 4) of its centre on the flange; z is the pole.
        radius: radius of the sphere, m; 0 without a probe.
        stiffness: stiffness K/h of the layer, N/m³.
        mass: mass of the probe, kg.
        position_sd: standard deviation of its centre on the flange, per axis, m.
        place_sd: standard deviation of its centre in base, per axis, m: on the flange, and of the flange by the arm.
        is_flat: whether it is a flat pad, which is taken for a sphere of `FLAT_RADIUS_M`.
    """

    T_flange_probe: Floats
    radius: float
    stiffness: float
    mass: float
    position_sd: float = 0.0
    place_sd: float = 0.0
    is_flat: bool = False

    @property
    def lever(self) -> float:
        """Distance along the pole from its centre to the point whose ways count, m: 0, the centre itself.

        A flat pad has its tip: a count of an encoder moves its centre, 10 m away, by a millimetre.
        """
        return self.radius if self.is_flat else 0.0

    @property
    def T_flange_point(self) -> Floats:
        """(4, 4) of the point whose ways count on the flange; z is the pole."""
        return self._along_pole(self.lever)

    @property
    def T_flange_tip(self) -> Floats:
        """(4, 4) of the point of its pole on the flange; z is the pole."""
        return self._along_pole(self.radius)

    def _along_pole(self, distance: float) -> Floats:
        T = self.T_flange_probe.copy()
        T[:3, 3] += distance * T[:3, 2]
        return T

    @property
    def tip(self) -> str:
        """What the arm ends in, in words."""
        return "the probe's tip" if self.radius > 0.0 else "the flange"


@dataclass(frozen=True, slots=True, eq=False)
class SafetyLimits:
    """Limits at which the cell stops for safety.

    Attributes:
        force_max: highest contact force, N; the probe retreats when the upper end of the measured one is above.
        preload_max: highest force before the run, N; the array's tare takes it for zero.
        joint_margin: distance (n,) kept from the stops of each joint, rad or m; empty without an arm.
        speed_share: share of the joints' speed limits that a motion may use.
        late_share: share of the last second's cycles that may be late by half a period.
        workspace: box (2, 3) of the probe's tip in base, m; an open side is infinite; None without any.
        jog_force: force at which a motion by hand goes back, N; half of `force_max` at most.
        keep_out: what the whole arm keeps out of when it is moved by hand.
    """

    force_max: float
    preload_max: float
    joint_margin: Floats
    speed_share: float
    late_share: float
    workspace: Floats | None
    jog_force: float = 1.0
    keep_out: KeepOut | None = None


@dataclass(frozen=True, slots=True)
class Shape:
    """The surface estimator.

    Attributes:
        method: estimator in the loop.
        also: estimators that run on the same data afterwards.
        memory: length of path on which an estimate rests, m, whatever the time.
        every_s: time between two answers; every sample is taken in.
        patch: complete what the path leaves open by the second moments of the images.
        revisit: join the answers with a map of earlier passes over the same ground.
    """

    method: ShapeMethod
    also: tuple[ShapeMethod, ...]
    memory: float
    every_s: float
    patch: bool
    revisit: bool


@dataclass(frozen=True, slots=True, eq=False)
class Approach:
    """The way to the first contact.

    Attributes:
        start: expected contact point (3,), base frame, approached along −normal.
        axes: (3, 3) rows heading, across, approach normal (outward); base frame, right-handed.
        speed: speed of the approach, m/s.
        clearance: distance of the probe's surface from `start` where it begins, m.
        search: distance beyond `start` where it gives up, m.
        blind_search: the same where neither torques nor an image have shown that a contact would be noticed.
    """

    start: Floats
    axes: Floats
    speed: float
    clearance: float
    search: float
    blind_search: float

    @property
    def normal(self) -> Floats:
        """Outward unit normal that it expects, (3,)."""
        normal: Floats = self.axes[2]
        return normal


@dataclass(frozen=True, slots=True, eq=False)
class TargetTable:
    """A target over the path or the time of a scan: on straight lines between its points, held beyond them.

    Attributes:
        over_path: over the path of the contact; False: over the time since the scan or the hold began.
        places: where its points are (n,), ascending, m or s; a place that stands twice is a jump.
        values: target there (n,), N or m/s.
        least_share: share of itself down to which answers of the estimator lower it; 1: they do not.
    """

    over_path: bool
    places: Floats
    values: Floats
    least_share: float = 1.0

    @property
    def lowest(self) -> float:
        """Lowest target, N or m/s."""
        return self.least_share * float(self.values.min())

    def at(self, path: float, time: float) -> float:
        """The target at a path, m, and time, s."""
        return float(np.interp(path if self.over_path else time, self.places, self.values))


@dataclass(frozen=True, slots=True)
class Scan:
    """The path of a scan.

    Attributes:
        strategy: closed curve in the scan plane, or the rectangle that is explored.
        name: name of the strategy.
        speed: speed of the contact, m/s; of a table the highest.
        rolling_share: 0: the pad follows the normal, 1: it keeps its orientation.
        regain: distance towards the object that is searched for a lost contact, m; 0: none.
    """

    strategy: Strategy | Rectangle
    name: str
    speed: float
    rolling_share: float
    regain: float


@dataclass(frozen=True, slots=True, eq=False)
class Touching:
    """What the tasks have in common that touch an object.

    Attributes:
        force: target of the contact force, N; of a table the highest.
        tables: targets that vary, `target_force_n` in N and `speed_m_s` in m/s; of the others there is one value.
        duration_s: duration of the scan or of the hold; of a calibration, the duration that the plan expects.
        lag_s: lag of the drives behind a ramp, with the dead time of an external arm.
        carrier: what the object moves with; None: it stands still.
    """

    arm: Arm
    array: Array
    probe: Probe
    approach: Approach
    force: float
    tables: Mapping[str, TargetTable]
    duration_s: float
    lag_s: float
    carrier: Carrier | None = field(default=None, kw_only=True)

    @property
    def least_force(self) -> float:
        """Lowest target of the contact force, N."""
        return self.tables["target_force_n"].lowest if "target_force_n" in self.tables else self.force


@dataclass(frozen=True, slots=True, eq=False)
class Touch(Touching):
    """Approach, touch, and follow the surface; without a scan hold the force.

    Attributes:
        gains: gains of the servo's surface.
        sigma_wanted: standard deviation of the curvature below which the force is lowered, 1/m; None: never.
        shape: the estimator; None where no shape is estimated.
    """

    gains: SurfaceGains
    sigma_wanted: float | None
    scan: Scan | None
    shape: Shape | None


@dataclass(frozen=True, slots=True, eq=False)
class Calibrate(Touching):
    """Touch a ball of known radius from several sides to find the probe's centre on the flange.

    Attributes:
        ball_centre: expected centre of the ball (3,), base frame.
        ball_radius: radius of the ball, m.
        ball_sigma: standard deviation of the expected centre per axis, m.
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
        period_s: period of the swing.
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
        torque_limit_permille: torque limit of the drives, permille of the continuous torque.
        integrator: name of the integrator, a key of the plant's `STEPS`.
        step_ns: longest step of the integrator.
        hold_ns: time for which mass matrix, bias and contact geometry are held.
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
    """What is true in an emulation, for plant, check of the motion and scores. The controller never reads it.

    Attributes:
        object: the object; None where nothing can be touched.
        model: model of the arm; None without an arm.
        T_flange_probe: frame of the probe's centre on the flange (4, 4).
        stiffness: K/h of its layer, N/m³.
        damping: damping of the contact, Hunt–Crossley α, s/m.
        bandwidth_hz: bandwidth of every drive, −3 dB.
        fidelity: fidelity of the plant.
        dynamics: what a dynamic arm has beyond its geometry.
        without: effects of the array that are switched off.
        adc_bits: bits of the array's ADC.
        dead: (row, column) of taxels that read nothing.
        bodies: bodies (n,) of the links behind the joints, without the probe; None where nobody knows them, which
            refuses "dynamic".
        compliance: compliance (n,) of the joints between motor and link, rad/(N m) or m/N; None: all are rigid.
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
    dead: tuple[tuple[int, int], ...] = ()
    bodies: tuple[Body | None, ...] | None = None
    compliance: Floats | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """A whole experiment.

    Attributes:
        scene: scene in the user's words, to write, send or change it; planning, master and emulation do not read it.
        saved, files: the scene as it names its files beside it, and their contents by name, as they were read for this
            setup. Who writes the scene, or hands it to another process, takes them, whatever became of the originals.
        name, title, seed: name, title and seed of the scene.
        outputs: what a run makes besides its log and summary.
        bus: interface, channel, bit rates and what a lockstep bus is like.
        rate_hz: rate of SYNC and servo.
        realtime: SCHED_FIFO, a reserved processor, locked memory, on a real interface.
        compute_ns: time that the plan leaves to the controller in each cycle.
        kind: kind of the task, as scenes name it.
        truth: what is true in the emulation.
    """

    scene: Scene
    saved: Scene
    files: Mapping[str, bytes]
    name: str
    title: str
    seed: int
    outputs: OutputSettings
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

    def with_choices(self, choices: Mapping[str, object]) -> Setup:
        """The setup with values in the place of the scene's, such as the choices of the plan in the place of "auto".

        Args:
            choices: value by key path of the scene: `{"sensor.mode": "window"}`.
        """

        def chosen(scene: Scene) -> Scene:
            for path, value in choices.items():
                section, _, key = path.partition(".")
                scene = replace(scene, **{section: replace(getattr(scene, section), **{key: value})})
            return scene

        return replace(self, scene=chosen(self.scene), saved=chosen(self.saved))

    def needed_arm(self, what: str = "") -> Arm:
        """The arm.

        Args:
            what: what needs one, for the message; empty: the scene.

        Raises:
            UsageError: there is none.
        """
        if self.arm is None:
            raise UsageError(f"{what or self.name}: expected a scene with an arm; got one without")
        return self.arm

    @property
    def drives(self) -> tuple[Drive, ...]:
        """The drives of the arm, joint by joint; none without one."""
        return self.arm.drives if self.arm is not None else ()

    @property
    def touch(self) -> Touch | Calibrate | None:
        """The task, where it touches an object."""
        return self.task if isinstance(self.task, Touching) else None

    @property
    def tares(self) -> bool:
        """Whether bring-up tares the array: a cell that only listens knows no moment at which nothing touches it."""
        return self.array is not None and self.arm is not None

    @property
    def carrier(self) -> Carrier | None:
        """What the object moves with; None: it stands still."""
        return self.task.carrier if isinstance(self.task, Touching) else None

    @property
    def scan(self) -> Scan | None:
        """The path; None where no surface is followed."""
        return self.task.scan if isinstance(self.task, Touch) else None

    @property
    def shape(self) -> Shape | None:
        """The estimator; None where no shape is estimated."""
        return self.task.shape if isinstance(self.task, Touch) else None

    @property
    def emulates(self) -> bool:
        """Whether any part of the cell is emulated."""
        return self.emulates_arm or (self.array is not None and self.array.emulated)

    @property
    def emulates_arm(self) -> bool:
        """Whether a drive or the external arm is emulated."""
        external = self.arm.external if self.arm is not None else None
        return external.emulated if external is not None else any(drive.emulated for drive in self.drives)

    def line_to_type(self, command: str, *options: str) -> str:
        """The line of a command on the cell's bus; on SocketCAN where the scene names none."""
        interface = "socketcan" if self.bus.virtual else self.bus.interface
        more = "".join(f" {option}" for option in options)
        return f"canprobe {command} {shlex.quote(self.name)}{more} --bus {interface} --channel {self.bus.channel}"

    def changed(self, part: Literal["bus", "arm", "array"], **values: Any) -> Setup:
        """A setup with other values of one part, in the task too."""
        new = {part: replace(getattr(self, part), **values)}
        return replace(self, **new, task=replace(self.task, **new) if hasattr(self.task, part) else self.task)
