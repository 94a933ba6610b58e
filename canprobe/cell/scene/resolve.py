"""Scene → setup: the only place where a scene's millimetres, degrees and defaults become SI."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from canprobe.cell.scene.geometry import T_flange_probe, expected_ball, refuse_narrow, scan_axes, true_object
from canprobe.cell.scene.hardware import MM, ArmSettings, EmulateSettings, JointSettings
from canprobe.cell.scene.load import read_cell, with_files
from canprobe.cell.scene.model import (
    BridgeSettings,
    LimitSettings,
    PlantSettings,
    ProbeSettings,
    Scene,
    SensorSettings,
    ServoSettings,
    TaskSettings,
    WireSettings,
    highest,
)
from canprobe.cell.scene.rules import START, image_format
from canprobe.cell.scene.setup import (
    Approach,
    Arm,
    Array,
    Calibrate,
    Carrier,
    Drive,
    Dynamics,
    Free,
    Listen,
    Probe,
    RawWire,
    SafetyLimits,
    Scan,
    Setup,
    Shape,
    TargetTable,
    Task,
    Touch,
    Truth,
)
from canprobe.cell.scene.units import in_si
from canprobe.errors import PlanError
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.protocol.frames import Frame

if TYPE_CHECKING:
    from canprobe.cell.scene.arms import Bodies
    from canprobe.mechanics.robot.keep_out import KeepOut
    from canprobe.mechanics.robot.model import ArmModel
    from canprobe.mechanics.touch import ArrayCalibration
    from canprobe.mechanics.types import Floats

SEARCH = 8e-3
"""Distance beyond the expected place at which an approach gives up, m."""
EASED_SHARE = 0.5
"""Share of speed and force down to which a scan lowers them by what the estimator answers."""
LAYER_STIFFNESS = 1.27e8
"""Stiffness of the emulated layer where nothing else is stated."""
ARM_ACCURACY_MM = 0.5
"""Standard deviation of the flange's place of a real arm whose file states none: arms of this size whose chain nobody
has calibrated are off by some tenths of a millimetre."""
EMULATED_ARRAY = "inch16"
"""Calibration of the emulated array."""
LATENCY_SIGMAS = 3.0
"""Standard deviations from which on a calibrated latency counts as different from 0."""
EFFECTS = ("noise", "gain_error", "blur", "hysteresis", "creep", "crosstalk", "saturation", "threshold")


def resolve(scene: Scene) -> Setup:
    """The setup of a scene.

    Args:
        scene: a scene as `load_scene` gave it, or changed since.

    Raises:
        PlanError: the scene describes an object without a surface.
        SceneError: a file that it names cannot be read.
    """
    saved, files = with_files(scene)
    arm, bodies = _arm(scene)
    settings = scene.probe or ProbeSettings()
    array = _array(scene, settings.radius_mm * MM, settings.stiffness_n_m3)
    T, radius = T_flange_probe(settings), settings.radius_mm * MM
    is_flat = array is not None and array.pad.is_flat
    if is_flat:  # it is a sphere of a very large radius; the point of its pole stays
        from canprobe.mechanics.touch.pad import FLAT_RADIUS_M

        T[:3, 3] += (radius - FLAT_RADIUS_M) * T[:3, 2]
        radius = FLAT_RADIUS_M
    stiffness = array.calibration.image.stiffness if array is not None else LAYER_STIFFNESS
    bare = scene.probe is None and scene.sensor is None
    keep_out, lacking = _keep_out(scene, arm, None if bare else settings)
    if arm is not None:
        arm = replace(arm, warnings=(*arm.warnings, *lacking))
    probe = Probe(np.eye(4), 0.0, stiffness, 0.0)
    if not bare:
        sd = settings.position_sd_mm * MM
        probe = Probe(T, radius, stiffness, settings.mass_kg, sd, math.hypot(sd, _arm_accuracy(scene.arm)), is_flat)
    return Setup(
        scene=scene,
        saved=saved,
        files=files,
        name=scene.name,
        title=scene.title,
        seed=scene.seed,
        outputs=scene.outputs,
        bus=scene.bus,
        rate_hz=scene.cycle.rate_hz,
        realtime=scene.cycle.realtime,
        compute_ns=round(scene.cycle.compute_us * 1000),
        limits=_limits(scene.limits, arm, keep_out),
        bring_up=scene.bring_up,
        bridge=scene.bridge or BridgeSettings(),
        arm=arm,
        array=array,
        probe=probe,
        kind=scene.task.kind,
        task=_task(scene, arm, array, probe),
        truth=_truth(scene, arm, array, bodies, probe),
    )


def _arm_accuracy(settings: ArmSettings | None) -> float:
    """Standard deviation of the flange's place in base, per axis, m."""
    if settings is None:
        return 0.0
    stated = 0.0 if settings.emulated else ARM_ACCURACY_MM
    return (stated if settings.accuracy_mm is None else settings.accuracy_mm) * MM


def _arm(scene: Scene) -> tuple[Arm | None, Bodies]:
    """The arm, and the bodies of its links."""
    if scene.arm is None:
        return None, None
    from canprobe.cell.scene.arms import arm_model, external_arm, homing_of, per_joint, posture_in_si

    settings, joints = scene.arm, scene.joints
    if settings.kind == "external":
        return external_arm(scene.cell.name, settings, scene.cycle.rate_hz), None
    model, bodies, warnings = arm_model(scene.cell.name, settings, joints)
    each = zip(scene.drives.items(), joints.values(), strict=True)
    drives = tuple(
        Drive(
            node_id=node_id,
            channel=joint.channel or scene.bus.channel,
            eds=joint.eds or settings.eds,
            emulated=emulated,
            serial=joint.serial_number,
            zero=homing_of(joint, number),
            turn_units=joint.counts_per_turn if joint.kind == "revolute" else None,
            metre_units=joint.counts_per_m if joint.kind == "prismatic" else None,
            gear=joint.gear,
            quirks=_quirks(scene.emulate, node_id, joint.noise_counts),
        )
        for number, ((node_id, emulated), joint) in enumerate(each, start=1)
    )
    named = {name: posture_in_si(joints, posture) for name, posture in scene.postures.items()}
    q_start = per_joint(joints, "start") if scene.task.start_posture is None else named[scene.task.start_posture]
    postures = {START: q_start} | named
    waits, grouped, torque = settings.missed_syncs, settings.grouped_rpdo, settings.torque
    temperature = None
    if settings.temperature_object is not None:
        index, _, subindex = settings.temperature_object.partition("h:")
        temperature = int(index, 16), int(subindex or "0", 16), settings.temperature_unit_c
    arm = Arm(model, drives, q_start, waits, grouped, torque, warnings, postures, temperature, settings.when_disabled)
    return arm, bodies


def _quirks(settings: EmulateSettings | None, node_id: int, noise: float) -> Quirks | None:
    """The difficulties of an emulated drive; None where it has none."""
    if settings is None or (settings.nodes and node_id not in settings.nodes):
        settings = EmulateSettings()
    quirks = Quirks(
        refuse=tuple(int(index[:4], 16) for index in settings.refuse),
        boot_ns=round(settings.boot_s * 1e9),
        sdo_ns=round(settings.sdo_ms * 1e6),
        fixed_mapping=settings.fixed_mapping,
        tpdo_delay_ns=round(settings.tpdo_delay_us * 1e3),
        noise_counts=math.hypot(settings.noise_counts, noise),
        keep_bit30=settings.cob_id_bit30 == "keep",
        brake_early_ns=round(settings.brake_early_ms * 1e6),
    )
    return None if quirks == Quirks() else quirks


def _array(scene: Scene, radius: float, stiffness: float | None) -> Array | None:
    """The array with its calibration, and the wire of one that is no CANopen node.

    Args:
        scene: a scene with or without an array.
        radius: radius of the sphere that it may be wrapped on, m.
        stiffness: stiffness of the layer, N/m³; None: the calibrated one.
    """
    settings = scene.sensor
    if settings is None:
        return None
    from canprobe.cell.scene.calibrations import load_calibration
    from canprobe.mechanics.touch.image.force_errors import UNSTATED
    from canprobe.mechanics.touch.pad import Pad

    calibration = load_calibration(settings.calibration or EMULATED_ARRAY)
    calibrated = settings.calibration is not None or settings.emulated
    serial = settings.serial_number
    if serial is None and scene.array_is_node:  # which bring-up asks
        serial = calibration.serial_number
    if not calibrated:  # creep of the emulated array says nothing about a real one
        calibration = replace(calibration, force=UNSTATED)
    if not calibrated or calibration.serial_number not in (None, serial):
        calibration = calibration.of_another()
    positions, normals = (
        np.array(one) if one is not None else None for one in (settings.positions_mm, settings.normals)
    )
    pitch = settings.pitch_mm
    full_scale, mount = settings.full_scale_kpa * 1e3, None if settings.mount == "flat" else radius
    if positions is None or isinstance(pitch, tuple):
        sides = pitch if isinstance(pitch, tuple) else (pitch, pitch)
        pad = Pad.of_grid(
            settings.rows,
            settings.columns,
            (sides[0] * MM, sides[1] * MM),
            full_scale_pa=full_scale,
            mount_radius_m=mount,
        )
    else:
        pad = Pad(
            settings.rows,
            settings.columns,
            pitch * MM,
            full_scale,
            mount,
            positions=positions * MM,
            normals=normals / np.linalg.norm(normals, axis=1, keepdims=True) if normals is not None else None,
        )
    if pad.is_flat:  # the scatter of its centroid is not known: a calibration is of an array on a sphere
        calibration = replace(calibration, noise=replace(calibration.noise, assumed=True))
    return Array(
        node_id=settings.node_id,
        channel=settings.channel or scene.bus.channel,
        eds=settings.eds,
        emulated=settings.emulated,
        serial=serial if scene.array_is_node and isinstance(serial, int) else None,
        name=settings.array,
        mode=settings.mode,
        window=settings.window,
        rate_hz=settings.rate_hz,
        pad=pad,
        calibration=calibration if stiffness is None else calibration.with_stiffness(stiffness),
        calibrated=calibrated,
        raw=None if scene.array_is_node or scene.wire is None else _raw_wire(scene.wire, settings, calibration),
    )


def _carrier(scene: Scene) -> Carrier | None:
    if (settings := scene.carrier) is None:
        return None
    from canprobe.mechanics.touch.carrier import CarrierMotion

    s, si, point, units = settings, in_si(settings), None, settings.counts_per_m
    if s.counts_per_turn is not None:
        point, units = np.array(si["point"]), s.counts_per_turn / (2.0 * math.pi)
    motion = CarrierMotion(np.array(s.axis) / np.linalg.norm(s.axis), point)
    node = s.node_id, s.channel or scene.bus.channel, s.eds, s.emulated, s.serial_number
    return Carrier(*node, motion, speed=si["speed"], units=units or 1.0, zero=s.zero_counts)


def _raw_wire(wire: WireSettings, settings: SensorSettings, calibration: ArrayCalibration) -> RawWire:
    found = calibration.centroid
    sure = settings.calibration is not None and abs(found.latency_s) > LATENCY_SIGMAS * found.latency_sigma_s
    return RawWire(
        image=image_format(wire, settings.rows, settings.columns),
        serial=settings.serial_number,
        normal=wire.normal_axis - 1,
        unloaded=wire.unloaded_counts,
        full_scale=wire.full_scale_counts,
        tare_images=wire.tare_images,
        sampling=wire.sampling,
        start=tuple(map(_frame, wire.start)),
        stop=tuple(map(_frame, wire.stop)),
        poll=tuple(map(_frame, wire.poll)),
        latency_s=wire.latency_ms * 1e-3,
        latency_sigma_s=wire.latency_sigma_ms * 1e-3,
        found_s=found.latency_s if sure else 0.0,
        found_sigma_s=found.latency_sigma_s if sure else 0.0,
    )


def _frame(text: str) -> Frame:
    """A frame as cansend writes it."""
    can_id, _, data = text.partition("#")
    return int(can_id, 16), bytes.fromhex(data)


def _keep_out(scene: Scene, arm: Arm | None, probe: ProbeSettings | None) -> tuple[KeepOut | None, tuple[str, ...]]:
    """What the arm keeps out of, and warnings about the collision solids of its URDF."""
    settings = scene.keep_out
    if scene.arm is None or arm is None or settings is None or (settings.floor_mm is None and not settings.boxes_mm):
        return None, ()
    from canprobe.cell.scene.urdf_solids import link_spheres
    from canprobe.mechanics.robot.keep_out import KeepOut

    floor = -math.inf if settings.floor_mm is None else settings.floor_mm * MM
    boxes = np.array(settings.boxes_mm, dtype=float).reshape(-1, 2, 3) * MM
    radius = settings.link_radius_mm * MM
    centre, size = (np.zeros(3), radius) if probe is None else (T_flange_probe(probe)[:3, 3], probe.radius_mm * MM)
    keep_out = KeepOut(floor, boxes, radius, centre, size)
    if (urdf := scene.arm.urdf) is None:
        return keep_out, ()
    spheres, lacking = link_spheres(Path(urdf), scene.arm.base, scene.arm.tip, arm.model.chain)
    return replace(keep_out, spheres=spheres), lacking


def _limits(settings: LimitSettings, arm: Arm | None, keep_out: KeepOut | None) -> SafetyLimits:
    low, high = settings.workspace_min_mm, settings.workspace_max_mm
    slides = [] if arm is None else [joint.prismatic for joint in arm.model.joints]
    bounded = low is not None or high is not None
    return SafetyLimits(
        force_max=settings.force_max_n,
        preload_max=settings.preload_max_n,
        jog_force=min(settings.jog_force_n, 0.5 * settings.force_max_n),
        joint_margin=np.where(slides, settings.joint_margin_mm * MM, math.radians(settings.joint_margin_deg)),
        speed_share=settings.joint_speed_share,
        late_share=settings.late_cycles_max_percent / 100,
        workspace=np.array([low or (-math.inf,) * 3, high or (math.inf,) * 3]) * MM if bounded else None,
        keep_out=keep_out,
    )


def _task(scene: Scene, arm: Arm | None, array: Array | None, probe: Probe) -> Task:
    """The setup of the task; `canprobe.cell.scene.rules` has checked that the scene has what it needs."""
    settings = scene.task
    if settings.kind == "free":
        from canprobe.cell.scene.arms import EXTERNAL_SWING, per_joint

        assert arm is not None
        swing = EXTERNAL_SWING if arm.external is not None else per_joint(scene.joints, "swing")
        return Free(arm, swing, settings.swing_period_s, settings.duration_s)
    assert array is not None
    if settings.kind == "listen":
        return Listen(array, probe, settings.duration_s)
    from canprobe.mechanics.touch.servo import SurfaceGains
    from canprobe.mechanics.touch.stops import depth_on_bluntest, depth_on_plane

    assert arm is not None
    servo = scene.servo or ServoSettings()
    most = scene.limits.force_max_n  # presses as deep as a blind search goes
    pressed = depth_on_plane(most, probe.stiffness, probe.radius)
    if probe.is_flat:
        pressed = depth_on_bluntest(most, probe.stiffness, array.pad.reach_m)
    touching: dict[str, Any] = {
        "arm": arm,
        "array": array,
        "probe": probe,
        "approach": Approach(
            start=np.array(settings.start_mm) * MM,
            axes=scan_axes(settings),
            speed=settings.approach_mm_s * MM,
            clearance=settings.clearance_mm * MM,
            search=SEARCH if settings.search_mm is None else settings.search_mm * MM,
            blind_search=min(SEARCH, pressed) if settings.search_mm is None else settings.search_mm * MM,
        ),
        "force": highest(settings.force_n),
        "tables": _target_tables(settings),
        "duration_s": settings.duration_s,
        "lag_s": servo.drive_lag_ms * 1e-3 + arm.delay_s,
        "carrier": _carrier(scene),
    }
    if settings.kind == "calibrate":
        from canprobe.mechanics.robot.tool_calibration import ball_approaches

        centre, radius = expected_ball(settings)
        tilt, beside = math.radians(settings.tilt_deg), math.radians(settings.beside_deg)
        return Calibrate(
            **touching,
            ball_centre=centre,
            ball_radius=radius,
            ball_sigma=settings.ball_sigma_mm * MM,
            approaches=ball_approaches(settings.touches, tilt, beside, touching["approach"].normal),
        )
    scan, shape = None, None
    if settings.kind == "scan":
        scan = _scan(settings, arm)
        if (s := scene.shape) is not None:
            shape = Shape(s.method, s.also, s.memory_mm * MM, s.every_ms * 1e-3, s.patch, s.revisit)
    gains = SurfaceGains(servo.surface_height_hz, servo.surface_tilt_hz)
    return Touch(**touching, gains=gains, sigma_wanted=settings.light_below_per_m, scan=scan, shape=shape)


def _scan(settings: TaskSettings, arm: Arm) -> Scan:
    from canprobe.mechanics.robot.inverse import FIXED_POLE, task_rows
    from canprobe.mechanics.touch.strategies import Rectangle, make_strategy

    length, width = settings.length_mm * MM, settings.width_mm * MM
    return Scan(
        strategy=Rectangle(length, width, settings.target_sigma_um * 1e-6)
        if settings.strategy == "explore"
        else make_strategy(settings.strategy, length, width, settings.wavelength_mm * MM),
        name=settings.strategy,
        speed=highest(settings.speed_mm_s) * MM,
        rolling_share=1.0 if task_rows(arm.model) == FIXED_POLE else settings.rolling_share,
        regain=settings.regain_mm * MM,
    )


def _target_tables(settings: TaskSettings) -> dict[str, TargetTable]:
    """The targets that are no numbers, or that answers of the estimator lower."""
    tables = {}
    for name, target, unit, eased in (
        ("target_force_n", settings.force_n, 1.0, settings.light_below_per_m is not None),
        ("speed_m_s", settings.speed_mm_s, MM, settings.slow_at_changes),
    ):
        if eased or isinstance(target, Mapping):
            ((over, points),) = target.items() if isinstance(target, Mapping) else [("time_s", [(0.0, target)])]
            places, values = np.array(points).T * [[MM if over == "path_mm" else 1.0], [unit]]
            tables[name] = TargetTable(over == "path_mm", places, values, EASED_SHARE if eased else 1.0)
    return tables


def _true_arm(scene: Scene, arm: Arm | None, bodies: Bodies) -> tuple[ArmModel | None, Bodies]:
    """The arm that is emulated, and the bodies of its links."""
    if arm is None:
        return None, None
    other = scene.plant.true_cell if scene.plant is not None else None
    if other is None:
        return arm.model, bodies
    from canprobe.cell.scene.arms import arm_model

    cell = read_cell(other)
    if cell.arm is None or len(cell.joints) != arm.model.n:
        raise PlanError([f"plant.true_cell: expected a cell with an arm of {arm.model.n} joints, got {other}"])
    return arm_model(cell.cell.name, cell.arm, cell.joints)[:2]


def _dead_taxels(plant: PlantSettings, array: Array | None) -> tuple[tuple[int, int], ...]:
    """(row, column) of the taxels of the emulated array that read nothing."""
    if array is None:
        return ()
    rows, columns = array.pad.shape
    dead = {(row, column) for row in plant.dead_rows for column in range(columns)}
    dead |= {(row, column) for column in plant.dead_columns for row in range(rows)}
    dead |= set(plant.dead_taxels)
    if outside := [place for place in sorted(dead) if not (0 <= place[0] < rows and 0 <= place[1] < columns)]:
        raise PlanError([f"plant.dead_taxels: expected taxels of {rows} × {columns}, got {outside[0]}"])
    return tuple(sorted(dead))


def _joint_compliance(sections: Mapping[str, JointSettings]) -> Floats | None:
    """(n,) compliance of the joints, rad/(N m) or m/N; None where all are rigid."""
    stiffness = [in_si(section).get("stiffness") for section in sections.values()]
    return np.array([0.0 if k is None else 1.0 / k for k in stiffness]) if any(stiffness) else None


def _truth(scene: Scene, arm: Arm | None, array: Array | None, bodies: Bodies, probe: Probe) -> Truth:
    plant, shape = scene.plant or PlantSettings(), None
    if scene.object is not None:
        from canprobe.mechanics.touch.heights import Heights

        try:
            shape = true_object(scene.object)
            if isinstance(shape, Heights) and array is not None:
                refuse_narrow(scene.object, shape, array.pad)
        except ValueError as error:
            raise PlanError([f"object: {error}"]) from error
    T_flange_there = probe.T_flange_probe.copy()
    T_flange_there[:3, 3] += np.array(plant.tool_error_mm) * MM
    model, bodies = _true_arm(scene, arm, bodies)
    return Truth(
        object=shape,
        model=model,
        bodies=bodies,
        compliance=_joint_compliance(scene.joints),
        T_flange_probe=T_flange_there,
        stiffness=plant.stiffness_n_m3 or (scene.probe.stiffness_n_m3 if scene.probe else None) or LAYER_STIFFNESS,
        damping=plant.contact_damping_s_m,
        bandwidth_hz=plant.drive_bandwidth_hz,
        fidelity=plant.fidelity,
        dynamics=Dynamics(
            payload=probe.mass,
            friction=plant.friction,
            integral_s=plant.integral_ms * 1e-3,
            velocity_feed_forward=plant.velocity_feed_forward,
            torque_limit_permille=plant.torque_limit_permille,
            integrator=plant.integrator,
            step_ns=round(plant.step_us * 1000),
        ),
        without=tuple(effect for effect in EFFECTS if not getattr(plant, effect)),
        adc_bits=plant.adc_bits,
        dead=_dead_taxels(plant, array),
    )
