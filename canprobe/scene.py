"""A scene: what one experiment consists of, as frozen dataclasses that mirror the TOML file.

Field names are the TOML keys and carry their unit. A section that is None is absent and left out of the plan. Each
field is one line: type, check, default; `canprobe.scene_loader` reads everything it needs from these annotations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from canprobe.protocol.tactile import WINDOWS
from canprobe.scene_checks import Direction, Distinct, OneOf, Only, Pattern, Range, ScenePath, Symmetric

TaskKind = Literal["scan", "press", "calibrate", "listen", "free"]
Strategy = Literal["weave", "straight", "circle"]
Auto = Literal["auto"]  # the plan chooses
TactileModeName = Literal["window", "image", "features", "auto"]
CobIds = Literal["default", "by_deadline", "auto"]
ShapeMethod = Literal["recursive", "ml", "chord", "chen1996"]
ObjectKind = Literal["plane", "sphere", "cylinder", "ellipsoid", "saddle", "bowl", "torus", "wave", "fillet", "quadric"]
ArmModel = Literal["upenn", "unimate"]
Fidelity = Literal["ideal", "dynamic"]
Integrator = Literal["semi-implicit", "rk4", "implicit", "rosenbrock", "exponential", "adaptive"]
TransmitQueue = Literal["priority", "fifo"]
BridgeName = Literal["mcap", "foxglove", "ros2", "view"]

Vec2 = tuple[float, float]
Vec3 = tuple[float, float, float]
Vec6 = tuple[float, float, float, float, float, float]
Row4 = tuple[float, float, float, float]
Channel = Annotated[str, Pattern(r"[!-~]+", "without spaces, in ASCII")]  # as it stands in a candump log
NodeId = Annotated[int, Range(1, 126)]  # 127 is the master
SerialNumber = Annotated[int, Range(0, 0xFFFFFFFF)]
SerialNumbers = tuple[SerialNumber, SerialNumber, SerialNumber, SerialNumber, SerialNumber, SerialNumber]
NodeIds = tuple[NodeId, NodeId, NodeId, NodeId, NodeId, NodeId]

TOUCH_KINDS: tuple[TaskKind, ...] = ("scan", "press", "calibrate")
"""Tasks that touch an object."""
TOUCHING = Only("kind", TOUCH_KINDS)
SCANNING = Only("kind", ("scan",))
CALIBRATING = Only("kind", ("calibrate",))
FREE = Only("kind", ("free",))
DYNAMIC = Only("fidelity", ("dynamic",))
TWO_RADII = Only("kind", ("saddle", "ellipsoid"), required=True)
WAVE = Only("kind", ("wave",), required=True)


@dataclass(frozen=True, slots=True)
class SceneInfo:
    """`[scene]`: what the scene is called, the seed of everything random in it, and whether its run is drawn."""

    name: Annotated[str, Pattern(r"[A-Za-z0-9][A-Za-z0-9_.-]*", "of letters, digits, '_', '.' and '-'")]
    title: str = ""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    figures: bool = True  # report.png, surface.png and report.html: seconds that a series of runs can spare


@dataclass(frozen=True, slots=True)
class BusSettings:
    """`[bus]`: where the nodes are. `lockstep`, `socketcan` or any python-can interface."""

    interface: Annotated[str, Pattern(r"[a-z0-9_-]+", "such as lockstep, socketcan, pcan")] = "lockstep"
    channel: Channel = "can0"
    bitrate: Annotated[int, Range(10_000, 1_000_000)] = 1_000_000
    timed: bool = True  # lockstep: frames take their time on the wire and wait for each other; false: none at all
    transmit_queue: TransmitQueue = "priority"  # what a node with several frames sends first; "fifo": the oldest
    bit_error_rate: Annotated[float, Range(0, 0.01)] = 0.0  # timed lockstep: share of bits that the wire corrupts
    fd: bool | Auto = False  # PDOs of up to 64 bytes in CAN FD frames, where a device has them; the rest is classical
    data_bitrate: Annotated[int, Range(10_000, 8_000_000)] = 5_000_000  # of the data phase of CAN FD frames
    cob_ids: CobIds = "default"  # of the PDOs: the cell's own, or priorities in the order of the deadlines


@dataclass(frozen=True, slots=True)
class CycleSettings:
    """`[cycle]`: the rate of SYNC and servo."""

    rate_hz: Annotated[float, Range(1, 2000)] = 400.0
    realtime: bool = False  # on a real interface: SCHED_FIFO, a processor of its own, locked memory
    compute_us: Annotated[float, Range(0, 1_000_000)] = 200.0  # that the plan leaves to the controller in each cycle


@dataclass(frozen=True, slots=True)
class ArmSettings:
    """`[arm]`: six joint drives."""

    model: ArmModel = "upenn"
    node_ids: Annotated[NodeIds, Distinct()] = (1, 2, 3, 4, 5, 6)
    eds: Annotated[str, ScenePath()] = "puma260_joint.eds"
    emulated: bool = True
    # selects the branch of the inverse kinematics; an emulated arm stands here in `free`, above the start in others
    start_deg: Vec6 = (90.0, 65.0, 15.0, 0.0, 100.0, 0.0)
    missed_syncs: Annotated[int, Range(1, 250)] = 5  # then drive and master take each other for dead
    grouped_rpdo: bool | Auto = False  # two targets in one RPDO through dummy mapping
    serial_numbers: Annotated[SerialNumbers | None, Distinct()] = None  # 1018h:04 of each drive; None: any


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """`[sensor]`: the 16×16 tactile array."""

    node_id: NodeId = 16
    eds: Annotated[str, ScenePath()] = "tactile_array.eds"
    emulated: bool = True
    channel: Channel | None = None  # a bus of its own; "auto" as it fits
    mode: TactileModeName = "window"
    # taxels along the window that follows the contact; the full image is a mode of its own
    window: Annotated[Annotated[int, OneOf(WINDOWS)] | Auto, Only("mode", ("window", "auto"))] = 8
    rate_hz: Annotated[float, Range(1, 1000)] = 200.0
    full_scale_kpa: Annotated[float, Range(10, 1000)] = 100.0
    serial_number: SerialNumber | None = None  # 1018h:04; None: any


@dataclass(frozen=True, slots=True)
class ProbeSettings:
    """`[probe]`: the sphere that carries the array, with its elastic layer."""

    radius_mm: Annotated[float, Range(5, 200)] = 40.0
    centre_offset_mm: Annotated[float, Range(0, 300)] = 80.0  # of the sphere's centre beyond the flange, along tool z
    centre_lateral_mm: Vec2 = (0.0, 0.0)  # and along tool x and y; `canprobe run calibrate` finds all three
    mass_kg: Annotated[float, Range(0, 5)] = 0.3
    stiffness_n_m3: Annotated[float, Range(1e5, 1e12)] = 1.27e8  # K/h of the elastic layer


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """`[object]`: the true object, for the emulated plant and for scoring; the controller never sees it.

    The object frame's origin lies on the surface with z outward. A cylinder, a wave and a fillet are straight along
    x: a wave is z = amplitude (cos(2π y/wavelength) − 1), a fillet an arc that turns by angle between two planes. A
    saddle is z = −x²/(2 radius_x) − y²/(2 radius_y) with radii of opposite sign (positive: convex); an ellipsoid has
    three positive semi-axes; a torus lies flat, the origin on its crown, x outward from its axis; a bowl is the inside
    of a sphere, seen from its bottom; a quadric is XᵀSX = 0 with S = matrix, in metres, negative inside.
    """

    kind: ObjectKind
    radius_mm: Annotated[
        float | None,
        Range(1, 100_000),
        Only("kind", ("sphere", "cylinder", "bowl", "torus", "fillet"), required=True),
    ] = None
    radius_x_mm: Annotated[float | None, Range(-100_000, 100_000), TWO_RADII] = None
    radius_y_mm: Annotated[float | None, Range(-100_000, 100_000), TWO_RADII] = None
    radius_z_mm: Annotated[float | None, Range(1, 100_000), Only("kind", ("ellipsoid",), required=True)] = None
    ring_radius_mm: Annotated[float | None, Range(1, 100_000), Only("kind", ("torus",), required=True)] = None
    amplitude_mm: Annotated[float | None, Range(0, 1000, open_low=True), WAVE] = None  # half of trough to crest
    wavelength_mm: Annotated[float | None, Range(1, 100_000), WAVE] = None
    angle_deg: Annotated[float | None, Range(1, 179), Only("kind", ("fillet",), required=True)] = None
    matrix: Annotated[tuple[Row4, Row4, Row4, Row4] | None, Symmetric(), Only("kind", ("quadric",), required=True)] = (
        None
    )
    position_mm: Vec3 = (-120.0, -122.5, 374.0)  # of the object frame in base: a point on the surface
    rotation_deg: Vec3 = (0.0, 0.0, 0.0)  # roll, pitch, yaw about fixed x, y, z


@dataclass(frozen=True, slots=True)
class TaskSettings:
    """`[task]`: what is done.

    `scan` approaches, touches and follows the strategy; `press` approaches and holds the force; `calibrate` touches a
    ball of known radius, its top expected at `start_mm`, from several sides to find the probe's centre on the flange;
    `listen` reads the sensor only; `free` swings the joints about `arm.start_deg` without a sensor.
    """

    kind: TaskKind
    duration_s: Annotated[float, Range(0, 86_400, open_low=True)] = 20.0  # of the scan, press, listen or free phase
    force_n: Annotated[float, Range(0, 20, open_low=True), TOUCHING] = 2.0
    approach_mm_s: Annotated[float, Range(0, 4, open_low=True), TOUCHING] = 4.0
    start_mm: Annotated[Vec3, TOUCHING] = (-120.0, -122.5, 374.0)  # expected contact point, approached along −normal
    approach_normal: Annotated[Vec3, Direction(), TOUCHING] = (0.0, 0.0, 1.0)  # normalised by its users
    clearance_mm: Annotated[float, Range(0, 50, open_low=True), TOUCHING] = 3.0  # above start_mm before the approach
    search_mm: Annotated[float, Range(0, 50, open_low=True), TOUCHING] = 8.0  # below start_mm where it gives up
    strategy: Annotated[Strategy, SCANNING] = "weave"
    speed_mm_s: Annotated[float, Range(0, 200, open_low=True), SCANNING] = 25.0
    heading_deg: Annotated[float, Range(-360, 360), SCANNING] = 0.0  # of the path, in the base xy-plane
    regain_mm: Annotated[float, Range(0, 20), SCANNING] = 2.0  # towards the object where contact is lost; 0: give up
    length_mm: Annotated[float, Range(0.1, 500), SCANNING] = 36.0  # full size; a circle's diameter
    width_mm: Annotated[float, Range(0, 500, open_low=True), SCANNING, Only("strategy", ("weave",))] = 9.0  # full size
    wavelength_mm: Annotated[float, Range(1, 500), SCANNING, Only("strategy", ("weave",))] = 12.0  # of one weave
    rolling_share: Annotated[float, Range(0, 1), SCANNING] = 0.05  # 0: pad follows the normal, 1: fixed orientation
    ball_radius_mm: Annotated[float, Range(5, 500), CALIBRATING] = 25.0
    ball_sigma_mm: Annotated[float, Range(0, 20, open_low=True), CALIBRATING] = 3.0  # of its expected centre per axis
    touches: Annotated[int, Range(2, 200), CALIBRATING] = 13
    tilt_deg: Annotated[float, Range(0, 60), CALIBRATING] = 22.0  # of the touches round the top from the top
    beside_deg: Annotated[float, Range(0, 15), CALIBRATING] = 9.0  # of each touch from the pole of the probe
    swing_deg: Annotated[Vec6, FREE] = (5.0, 5.0, 5.0, 10.0, 10.0, 10.0)  # amplitude of each joint
    swing_period_s: Annotated[float, Range(0.1, 3600), FREE] = 4.0


@dataclass(frozen=True, slots=True)
class ShapeSettings:
    """`[shape]`: the surface estimator."""

    method: ShapeMethod = "recursive"
    memory_mm: Annotated[float, Range(0, 1000, open_low=True)] = 20.0  # of path, whatever the time
    also: Annotated[tuple[ShapeMethod, ...], Distinct()] = ("ml", "chen1996")  # on the same data, for the report
    patch: bool = True  # complete what the path leaves open by the second moments of the images
    every_ms: Annotated[float, Range(0, 10_000, open_low=True)] = 40.0  # between two answers; every sample is taken in


@dataclass(frozen=True, slots=True)
class LimitSettings:
    """`[limits]`: where the cell is stopped for safety."""

    force_max_n: Annotated[float, Range(0, 50, open_low=True)] = 5.0
    preload_max_n: Annotated[float, Range(0, 50)] = 0.15  # felt before the run, which the array's tare takes for zero
    joint_margin_deg: Annotated[float, Range(0, 45)] = 1.0  # kept from every joint stop
    joint_speed_share: Annotated[float, Range(0.001, 1)] = 1.0  # of the model's speed limits
    late_cycles_max_percent: Annotated[float, Range(0, 100)] = 10.0  # of the last second's, late by half a period
    workspace_min_mm: Vec3 | None = None  # of the probe's tip in base; none without
    workspace_max_mm: Vec3 | None = None


@dataclass(frozen=True, slots=True)
class BringUpSettings:
    """`[bring_up]`: how long its steps may take, and what is done about those that take longer."""

    listen_s: Annotated[float, Range(0, 60)] = 0.25  # for another master
    boot_up_s: Annotated[float, Range(0, 600, open_low=True)] = 2.0  # from the reset to the boot-up message
    sdo_s: Annotated[float, Range(0, 60, open_low=True)] = 0.5  # for one answer
    start_s: Annotated[float, Range(0, 60, open_low=True)] = 1.0  # from NMT start to the heartbeat that tells it
    emulated_s: Annotated[float, Range(0, 3600, open_low=True)] = 120.0  # for the emulated nodes' process to start
    retries: Annotated[int, Range(0, 100)] = 2  # of a reset, a request or a start without an answer
    store: bool = False  # 1010h keeps the configuration in the nodes; 1020h tells the next bring-up to leave it out


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """`[servo]`: the tactile servo's gains."""

    surface_height_hz: Annotated[float, Range(0, 50, open_low=True)] = 8.0  # how fast its surface follows the samples
    surface_tilt_hz: Annotated[float, Range(0, 50, open_low=True)] = 6.0  # and that surface's normal
    drive_lag_ms: Annotated[float, Range(0, 100)] = 6.8  # of the drives behind a ramp: 2 ζ/ω, with −3 dB at 30 Hz


@dataclass(frozen=True, slots=True)
class PlantSettings:
    """`[plant]`: how the emulated arm, contact and array behave.

    Fidelity `ideal`: each drive tracks as a second-order system, whatever it pushes against. `dynamic`: rigid links,
    friction, drive cascade, and the object pushes back; the keys that say "dynamic" belong to it.
    """

    fidelity: Fidelity = "ideal"
    arm_model: ArmModel | None = None  # the arm that is really there, its base set so that the start is where it is
    integrator: Annotated[Integrator, DYNAMIC] = "rosenbrock"
    step_us: Annotated[float, Range(10, 2500), DYNAMIC] = 625.0  # of the integrator
    friction: Annotated[float, Range(0, 2), DYNAMIC] = 0.3  # Coulomb, between probe and object
    integral_ms: Annotated[float, Range(0, 10_000), DYNAMIC] = 20.0  # reset time of the velocity loops; 0: none
    velocity_feed_forward: Annotated[float, Range(0, 1), DYNAMIC] = 0.0  # 1 removes the drives' lag
    torque_limit_permille: Annotated[int, Range(1, 2000), DYNAMIC] = 2000  # of the continuous torque
    drive_bandwidth_hz: Annotated[float, Range(1, 1000)] = 30.0
    tool_error_mm: Vec3 = (0.0, 0.0, 0.0)  # of the probe's centre that is really there, in the flange frame
    # K/h of the layer that is really there, N/m³; the probe's by default
    stiffness_n_m3: Annotated[float, Range(1e5, 1e12)] | None = None
    contact_damping_s_m: Annotated[float, Range(0, 100)] = 0.3  # Hunt–Crossley α (assumed)
    noise: bool = True
    gain_error: bool = True
    blur: bool = True
    hysteresis: bool = True
    creep: bool = True
    crosstalk: bool = True
    saturation: bool = True
    threshold: bool = True  # of the array itself, before the node's own
    adc_bits: Annotated[int, Range(8, 16)] = 8  # beyond 8 the node's features gain by it; taxels go out in whole counts


@dataclass(frozen=True, slots=True)
class BridgeSettings:
    """`[bridge]`: the other tools that see this cell, each in a process of its own; `canprobe.planning.bridges`."""

    use: Annotated[tuple[BridgeName, ...], Distinct()] = ()
    foxglove_port: Annotated[int, Range(0, 65_535)] = 8765  # 0 lets the system choose
    foxglove_host: Annotated[str, Pattern(r"\S+", "without spaces")] = "127.0.0.1"  # 0.0.0.0 for other machines
    ros2_domain: Annotated[int, Range(0, 232)] = 0
    ros2_loopback: bool = True  # false lets other machines see the topics, and command the cell where that is allowed
    view_port: Annotated[int, Range(0, 65_535)] = 8080  # 0 lets the system choose; where it is taken, the next free one
    view_host: Annotated[str, Pattern(r"\S+", "without spaces")] = "127.0.0.1"  # 0.0.0.0 for other machines
    ros2_commands: bool = False  # start, stop, target force and speed are taken from topics, within the scene's limits


@dataclass(frozen=True, slots=True)
class Scene:
    """One experiment. Sections that are None are absent."""

    scene: SceneInfo
    task: TaskSettings
    bus: BusSettings = BusSettings()
    cycle: CycleSettings = CycleSettings()
    limits: LimitSettings = LimitSettings()
    bring_up: BringUpSettings = BringUpSettings()
    arm: ArmSettings | None = None
    sensor: SensorSettings | None = None
    probe: ProbeSettings | None = None
    object: ObjectSettings | None = None
    shape: ShapeSettings | None = None
    servo: ServoSettings | None = None
    plant: PlantSettings | None = None
    bridge: BridgeSettings | None = None

    @property
    def name(self) -> str:
        """The scene's name."""
        return self.scene.name

    @property
    def title(self) -> str:
        """One line about the scene."""
        return self.scene.title

    @property
    def seed(self) -> int:
        """The seed of everything random."""
        return self.scene.seed

    @property
    def emulated_node_ids(self) -> tuple[int, ...]:
        """The nodes that the scene wants emulated, ascending."""
        arm = self.arm.node_ids if self.arm is not None and self.arm.emulated else ()
        sensor = (self.sensor.node_id,) if self.sensor is not None and self.sensor.emulated else ()
        return tuple(sorted((*arm, *sensor)))
