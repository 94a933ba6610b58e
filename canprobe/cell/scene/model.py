"""A scene: what one experiment consists of, as frozen dataclasses that mirror the TOML file.

Field names are the TOML keys and carry their unit. A section that is None is absent and left out of the plan. A field
says everything about its key: type and checks, default, and below it the meaning. `canprobe.cell.scene.load` needs no
more than that, and `docs/generate.py` makes the reference of all keys from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from canprobe.cell.scene.checks import DIRECTION, DISTINCT, SYMMETRIC, Check, OneOf, Only, Pattern, Range, ScenePath
from canprobe.cell.scene.hardware import (
    ArmSettings,
    Auto,
    BringUpSettings,
    BusSettings,
    CarrierSettings,
    CellInfo,
    Channel,
    EmulateSettings,
    Fidelity,
    JointSettings,
    KeepOutSettings,
    NodeId,
    SerialNumber,
    TactileModeName,
    Vec3,
)
from canprobe.cell.scene.plugins import find_plugin
from canprobe.fieldbus.protocol.tactile import WINDOW_SIZES

TaskKind = Literal["scan", "press", "calibrate", "listen", "free"]
Strategy = Literal["weave", "straight", "circle", "explore"]
OFFERED_ESTIMATOR = Check("that another package offers", lambda name: find_plugin("estimator", name) is not None)
ShapeMethod = Literal["recursive", "ml", "chord", "chen1996"] | Annotated[str, OFFERED_ESTIMATOR]
ObjectKind = Literal[
    "plane",
    "sphere",
    "cylinder",
    "ellipsoid",
    "saddle",
    "bowl",
    "torus",
    "wave",
    "fillet",
    "quadric",
    "heights",
    "mesh",
]
Integrator = Literal["rk4", "rosenbrock", "adaptive"]
BridgeName = Literal["mcap", "foxglove", "ros2", "view"]

Vec2 = tuple[float, float]
Row4 = tuple[float, float, float, float]
Posture = tuple[float, ...]
"""Position of each joint, deg or mm."""
TargetPoints = Mapping[Literal["path_mm", "time_s"], tuple[Vec2, ...]]
"""Target over the path or over the time of a scan: points [place, target], with straight lines between them."""
FORCES, SPEEDS = Range(0, 20, open_low=True), Range(0, 200, open_low=True)
"""Targets of force, N, and speed, mm/s, that a task may have."""

TOUCH_KINDS: tuple[TaskKind, ...] = ("scan", "press", "calibrate")
"""Tasks that touch an object."""
TOUCH_ONLY = Only("kind", TOUCH_KINDS)
MOVING_ONLY = Only("kind", (*TOUCH_KINDS, "free"))
SCAN_ONLY = Only("kind", ("scan",))
CALIBRATE_ONLY = Only("kind", ("calibrate",))
FREE_ONLY = Only("kind", ("free",))
DYNAMIC_ONLY = Only("fidelity", ("dynamic",))
RAW_ONLY = Only("kind", ("frames",))
RAW_REQUIRED = Only("kind", ("frames",), required=True)
IDENTIFIER_PATTERN = Pattern(r"[0-7]?[0-9A-F]{1,2}h(-[0-7]?[0-9A-F]{1,2}h)?", 'such as "710h" or "710h-71Fh"')
COMMAND_PATTERN = Pattern(r"[0-7]?[0-9A-F]{1,2}#([0-9A-F]{2}){0,8}", 'such as "201#0700"')
DEFAULT_ARRAY = "inch16"
"""Array file of a sensor that names none."""
RADII_REQUIRED = Only("kind", ("saddle", "ellipsoid"), required=True)
WAVE_REQUIRED = Only("kind", ("wave",), required=True)
FILE_ONLY = Only("kind", ("heights", "mesh"))


@dataclass(frozen=True, slots=True)
class SceneInfo:
    """`[scene]`: the name of the scene and its seed."""

    name: Annotated[str, Pattern(r"[A-Za-z0-9][A-Za-z0-9_.-]*", "of letters, digits, '_', '.' and '-'")]
    """Name of the scene. It is part of the name of the results folder."""
    title: str = ""
    """One line about the scene, which `canprobe scenes` and `canprobe plan` print."""
    seed: Annotated[int, Range(0, 2**63 - 1)] = 0
    """Seed of all random numbers. In lockstep the same seed gives the same `bus.log`."""


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """`[outputs]`: what a run makes besides its log and summary; false leaves it out, with its part of each cycle.

    `canprobe plan` says what each of them costs. Nothing here changes what moves, or when the supervision stops it.
    """

    truth: bool = True
    """Record what is true at every SYNC in `truth.npz`, and score the run against it."""
    surface_map: bool = True
    """Fuse all contacts of a scan into one surface, `surface.npz`. An exploration needs it."""
    bus_log: bool = True
    """Write every frame into `bus.log`, which `canprobe replay` and `canprobe plan --measured` read."""
    figures: bool = True
    """Draw `report.png` and `surface.png` after a run. false saves a second."""


@dataclass(frozen=True, slots=True)
class CycleSettings:
    """`[cycle]`: the control cycle."""

    rate_hz: Annotated[float, Range(1, 2000)] = 400.0
    """Rate of SYNC and of the servo."""
    realtime: bool = False
    """On a real interface: request SCHED_FIFO, a processor for the cycle and locked memory."""
    compute_us: Annotated[float, Range(0, 1_000_000)] = 200.0
    """Computing time that the plan reserves for the controller in each cycle."""


@dataclass(frozen=True, slots=True)
class SensorSettings:
    """`[sensor]`: the tactile array.

    A key that neither the scene nor its cell gives has the value of the array file that `array` names.
    """

    array: Annotated[str, ScenePath()] = DEFAULT_ARRAY
    """Array file: a packaged name, or a path relative to the file."""
    rows: Annotated[int, Range(1, 64)] = 16
    """Rows of taxels."""
    columns: Annotated[int, Range(1, 64)] = 16
    """Columns of taxels."""
    pitch_mm: (
        Annotated[float, Range(0.1, 100)] | tuple[Annotated[float, Range(0.1, 100)], Annotated[float, Range(0.1, 100)]]
    ) = 1.5875
    """Distance of neighbouring taxels, whose square is the area that one taxel stands for; or two distances, of the
    columns and of the rows, and the area is their product."""
    positions_mm: tuple[Vec3, ...] | None = None
    """Position of each taxel on the array, row by row; z points out of it. Left out: a grid of `pitch_mm`."""
    normals: tuple[Vec3, ...] | None = None
    """Outward normal of each taxel, of any length, with `positions_mm`. Left out: z."""
    mount: Literal["sphere", "flat"] = "sphere"
    """sphere: wrapped on the sphere of `[probe]`. flat: a flat array listens and presses; it cannot scan."""
    node_id: NodeId = 16
    """Node id of an array with `wire.kind = "canopen"`."""
    eds: Annotated[str, ScenePath()] = "tactile_array.eds"
    """EDS of an array with `wire.kind = "canopen"`: a packaged name, or a path relative to the file."""
    emulated: bool = True
    """canprobe serves the array. false: the array is real."""
    channel: Channel | None = None
    """Channel of a separate bus for the array. Left out: `bus.channel`. "auto": the plan chooses."""
    mode: TactileModeName = "window"
    """What the array sends: the taxels round the contact, all taxels, or force, centroid and moments that it
    computes from them."""
    window: Annotated[Annotated[int, OneOf(WINDOW_SIZES)] | Auto, Only("mode", ("window", "auto"))] = 8
    """Side of the window that follows the contact, in taxels."""
    rate_hz: Annotated[float, Range(1, 1000)] = 200.0
    """Rate of the images. A SYNC triggers each, or what `wire.sampling` names."""
    full_scale_kpa: Annotated[float, Range(10, 1000)] = 100.0
    """Pressure at the largest count of a taxel."""
    serial_number: SerialNumber | str | None = None
    """Serial number (1018h:04) that the array must have; of an array that is no CANopen node, its name, as on its
    label. Left out: the number of its calibration file, or any; an array without a name is another one than its
    file's."""
    calibration: Annotated[str | None, ScenePath()] = None
    """Calibration file of the array, by `canprobe calibrate array`: a packaged name, or a path relative to the file.
    Left out: that of the emulated array; a real array then measures in nominal newtons."""


@dataclass(frozen=True, slots=True)
class WireSettings:
    """`[wire]`: what the array sends. It stands in the array file.

    `canopen` is a node that maps its images to PDOs. `frames` is a device that knows no CANopen: each image is every
    frame of `frames` from every identifier of `ids`, once each. The values of an image come in the order of
    identifiers, frames and letters.
    """

    kind: Literal["canopen", "frames"] = "canopen"
    """Kind of device."""
    ids: Annotated[tuple[Annotated[str, IDENTIFIER_PATTERN], ...], RAW_REQUIRED] = ()
    """Identifiers of its frames: each a number or a range in hexadecimal, such as "710h-71Fh"."""
    frames: Annotated[tuple[str, ...], RAW_REQUIRED] = ()
    """Frames of one image from each identifier, two characters a byte: 0-9 and A-F are a tag that must stand there,
    "." is not read, a small letter is 4 bits of a value, whose values are in the order of the alphabet."""
    byte_order: Annotated[Literal["big", "little"], RAW_ONLY] = "big"
    """Byte order of a value of several bytes."""
    axes: Annotated[int, Range(1, 3), RAW_ONLY] = 1
    """Values of a taxel."""
    normal_axis: Annotated[int, Range(1, 3), RAW_ONLY] = 1
    """Number of the value that is the normal pressure, from 1."""
    order: Annotated[Literal["rows", "columns"], RAW_ONLY] = "rows"
    """Taxels come row by row, or column by column."""
    signed: Annotated[bool, RAW_ONLY] = False
    """Values are in two's complement, as those of magnetometers."""
    unloaded_counts: Annotated[int, Range(-0x80000000, 0xFFFFFFFF), RAW_ONLY] = 0
    """Value of a taxel without load."""
    full_scale_counts: Annotated[int, Range(-0x80000000, 0xFFFFFFFF), RAW_ONLY] = 255
    """Value of a taxel at `sensor.full_scale_kpa`: below `unloaded_counts` where values fall with pressure."""
    tare_images: Annotated[int, Range(0, 10_000), RAW_ONLY] = 0
    """Images at the beginning of which the mean is the unloaded value of each taxel. 0: `unloaded_counts` is."""
    sampling: Annotated[Literal["free", "polled", "sync"], RAW_ONLY] = "free"
    """What an image begins with: the time of the device, a poll of the master, or a SYNC."""
    start: Annotated[tuple[Annotated[str, COMMAND_PATTERN], ...], RAW_ONLY] = ()
    """Frames that start the device, as cansend writes them: "201#0700"."""
    stop: Annotated[tuple[Annotated[str, COMMAND_PATTERN], ...], RAW_ONLY] = ()
    """Frames that stop it."""
    poll: Annotated[tuple[Annotated[str, COMMAND_PATTERN], ...], RAW_ONLY] = ()
    """Frames that ask a polled device for one image."""
    latency_ms: Annotated[float, Range(0, 1000), RAW_ONLY] = 0.0
    """Time from the sample of an image to its first frame on the bus."""
    latency_sigma_ms: Annotated[float, Range(0, 1000), RAW_ONLY] = 0.0
    """Standard deviation of `latency_ms`."""


@dataclass(frozen=True, slots=True)
class ProbeSettings:
    """`[probe]`: the sphere that carries the array and its elastic layer."""

    radius_mm: Annotated[float, Range(5, 200)] = 40.0
    """Radius of the sphere."""
    centre_offset_mm: Annotated[float, Range(0, 300)] = 80.0
    """Distance of the centre of the sphere from the flange along tool z. `canprobe run calibrate` finds it."""
    centre_lateral_mm: Vec2 = (0.0, 0.0)
    """Offset of the centre along tool x and y. `canprobe run calibrate` finds it."""
    position_sd_mm: Annotated[float, Range(0, 10)] = 0.2
    """Standard deviation of where the centre is on the flange, along each axis. `canprobe run calibrate` finds it."""
    mass_kg: Annotated[float, Range(0, 5)] = 0.3
    """Mass of the probe; the dynamic arm carries it."""
    stiffness_n_m3: Annotated[float, Range(1e5, 1e12)] | None = None
    """Stiffness of the elastic layer: its modulus over its thickness (K/h). Left out: that of the calibration of the
    array."""


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """`[object]`: the true object, for the emulated plant and for scoring. The controller never reads it.

    The origin of the object frame lies on the surface, and its z axis points outward. A cylinder, a wave and a fillet
    are straight along x. A wave is z = amplitude (cos(2π y/wavelength) − 1). A fillet is an arc between two planes;
    it turns the normal by the angle. A saddle is z = −x²/(2 radius_x) − y²/(2 radius_y) with radii of opposite sign
    (positive: convex). An ellipsoid has three positive semi-axes. A torus lies flat; the origin is on its crown, and x
    points away from its axis. A bowl is the inside of a sphere with the origin at its bottom. A quadric is XᵀSX = 0
    with S = matrix, in metres, negative inside. Heights are a grid of z over x and y; a mesh is what is
    seen of it from +z. Both are read from a file and taken as one smooth surface (docs/scenes.md).
    """

    kind: ObjectKind
    """Shape of the object."""
    radius_mm: Annotated[
        float | None,
        Range(1, 100_000),
        Only("kind", ("sphere", "cylinder", "bowl", "torus", "fillet"), required=True),
    ] = None
    """Radius; of a torus, the radius of its tube."""
    radius_x_mm: Annotated[float | None, Range(-100_000, 100_000), RADII_REQUIRED] = None
    """Radius or semi-axis along x of the object frame."""
    radius_y_mm: Annotated[float | None, Range(-100_000, 100_000), RADII_REQUIRED] = None
    """Radius or semi-axis along y of the object frame."""
    radius_z_mm: Annotated[float | None, Range(1, 100_000), Only("kind", ("ellipsoid",), required=True)] = None
    """Semi-axis along z of the object frame."""
    ring_radius_mm: Annotated[float | None, Range(1, 100_000), Only("kind", ("torus",), required=True)] = None
    """Radius of the circle on which the centre of the tube lies; above `radius_mm`."""
    amplitude_mm: Annotated[float | None, Range(0, 1000, open_low=True), WAVE_REQUIRED] = None
    """Half of the height from trough to crest."""
    wavelength_mm: Annotated[float | None, Range(1, 100_000), WAVE_REQUIRED] = None
    """Distance from crest to crest."""
    angle_deg: Annotated[float | None, Range(1, 179), Only("kind", ("fillet",), required=True)] = None
    """Angle between the two normals."""
    matrix: Annotated[tuple[Row4, Row4, Row4, Row4] | None, SYMMETRIC, Only("kind", ("quadric",), required=True)] = None
    """Matrix S of the quadric XᵀSX = 0, with lengths in metres."""
    file: Annotated[str | None, ScenePath(), Only("kind", ("heights", "mesh"), required=True)] = None
    """Heights: a .npy, .npz, .csv or .txt file, a row of which is a line along y. Mesh: an STL, OBJ or PLY file."""
    unit_mm: Annotated[float, Range(1e-6, 1e6), FILE_ONLY] = 1.0
    """Unit of the lengths in the file: 1000 for metres, 25.4 for inches."""
    spacing_mm: Annotated[float | None, Range(1e-3, 1000), FILE_ONLY] = None
    """Spacing of the grid of heights; left out: the `spacing` in a .npz file, in its unit. Of a mesh: that of the grid
    that is fitted to it; left out: 1 mm, or the one that has the curvature of the mesh where 1 mm has not."""
    origin_mm: Annotated[Vec2 | None, FILE_ONLY] = None
    """Point x, y of the file that is the origin of the object frame; left out: the middle. x and y of heights are
    counted from the grid's first corner, those of a mesh are its own."""
    position_mm: Vec3 = (-120.0, -122.5, 374.0)
    """Origin of the object frame in the base frame: a point of the surface."""
    rotation_deg: Vec3 = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the object about the fixed axes x, y and z."""


@dataclass(frozen=True, slots=True)
class TaskSettings:
    """`[task]`: what the cell does.

    `scan` approaches, touches and follows a path over the surface. `press` approaches and holds the force. `calibrate`
    touches a ball of known radius from several sides and finds the centre of the probe on the flange; it expects the
    top of the ball at `start_mm`. `listen` only reads the array. `free` swings the joints about their
    start posture and needs no array.
    """

    kind: TaskKind
    """Kind of task."""
    duration_s: Annotated[float, Range(0, 86_400, open_low=True)] = 20.0
    """Length of the scan, press, listen or free phase."""
    start_posture: Annotated[str | None, MOVING_ONLY] = None
    """Name of the posture in `[postures]` that is the start, in the place of the joints' `start_deg` and `start_mm`."""
    force_n: Annotated[Annotated[float, FORCES] | TargetPoints, TOUCH_ONLY] = 2.0
    """Target of the contact force. A table has it over the path of a scan, `{path_mm = [[0, 1], [20, 3]]}`, or over the
    time of a scan or press, `{time_s = [[0, 1], [2, 3]]}`: on straight lines between its points, held beyond them."""
    approach_mm_s: Annotated[float, Range(0, 4, open_low=True), TOUCH_ONLY] = 4.0
    """Speed of the approach."""
    start_mm: Annotated[Vec3, TOUCH_ONLY] = (-120.0, -122.5, 374.0)
    """Expected contact point, in the base frame."""
    approach_normal: Annotated[Vec3, DIRECTION, TOUCH_ONLY] = (0.0, 0.0, 1.0)
    """Expected outward normal at `start_mm`, of any length. The probe approaches against it."""
    clearance_mm: Annotated[float, Range(0, 50, open_low=True), TOUCH_ONLY] = 3.0
    """Distance from `start_mm` at which the approach begins."""
    search_mm: Annotated[float | None, Range(0, 50, open_low=True), TOUCH_ONLY] = None
    """Distance beyond `start_mm` at which the approach gives up. Left out: 8 mm; where the drives report no torque, and
    as long as no image of the array has changed since bring-up, only as far as `limits.force_max_n` presses in."""
    strategy: Annotated[Strategy, SCAN_ONLY] = "weave"
    """Path of the scan. With `explore` it goes where the map of the surface is not sure enough."""
    speed_mm_s: Annotated[Annotated[float, SPEEDS] | TargetPoints, SCAN_ONLY] = 25.0
    """Speed of the contact over the surface, a number or a table as of `force_n`."""
    slow_at_changes: Annotated[bool, SCAN_ONLY] = False
    """Go slower, down to half of the speed, where the estimated curvature differs from its mean over the last 5 mm of
    path by more than its standard deviation."""
    light_below_per_m: Annotated[float | None, Range(0, 1000, open_low=True), SCAN_ONLY] = None
    """Press less, down to half of the force, where the standard deviation of the estimated curvature is below this:
    the force falls in proportion. Left out: nowhere."""
    heading_deg: Annotated[float, Range(-360, 360), SCAN_ONLY] = 0.0
    """Heading of the path in the xy plane of the base frame, from x."""
    regain_mm: Annotated[float, Range(0, 20), SCAN_ONLY] = 2.0
    """Distance over which a scan searches towards the object for a lost contact. 0: it retreats at once."""
    length_mm: Annotated[float, Range(0.1, 500), SCAN_ONLY] = 36.0
    """Full length of the path along the heading; diameter of a circle."""
    width_mm: Annotated[float, Range(0, 500, open_low=True), SCAN_ONLY, Only("strategy", ("weave", "explore"))] = 9.0
    """Full width of the path across the heading; with `explore` of the rectangle, as `length_mm` is its length."""
    wavelength_mm: Annotated[float, Range(1, 500), SCAN_ONLY, Only("strategy", ("weave",))] = 12.0
    """Length of one weave along the heading."""
    target_sigma_um: Annotated[float, Range(0, 10_000, open_low=True), SCAN_ONLY, Only("strategy", ("explore",))] = 20.0
    """Standard deviation of the height that `explore` wants in the whole rectangle: there the scan ends."""
    rolling_share: Annotated[float, Range(0, 1), SCAN_ONLY] = 0.05
    """How the probe turns: 0 follows the normal of the surface, 1 keeps its orientation."""
    ball_radius_mm: Annotated[float, Range(5, 500), CALIBRATE_ONLY] = 25.0
    """Radius of the ball."""
    ball_sigma_mm: Annotated[float, Range(0, 20, open_low=True), CALIBRATE_ONLY] = 3.0
    """Standard deviation of the expected centre of the ball, per axis."""
    touches: Annotated[int, Range(2, 200), CALIBRATE_ONLY] = 13
    """Number of touches."""
    tilt_deg: Annotated[float, Range(0, 60), CALIBRATE_ONLY] = 22.0
    """Angle of the outer touches from the top of the ball."""
    beside_deg: Annotated[float, Range(0, 15), CALIBRATE_ONLY] = 9.0
    """Angle of each touch from the pole of the probe."""
    swing_period_s: Annotated[float, Range(0.1, 3600), FREE_ONLY] = 4.0
    """Period of the swing."""


def highest(target: float | TargetPoints) -> float:
    """Highest value of a target: that of a number is the number."""
    if not isinstance(target, Mapping):
        return target
    return max((value for points in target.values() for _, value in points), default=0.0)


@dataclass(frozen=True, slots=True)
class ShapeSettings:
    """`[shape]`: the surface estimator."""

    method: ShapeMethod = "recursive"
    """Estimator in the control loop."""
    memory_mm: Annotated[float, Range(0, 1000, open_low=True)] = 20.0
    """Length of path on which an estimate rests, at any speed."""
    also: Annotated[tuple[ShapeMethod, ...], DISTINCT] = ("ml", "chen1996")
    """Other estimators that compute on the same contacts after the run, for the report."""
    patch: bool = True
    """Use the second moments of the tactile images where the path leaves a curvature open."""
    revisit: bool = False
    """Join the answers of `recursive` and `ml` with a map of what the probe touched there in earlier passes."""
    every_ms: Annotated[float, Range(0, 10_000, open_low=True)] = 40.0
    """Time between two estimates. Every contact is used."""


@dataclass(frozen=True, slots=True)
class LimitSettings:
    """`[limits]`: where the cell stops for safety."""

    force_max_n: Annotated[float, Range(0, 50, open_low=True)] = 5.0
    """Highest force: the upper end of the measured one, with twice its standard deviation, stays below."""
    preload_max_n: Annotated[float, Range(0, 50)] = 0.15
    """Highest force before the run. The tare of the array would take it for zero."""
    jog_force_n: Annotated[float, Range(0, 50, open_low=True)] = 1.0
    """Force at which a motion by hand (`canprobe move`) goes back; half of `force_max_n` at most."""
    joint_margin_deg: Annotated[float, Range(0, 45)] = 1.0
    """Angle that is kept from the stops of revolute joints."""
    joint_margin_mm: Annotated[float, Range(0, 1000)] = 3.5
    """Travel that is kept from the stops of prismatic joints."""
    joint_speed_share: Annotated[float, Range(0.001, 1)] = 1.0
    """Share of the speed limits of the arm."""
    late_cycles_max_percent: Annotated[float, Range(0, 100)] = 10.0
    """Share of the cycles of the last second that may be late by half a period. 100: no limit."""
    workspace_min_mm: Vec3 | None = None
    """Lowest coordinates of the tip of the probe, or of a flange without one, in the base frame. Left out: no limit."""
    workspace_max_mm: Vec3 | None = None
    """Highest coordinates of the same in the base frame. Left out: no limit."""


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """`[servo]`: the gains of the tactile servo."""

    surface_height_hz: Annotated[float, Range(0, 50, open_low=True)] = 8.0
    """Bandwidth with which the servo corrects the height of its surface."""
    surface_tilt_hz: Annotated[float, Range(0, 50, open_low=True)] = 6.0
    """Bandwidth with which the servo corrects the normal of its surface."""
    drive_lag_ms: Annotated[float, Range(0, 100)] = 6.8
    """Lag of the drives behind a ramp: 2 ζ/ω for second-order drives."""


@dataclass(frozen=True, slots=True)
class PlantSettings:
    """`[plant]`: how the emulated arm, contact and array behave.

    With fidelity `ideal` each drive tracks as a second-order system, whatever pushes against it. `dynamic` adds rigid
    links, friction, the cascade of the drives and the push of the object; it needs the extra `dynamics`.
    """

    fidelity: Fidelity = "ideal"
    """Model of the arm."""
    true_cell: Annotated[str | None, ScenePath()] = None
    """Cell whose chain the emulated arm has where it differs from the one that the controller uses: a packaged name, or
    a path relative to the file. Its base is placed so that the start point stays where it is."""
    integrator: Annotated[Integrator, DYNAMIC_ONLY] = "rosenbrock"
    """Integrator of the equations of motion."""
    step_us: Annotated[float, Range(10, 2500), DYNAMIC_ONLY] = 625.0
    """Step of the integrator."""
    friction: Annotated[float, Range(0, 2), DYNAMIC_ONLY] = 0.3
    """Coefficient of Coulomb friction between probe and object."""
    integral_ms: Annotated[float, Range(0, 10_000), DYNAMIC_ONLY] = 20.0
    """Reset time of the velocity loops. 0: no integral part."""
    velocity_feed_forward: Annotated[float, Range(0, 1), DYNAMIC_ONLY] = 0.0
    """Share of velocity feed-forward in the drives. 1 removes their lag."""
    torque_limit_permille: Annotated[int, Range(1, 2000), DYNAMIC_ONLY] = 2000
    """Torque limit of the drives, relative to their continuous torque."""
    drive_bandwidth_hz: Annotated[float, Range(1, 1000)] = 30.0
    """Bandwidth of the drives (−3 dB)."""
    tool_error_mm: Vec3 = (0.0, 0.0, 0.0)
    """Error of the centre of the probe: where it is, less where `[probe]` has it, in the flange frame."""
    stiffness_n_m3: Annotated[float, Range(1e5, 1e12)] | None = None
    """Stiffness K/h of the emulated layer. Left out: that of `[probe]`, or 1.27e8."""
    contact_damping_s_m: Annotated[float, Range(0, 100)] = 0.3
    """Damping of the contact: α of Hunt and Crossley (assumed)."""
    noise: bool = True
    """Noise of the taxels."""
    gain_error: bool = True
    """Spread of the gains of the taxels."""
    blur: bool = True
    """Blur of the pressure by the cover."""
    hysteresis: bool = True
    """Hysteresis of the taxels."""
    creep: bool = True
    """Creep of the taxels under constant load."""
    crosstalk: bool = True
    """Crosstalk between taxels of a row or column."""
    saturation: bool = True
    """Saturation of the taxels."""
    threshold: bool = True
    """Threshold of the array, below which a taxel reads 0."""
    adc_bits: Annotated[int, Range(8, 16)] = 8
    """Resolution of the ADC. Taxels are sent in 8 bits; only the features that the array computes gain."""
    dead_rows: tuple[Annotated[int, Range(0, 255)], ...] = ()
    """Rows of the array that read nothing, from 0."""
    dead_columns: tuple[Annotated[int, Range(0, 255)], ...] = ()
    """Columns of the array that read nothing, from 0."""
    dead_taxels: tuple[tuple[int, int], ...] = ()
    """Row and column of single taxels that read nothing."""


@dataclass(frozen=True, slots=True)
class BridgeSettings:
    """`[bridge]`: other tools that receive the data of this cell, each from a separate process."""

    use: Annotated[tuple[BridgeName, ...], DISTINCT] = ()
    """Bridges to start."""
    foxglove_port: Annotated[int, Range(0, 65_535)] = 8765
    """Port of the Foxglove server. 0: the system chooses."""
    foxglove_host: Annotated[str, Pattern(r"\S+", "without spaces")] = "127.0.0.1"
    """Address of the Foxglove server. 0.0.0.0 serves other machines."""
    ros2_domain: Annotated[int, Range(0, 232)] | None = None
    """ROS 2 domain; without it that of the environment variable ROS_DOMAIN_ID, or 0."""
    ros2_loopback: bool = True
    """Keep the topics on this machine. false: other machines see them, and may send commands if allowed."""
    view_port: Annotated[int, Range(0, 65_535)] = 8080
    """Port of the 3-D view; the next free one if it is taken. 0: the system chooses."""
    view_host: Annotated[str, Pattern(r"\S+", "without spaces")] = "127.0.0.1"
    """Address of the 3-D view. 0.0.0.0 serves other machines."""
    origins: Annotated[
        tuple[Annotated[str, Pattern(r"[a-z][a-z0-9+.-]*://[^\s/]*", 'such as "https://viewer.lab:8443"')], ...],
        DISTINCT,
    ] = ()
    """Origins of further web pages that may connect to the Foxglove server and the 3-D view: those of this machine and
    of Foxglove may. Their host may stand for this machine, as behind a proxy."""
    ros2_commands: bool = False
    """Accept start, stop, target force, speed and trajectories of a free arm from ROS 2, within the scene's limits."""


@dataclass(frozen=True, slots=True)
class CellFile:
    """What a cell file may hold: the sections of a scene that describe hardware. Those that are None are absent."""

    cell: CellInfo
    bus: BusSettings | None = None
    cycle: CycleSettings | None = None
    limits: LimitSettings | None = None
    bring_up: BringUpSettings | None = None
    arm: ArmSettings | None = None
    joints: Mapping[str, JointSettings] = field(default_factory=dict)
    postures: Mapping[str, Posture] = field(default_factory=dict)
    keep_out: KeepOutSettings | None = None
    sensor: SensorSettings | None = None
    wire: WireSettings | None = None
    probe: ProbeSettings | None = None
    carrier: CarrierSettings | None = None
    servo: ServoSettings | None = None
    plant: PlantSettings | None = None
    emulate: EmulateSettings | None = None


@dataclass(frozen=True, slots=True)
class ArrayInfo:
    """`[array]`: about an array file."""

    title: str = ""
    """One line about the array."""


@dataclass(frozen=True, slots=True)
class ArrayFile:
    """What an array file may hold. Those that are None are absent."""

    array: ArrayInfo
    sensor: SensorSettings
    wire: WireSettings | None = None
    probe: ProbeSettings | None = None


@dataclass(frozen=True, slots=True)
class Scene:
    """One experiment. Sections that are None are absent."""

    scene: SceneInfo
    task: TaskSettings
    bus: BusSettings = BusSettings()  # noqa: RUF009 - frozen
    cycle: CycleSettings = CycleSettings()
    outputs: OutputSettings = OutputSettings()
    limits: LimitSettings = LimitSettings()
    bring_up: BringUpSettings = BringUpSettings()  # noqa: RUF009 - frozen
    cell: CellInfo = CellInfo()  # noqa: RUF009 - frozen
    arm: ArmSettings | None = None
    joints: Mapping[str, JointSettings] = field(default_factory=dict)
    postures: Mapping[str, Posture] = field(default_factory=dict)
    keep_out: KeepOutSettings | None = None
    sensor: SensorSettings | None = None
    wire: WireSettings | None = None
    probe: ProbeSettings | None = None
    object: ObjectSettings | None = None
    shape: ShapeSettings | None = None
    carrier: CarrierSettings | None = None
    servo: ServoSettings | None = None
    plant: PlantSettings | None = None
    bridge: BridgeSettings | None = None
    emulate: EmulateSettings | None = None

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
    def channels(self) -> tuple[str, ...]:
        """Channels that the scene names, that of `[bus]` first; not one that is left to the plan."""
        named = [joint.channel for joint in self.joints.values()]
        named += [self.carrier.channel] if self.carrier is not None else []
        named += [self.sensor.channel] if self.sensor is not None and self.sensor.channel != "auto" else []
        return tuple(dict.fromkeys((self.bus.channel, *(name for name in named if name is not None))))

    @property
    def emulated_node_ids(self) -> tuple[int, ...]:
        """The nodes that the scene wants emulated, ascending."""
        drives = [node_id for node_id, emulated in self.drives.items() if emulated]
        sensor = (self.sensor.node_id,) if self.sensor is not None and self.sensor.emulated else ()
        carrier = (self.carrier.node_id,) if self.carrier is not None and self.carrier.emulated else ()
        return tuple(sorted((*drives, *(sensor if self.array_is_node else ()), *carrier)))

    @property
    def array_is_node(self) -> bool:
        """The array is a CANopen node."""
        return self.sensor is not None and (self.wire is None or self.wire.kind == "canopen")

    @property
    def drives(self) -> dict[int, bool]:
        """Node ids of the drives in the order of the joints, and whether each is emulated; empty without an arm."""
        if self.arm is None:
            return {}
        joints = enumerate(self.joints.values(), start=1)
        return {
            joint.node_id or number: self.arm.emulated if joint.emulated is None else joint.emulated
            for number, joint in joints
        }
