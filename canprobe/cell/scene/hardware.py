"""The hardware of a cell: bus, bring-up, arm, joints with their drives, and what makes emulated drives difficult.

These sections stand in cell files (`canprobe/cells`); a scene may change single keys of them. As in
`canprobe.cell.scene.model`, a field says everything about its key.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from canprobe.cell.scene.checks import DIRECTION, DISTINCT, Check, OneOf, Only, Pattern, Range, ScenePath

Auto = Literal["auto"]  # the plan chooses
JointKind = Literal["revolute", "prismatic"]
Convention = Literal["standard", "modified"]
WhenDisabled = Literal["unknown", "brakes", "sinks"]
TactileModeName = Literal["window", "image", "features", "auto"]
CobIds = Literal["default", "by_deadline", "auto"]
Fidelity = Literal["ideal", "dynamic"]
TransmitQueue = Literal["priority", "fifo"]
Vec3 = tuple[float, float, float]
Vec6 = tuple[float, float, float, float, float, float]
Channel = Annotated[str, Pattern(r"[!-~]+", "without spaces, in ASCII")]  # as it stands in a candump log
NodeId = Annotated[int, Range(1, 126)]  # 127 is the master
SerialNumber = Annotated[int, Range(0, 0xFFFFFFFF)]

MM = 1e-3
"""A millimetre in metres."""
REVOLUTE_ONLY = Only("kind", ("revolute",))
PRISMATIC_ONLY = Only("kind", ("prismatic",))
TURNTABLE = Only("kind", ("turntable",), required=True)
CONVEYOR = Only("kind", ("conveyor",), required=True)
HOMING_ONLY = Only("zero", ("homing",))
DRIVES_ONLY = Only("kind", ("drives",))
EXTERNAL_ONLY, EXTERNAL_REQUIRED = (Only("kind", ("external",), required=given) for given in (False, True))
HOMING_METHOD = Check(
    "from -128 to 127, but not 0",
    lambda value: -128 <= value <= 127 and value != 0,
    {"minimum": -128, "maximum": 127, "not": {"const": 0}},
)


@dataclass(frozen=True, slots=True)
class CellInfo:
    """`[cell]`: the name of the cell. A scene file with this section is whole: it takes nothing from another cell."""

    name: Annotated[str, Pattern(r"[A-Za-z0-9][A-Za-z0-9_.-]*", "of letters, digits, '_', '.' and '-'")] = "cell"
    """Name of the cell."""
    title: str = ""
    """One line about the cell, which `canprobe cells` prints."""


@dataclass(frozen=True, slots=True)
class BusSettings:
    """`[bus]`: the bus that connects the nodes."""

    interface: Annotated[str, Pattern(r"[a-z0-9_-]+", "such as lockstep, socketcan, pcan")] = "lockstep"
    """`lockstep` (in this process, in virtual time), `direct` (the same without a bus: counts and images in the place
    of frames), `socketcan`, or any other python-can interface."""
    channel: Channel = "can0"
    """Channel of the interface. On a lockstep bus it is only a name in the log."""
    bitrate: Annotated[int, Range(10_000, 1_000_000)] = 1_000_000
    """Bit rate of the bus."""
    timed: bool = True
    """Lockstep: a frame takes its time on the wire, and frames wait for each other. false: no time."""
    transmit_queue: TransmitQueue = "priority"
    """Which frame a node sends first: the lowest identifier, or the oldest (`fifo`)."""
    bit_error_rate: Annotated[float, Range(0, 0.01)] = 0.0
    """Timed lockstep: share of bits that the wire corrupts."""
    fd: bool | Auto = False
    """Send PDOs of up to 64 bytes in CAN FD frames where a device has them. Other frames stay classical."""
    data_bitrate: Annotated[int, Range(10_000, 8_000_000)] = 5_000_000
    """Bit rate of the data phase of CAN FD frames."""
    cob_ids: CobIds = "default"
    """COB-IDs of the PDOs: the defaults of the cell, or priorities in the order of the deadlines."""

    @property
    def direct(self) -> bool:
        """There is no bus."""
        return self.interface == "direct"

    @property
    def virtual(self) -> bool:
        """Time is virtual, and no node is real."""
        return self.interface in ("lockstep", "direct")


@dataclass(frozen=True, slots=True)
class BringUpSettings:
    """`[bring_up]`: the time of each step of bring-up, and what happens when a step takes longer."""

    listen_s: Annotated[float, Range(0, 60)] = 0.25
    """Time in which bring-up only listens for another master."""
    boot_up_s: Annotated[float, Range(0, 600, open_low=True)] = 2.0
    """Longest time from the reset of a node to its boot-up message."""
    sdo_s: Annotated[float, Range(0, 60, open_low=True)] = 0.5
    """Longest time to one SDO answer."""
    start_s: Annotated[float, Range(0, 60, open_low=True)] = 1.0
    """Longest time from NMT start to the heartbeat that confirms it."""
    enable_s: Annotated[float, Range(0, 600, open_low=True)] = 2.0
    """Longest time in which the drives change to their mode, and from the command to enable operation to their
    confirmation. Brakes and a search for the commutation take longer."""
    stop_s: Annotated[float, Range(0, 600, open_low=True)] = 0.5
    """Longest time of a quick stop, and of disabling the drives after it."""
    emulated_s: Annotated[float, Range(0, 3600, open_low=True)] = 120.0
    """Longest time in which the process of the emulated nodes starts."""
    retries: Annotated[int, Range(0, 100)] = 2
    """How often a reset, request or start without an answer is repeated."""
    store: bool = False
    """Store the configuration in the nodes (1010h). The next bring-up finds it by 1020h and does not write it."""


@dataclass(frozen=True, slots=True)
class ArmSettings:
    """`[arm]`: the chain of the arm, and what holds for all its drives; or an arm that is not on the bus.

    The chain is either a URDF with its base and tip link, or the Denavit-Hartenberg rows of the joints. An external arm
    has neither joints nor drives: poses of its flange are read and commanded, and `cycle.rate_hz` is its rate.
    """

    kind: Literal["drives", "external"] = "drives"
    """drives: CANopen drives on the bus. external: an arm behind an interface of its own (docs/external-arm.md)."""
    address: Annotated[str | None, Pattern(r"[^\s:]+:\d{1,5}", "such as 127.0.0.1:5810"), EXTERNAL_ONLY] = None
    """Host and port at which the program of the arm listens. Left out: the arm is given in Python, or emulated."""
    delay_ms: Annotated[float, Range(0, 500), EXTERNAL_REQUIRED] = 0.0
    """Dead time from a command until the arm moves by it, with that of both ways of its interface. Its lag behind a
    ramp is `servo.drive_lag_ms`."""
    stop_after_ms: Annotated[float, Range(1, 5000), EXTERNAL_REQUIRED] = 100.0
    """Time without a command after which the arm stops by itself."""
    start_mm: Annotated[Vec3, EXTERNAL_REQUIRED] = (0.0, 0.0, 0.0)
    """Position of the flange at the start, in the base frame of the arm; `flange_deg` is its orientation there."""
    reach_mm: Annotated[float, Range(1, 5000), EXTERNAL_ONLY] = 300.0
    """Distance from `start_mm` along each axis up to which the flange may go."""
    reach_deg: Annotated[float, Range(1, 80), EXTERNAL_ONLY] = 60.0
    """Yaw, pitch and roll from `flange_deg` up to which the flange may turn."""
    speed_mm_s: Annotated[float, Range(0, 10_000, open_low=True), EXTERNAL_ONLY] = 250.0
    """Highest speed of the flange along each axis."""
    speed_deg_s: Annotated[float, Range(0, 3600, open_low=True), EXTERNAL_ONLY] = 60.0
    """Highest speed of its yaw, pitch and roll."""
    urdf: Annotated[str | None, ScenePath(), DRIVES_ONLY] = None
    """URDF file of the arm, relative to the cell file. Left out: the rows in `[joints.*]` count."""
    base: Annotated[str | None, DRIVES_ONLY] = None
    """Link of the URDF that is the base. Left out: its root."""
    tip: Annotated[str | None, DRIVES_ONLY] = None
    """Link of the URDF that is the flange. Left out: the only link without children that drives can move."""
    convention: Annotated[Convention, DRIVES_ONLY] = "standard"
    """Denavit-Hartenberg convention of the rows."""
    mount_mm: Vec3 = (0.0, 0.0, 0.0)
    """Where the chain, or the base frame of an external arm, begins in the base frame."""
    mount_deg: Vec3 = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the beginning of the chain about the fixed axes x, y and z."""
    flange_mm: Vec3 = (0.0, 0.0, 0.0)
    """Position of the flange in the last frame of the chain."""
    flange_deg: Vec3 = (0.0, 0.0, 0.0)
    """Roll, pitch and yaw of the flange in the last frame of the chain."""
    accuracy_mm: Annotated[float | None, Range(0, 100)] = None
    """Standard deviation of where the flange is in the base frame, along each axis, by the chain's lengths and zeros.
    Left out: 0.5 of a real arm, and 0 of an emulated one, which is as its file says."""
    eds: Annotated[str, ScenePath(), DRIVES_ONLY] = "puma260_joint.eds"
    """EDS of the drives that name none: a packaged name, or a path relative to the file."""
    emulated: bool = True
    """canprobe serves the drives, or emulates the external arm. false: they are real."""
    missed_syncs: Annotated[int, Range(1, 250)] = 5
    """SYNC periods of silence after which master and drives treat each other as lost."""
    grouped_rpdo: Annotated[bool | Auto, DRIVES_ONLY] = False
    """Put two targets into one RPDO by dummy mapping."""
    torque: Annotated[bool, DRIVES_ONLY] = True
    """Map the motor torque (6077h) into the TPDO of each drive, where the drive has it and the bus has room for it."""
    when_disabled: WhenDisabled = "unknown"
    """What the arm does when its drives are disabled: its brakes hold it, or it sinks. It is said before a person
    lets it move by hand."""
    temperature_object: Annotated[str | None, Pattern(r"[0-9A-Fa-f]{4}h(:[0-9A-Fa-f]{2})?", "such as 3201h:01")] = None
    """Entry of the drives that has their temperature, as their manual names it, for `canprobe console`."""
    temperature_unit_c: Annotated[float, Range(0, 100, open_low=True)] = 1.0
    """Unit of `temperature_object`, °C."""


@dataclass(frozen=True, slots=True)
class KeepOutSettings:
    """`[keep_out]`: places that the arm and its probe stay out of when it is moved by hand (`canprobe move`)."""

    floor_mm: Annotated[float | None, Range(-100_000, 100_000)] = None
    """Height of a floor in the base frame. Left out: no floor."""
    boxes_mm: tuple[tuple[Vec3, Vec3], ...] = ()
    """Boxes in the base frame, each by its lowest and its highest corner."""
    link_radius_mm: Annotated[float, Range(0, 2000)] = 50.0
    """Radius of links for which the URDF has no collision solids, round the straight lines from joint to joint, and of
    what holds the probe. The probe has that of `[probe]`."""


@dataclass(frozen=True, slots=True)
class JointSettings:
    """`[joints.NAME]`: one joint and its drive. The sections stand in the order of the joints, from the base.

    A revolute joint has its lengths in degrees, a prismatic joint in millimetres. With a URDF, names are those of its
    joints, and what a section leaves out is taken from the URDF. Positions of the drive are
    `zero_counts + sign * counts_per_turn * (gear * turns of the joint + coupling)`, or counts_per_m times metres.
    """

    kind: JointKind = "revolute"
    """Turns about its axis, or slides along it."""
    a_mm: float = 0.0
    """Denavit-Hartenberg row: length a of the link."""
    alpha_deg: float = 0.0
    """Denavit-Hartenberg row: twist of the link."""
    d_mm: float = 0.0
    """Denavit-Hartenberg row: offset d along the axis; of a prismatic joint, what its position is added to."""
    theta_deg: float = 0.0
    """Denavit-Hartenberg row: angle about the axis; of a revolute joint, what its position is added to."""
    min_deg: Annotated[float | None, Range(-3600, 3600), REVOLUTE_ONLY] = None
    """Lowest position."""
    max_deg: Annotated[float | None, Range(-3600, 3600), REVOLUTE_ONLY] = None
    """Highest position."""
    speed_deg_s: Annotated[float | None, Range(0, 36_000, open_low=True), REVOLUTE_ONLY] = None
    """Highest speed."""
    acceleration_deg_s2: Annotated[float | None, Range(0, 1e6, open_low=True), REVOLUTE_ONLY] = None
    """Highest acceleration of a motion by hand (`canprobe move`), reached in 50 ms. Left out: the speed in 0.5 s."""
    start_deg: Annotated[float, Range(-3600, 3600), REVOLUTE_ONLY] = 0.0
    """Start posture. It selects the branch of the inverse kinematics. An emulated arm starts here in `free`, and
    above the start point in other tasks."""
    swing_deg: Annotated[float, Range(0, 360), REVOLUTE_ONLY] = 5.0
    """Amplitude of the swing in `free`."""
    min_mm: Annotated[float | None, Range(-100_000, 100_000), PRISMATIC_ONLY] = None
    """Lowest position."""
    max_mm: Annotated[float | None, Range(-100_000, 100_000), PRISMATIC_ONLY] = None
    """Highest position."""
    speed_mm_s: Annotated[float | None, Range(0, 100_000, open_low=True), PRISMATIC_ONLY] = None
    """Highest speed."""
    acceleration_mm_s2: Annotated[float | None, Range(0, 1e6, open_low=True), PRISMATIC_ONLY] = None
    """Highest acceleration of a motion by hand (`canprobe move`), reached in 50 ms. Left out: the speed in 0.5 s."""
    start_mm: Annotated[float, Range(-100_000, 100_000), PRISMATIC_ONLY] = 0.0
    """Start posture."""
    swing_mm: Annotated[float, Range(0, 10_000), PRISMATIC_ONLY] = 10.0
    """Amplitude of the swing in `free`."""
    node_id: NodeId | None = None
    """Node id of the drive. Left out: the number of the joint, from 1."""
    channel: Channel | None = None
    """Channel of the bus that the drive is on. Left out: `bus.channel`. Node ids differ on all buses together."""
    eds: Annotated[str | None, ScenePath()] = None
    """EDS of the drive. Left out: `arm.eds`."""
    emulated: bool | None = None
    """canprobe serves the drive. Left out: `arm.emulated`."""
    serial_number: SerialNumber | None = None
    """Serial number (1018h:04) that the drive must have. Left out: any."""
    counts_per_turn: Annotated[float | None, Range(1, 1e9), REVOLUTE_ONLY] = None
    """Position units of the drive per turn of its motor."""
    counts_per_m: Annotated[float | None, Range(1, 1e12), PRISMATIC_ONLY] = None
    """Position units of the drive per metre of its carriage, where `gear` is 1."""
    gear: Annotated[float, Range(0, 100_000, open_low=True)] = 1.0
    """Turns of the motor per turn of the joint."""
    sign: Annotated[int, OneOf((1, -1))] = 1
    """-1: the drive counts down where the joint moves up."""
    zero_counts: int = 0
    """Position of the drive where the joint is at 0."""
    coupling: Mapping[str, float] | None = None
    """Turns of this motor per turn of other joints, by their names: a wrist whose motors stand in the forearm."""
    zero: Literal["absolute", "homing"] = "absolute"
    """absolute: the drive knows its position after power on. homing: it has to be homed, by `canprobe home`."""
    homing_method: Annotated[int | None, HOMING_METHOD, Only("zero", ("homing",), required=True)] = None
    """Homing method (6098h), such as 17 for the negative limit switch, 35 or 37 for where the joint stands."""
    homing_order: Annotated[int | None, Range(1, 1000), HOMING_ONLY] = None
    """Joints of lower numbers are homed first. Left out: the number of the joint, from 1."""
    home_deg: Annotated[float | None, Range(-3600, 3600), REVOLUTE_ONLY, HOMING_ONLY] = None
    """Position of the joint at its home position. The home offset (607Ch) follows from it."""
    homing_speed_deg_s: Annotated[float, Range(0, 36_000, open_low=True), REVOLUTE_ONLY, HOMING_ONLY] = 5.0
    """Speed of the search for the switch (6099h:01)."""
    homing_zero_speed_deg_s: Annotated[float, Range(0, 36_000, open_low=True), REVOLUTE_ONLY, HOMING_ONLY] = 1.0
    """Speed of the search for the edge of the switch or the index pulse (6099h:02)."""
    homing_acceleration_deg_s2: Annotated[float, Range(0, 360_000, open_low=True), REVOLUTE_ONLY, HOMING_ONLY] = 20.0
    """Acceleration in homing (609Ah)."""
    home_mm: Annotated[float | None, Range(-100_000, 100_000), PRISMATIC_ONLY, HOMING_ONLY] = None
    """Position of the joint at its home position. The home offset (607Ch) follows from it."""
    homing_speed_mm_s: Annotated[float, Range(0, 100_000, open_low=True), PRISMATIC_ONLY, HOMING_ONLY] = 10.0
    """Speed of the search for the switch (6099h:01)."""
    homing_zero_speed_mm_s: Annotated[float, Range(0, 100_000, open_low=True), PRISMATIC_ONLY, HOMING_ONLY] = 2.0
    """Speed of the search for the edge of the switch or the index pulse (6099h:02)."""
    homing_acceleration_mm_s2: Annotated[float, Range(0, 1e6, open_low=True), PRISMATIC_ONLY, HOMING_ONLY] = 50.0
    """Acceleration in homing (609Ah)."""
    homing_timeout_s: Annotated[float, Range(1, 3600), HOMING_ONLY] = 180.0
    """Longest time of one homing run."""
    noise_counts: Annotated[float, Range(0, 10_000)] = 0.0
    """Standard deviation of the emulated encoder, besides `emulate.noise_counts`."""
    rated_torque_nm: Annotated[float | None, Range(0, 1e6, open_low=True), REVOLUTE_ONLY] = None
    """Continuous torque of the drive at the joint; 6071h and 6077h are thousandths of it. Left out: that of the URDF,
    or 10."""
    rotor_inertia_kg_m2: Annotated[float | None, Range(0, 1e6, open_low=True), REVOLUTE_ONLY] = None
    """Inertia of the motor at the joint. Left out: 0.05."""
    coulomb_nm: Annotated[float | None, Range(0, 1e6), REVOLUTE_ONLY] = None
    """Coulomb friction at the joint. Left out: that of the URDF, or 0.5."""
    viscous_nm_s: Annotated[float | None, Range(0, 1e6), REVOLUTE_ONLY] = None
    """Viscous friction at the joint. Left out: that of the URDF, or 0.3."""
    rated_force_n: Annotated[float | None, Range(0, 1e6, open_low=True), PRISMATIC_ONLY] = None
    """Continuous force of the drive. Left out: 200."""
    rotor_mass_kg: Annotated[float | None, Range(0, 1e6, open_low=True), PRISMATIC_ONLY] = None
    """Inertia of the motor, seen at the carriage. Left out: 5."""
    coulomb_n: Annotated[float | None, Range(0, 1e6), PRISMATIC_ONLY] = None
    """Coulomb friction. Left out: 20."""
    viscous_n_s_m: Annotated[float | None, Range(0, 1e6), PRISMATIC_ONLY] = None
    """Viscous friction. Left out: 20."""
    stiffness_nm_rad: Annotated[float | None, Range(1, 1e9), REVOLUTE_ONLY] = None
    """Stiffness of the emulated joint between its motor, which the encoder is on, and its link. Left out: rigid. Of an
    ideal arm, that of its own cell."""
    stiffness_n_m: Annotated[float | None, Range(1, 1e12), PRISMATIC_ONLY] = None
    """Stiffness of a prismatic joint between its motor and its link."""
    mass_kg: Annotated[float | None, Range(0, 1e5)] = None
    """Mass of the link behind the joint. Without the masses of all links an arm of rows cannot be `dynamic`."""
    com_mm: Vec3 = (0.0, 0.0, 0.0)
    """Centre of mass of the link, in the frame of its Denavit-Hartenberg row."""
    inertia_kg_m2: Vec6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """Inertia of the link about its centre of mass: xx, yy, zz, xy, xz, yz."""


@dataclass(frozen=True, slots=True)
class CarrierSettings:
    """`[carrier]`: what the object stands on and moves with: a turntable or a conveyor with an encoder (CiA 406).

    Where the encoder shows position 0 the object is where the scene places it; start point and path move with it.
    Positions of the encoder are `zero_counts + counts_per_turn * turns`, or counts_per_m times metres.
    """

    kind: Literal["turntable", "conveyor"] = "turntable"
    """Turns about its axis, or moves along it."""
    axis: Annotated[Vec3, DIRECTION] = (0.0, 0.0, 1.0)
    """Direction of the axis in the base frame, of any length. Counts grow counter-clockwise about it, or along it."""
    point_mm: Annotated[Vec3 | None, TURNTABLE] = None
    """Point of the axis in the base frame."""
    speed_deg_s: Annotated[float | None, Range(0, 360, open_low=True), TURNTABLE] = None
    """Speed with which the plan counts from position 0 on, and an emulated one turns. A report of a motion faster than
    1.5 times that is not believed."""
    speed_mm_s: Annotated[float | None, Range(0, 1000, open_low=True), CONVEYOR] = None
    """The same of a conveyor."""
    counts_per_turn: Annotated[float | None, Range(1, 1e9), TURNTABLE] = None
    """Units of the position value (6004h) per turn of the table."""
    counts_per_m: Annotated[float | None, Range(1, 1e12), CONVEYOR] = None
    """Units of the position value per metre of the conveyor."""
    zero_counts: int = 0
    """Position value where the object is where the scene places it."""
    node_id: NodeId = 17
    """Node id of the encoder."""
    channel: Channel | None = None
    """Channel of the bus that the encoder is on. Left out: `bus.channel`."""
    eds: Annotated[str, ScenePath()] = "encoder.eds"
    """EDS of the encoder: a packaged name, or a path relative to the file."""
    emulated: bool = True
    """canprobe serves the encoder, and moves the emulated object. false: the encoder is real."""
    serial_number: SerialNumber | None = None
    """Serial number (1018h:04) that the encoder must have. Left out: any."""


@dataclass(frozen=True, slots=True)
class EmulateSettings:
    """`[emulate]`: what makes the emulated drives difficult, to rehearse a drive that is."""

    nodes: Annotated[tuple[NodeId, ...], DISTINCT] = ()
    """Node ids of the drives concerned. Empty: all emulated drives."""
    refuse: Annotated[tuple[Annotated[str, Pattern(r"[0-9A-Fa-f]{4}h", "such as 60C2h")], ...], DISTINCT] = ()
    """Objects that refuse every write (SDO abort 06010000h)."""
    boot_s: Annotated[float, Range(0, 60)] = 0.0
    """Time from reset to the boot-up message."""
    sdo_ms: Annotated[float, Range(0, 60_000)] = 0.0
    """Time to each SDO answer."""
    fixed_mapping: bool = False
    """Mappings and COB-IDs of PDOs cannot be changed."""
    tpdo_delay_us: Annotated[float, Range(0, 1_000_000)] = 0.0
    """Time from SYNC to the TPDOs."""
    cob_id_bit30: Literal["free", "keep"] = "free"
    """keep: a write that changes bit 30 of a COB-ID of a TPDO is refused."""
    brake_early_ms: Annotated[float, Range(0, 10_000)] = 0.0
    """Time from the opening of the brakes to torque in the motors: a vertical axis of a dynamic arm falls."""
    noise_counts: Annotated[float, Range(0, 10_000)] = 0.0
    """Standard deviation of the encoders."""
