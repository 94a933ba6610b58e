"""Touch a plane, a ball and a rod with the arm of a cell, and calibrate its array by the images of them.

Thirty-nine touches: the plane at 4 places of the pad with 3 forces, three reference loads, two short rolls to and fro
at two speeds along both axes of the pad; the ball at 9 places with 2 forces; plane and ball once more with the probe
turned about its pole by half a turn; the rod at two angles, only to verify. Each is a press of `tasks.calibrate` on a
cell that is brought up for one object and stopped again. An emulated cell has the objects; at a real one a person is
asked for them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.options import RunOptions, Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.motion import reach_problems
from canprobe.cell.scene.calibrations import dump_calibration, load_calibration
from canprobe.cell.scene.geometry import true_object
from canprobe.cell.scene.hardware import Vec3
from canprobe.cell.scene.load import load_scene, packaged_files
from canprobe.cell.scene.model import ObjectSettings, Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Touch
from canprobe.cell.session.session import Session
from canprobe.cell.session.target import LOCKSTEP, Target
from canprobe.cell.tasks.calibrate import Press, RollRecord, RollTask
from canprobe.cell.tasks.from_plan import make_sensing
from canprobe.cell.tasks.task import Phase
from canprobe.errors import PlanError, UsageError
from canprobe.fieldbus.bus.files import write_text
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.robot.inverse import task_rows
from canprobe.mechanics.touch import calibrate_array
from canprobe.mechanics.touch.array_calibration.calibrate import ArrayFit
from canprobe.mechanics.touch.array_calibration.touches import Dwell
from canprobe.mechanics.touch.array_calibration.verify import Verification, verify_calibration
from canprobe.mechanics.touch.contact import direction_to_pad
from canprobe.mechanics.touch.image.calibration import ArrayCalibration, ForceReference
from canprobe.mechanics.touch.image.force_errors import MAKE_SPREAD

Ask = Callable[[str], str]
"""Asks a person a text, and returns the answer."""

PACKAGED_POINT_MM: Vec3 = (-120.0, -122.5, 374.0)
"""Point that the packaged cells touch first, mm, base frame."""
POINT_BELOW_PROBE_M = 5e-3
"""Distance from the probe in the start posture down to the point that is touched, m."""
REST_S = 30.0
PLANE_FORCES_N, BALL_FORCES_N, LOADS_N = (0.7, 1.5, 3.0), (0.8, 2.0), (1.0, 2.0, 3.0)
CORNERS_M = tuple((u, v) for u in (-2e-3, 2e-3) for v in (-2e-3, 2e-3))
GRID_M = tuple((u, v) for u in (-2e-3, 0.0, 2e-3) for v in (-2e-3, 0.0, 2e-3))
VERIFIED_FORCES_N = (0.8, 1.4, 2.0)
"""Forces of the touches that verify a calibration: within those of its own touches of the ball."""
LOAD_S = 9.0
"""Time of a reference load, s: creep has ended by then, and a scale shows a steady value."""
STROKE_M, STROKE_HZ, STROKE_S = (0.5e-3, 0.0), (0.5, 1.5), 8.0
ROD_ANGLES_DEG = (0.0, 45.0)
EFFECTIVE_REST_S = 0.5
"""Time from the moment when the force is reached to the first image whose force counts, s."""


@dataclass(frozen=True, slots=True)
class KnownObject:
    """An object of known size under the probe, touched first at one point.

    Attributes:
        name: "plane", "ball" or "rod".
        radius: its radius, m; infinite for a plane.
        angle: angle of a rod's axis from base x, rad.
    """

    name: str
    radius: float
    angle: float = 0.0

    def asked_for(self, at: Sequence[float]) -> str:
        """Instruction for the person who places it."""
        where = "({:g}, {:g}, {:g}) mm of the base frame".format(*at)
        if self.name == "plane":
            return f"Place the plane level, its surface at {where}."
        if self.name == "ball":
            return f"Place the ball of radius {1e3 * self.radius:g} mm with its top at {where}."
        return (
            f"Place the rod of radius {1e3 * self.radius:g} mm level with its crown at {where}, its axis"
            f" {math.degrees(self.angle):g} deg from x of the base frame."
        )

    def settings(self, at: Vec3) -> ObjectSettings:
        """Settings of the object in an emulated cell."""
        if self.name == "plane":
            return ObjectSettings("plane", position_mm=at)
        kind = "sphere" if self.name == "ball" else "cylinder"
        turned = (0.0, 0.0, math.degrees(self.angle))
        return ObjectSettings(kind, radius_mm=1e3 * self.radius, position_mm=at, rotation_deg=turned)  # type: ignore[arg-type]


@dataclass(frozen=True, slots=True)
class Visit:
    """One bring-up of the cell over one object.

    Attributes:
        known: the object.
        presses: presses on it.
        first: number of the first place.
        turned: whether the probe is turned about its pole by half a turn.
        rest_s: time of images without load before the first touch, s.
        load: whether each press is a reference load.
    """

    known: KnownObject
    presses: tuple[Press, ...]
    first: int = 0
    turned: bool = False
    rest_s: float = 0.0
    load: bool = False


def visits(ball_radius: float, rod_radius: float, *, loads: bool, one_by_one: bool) -> Iterator[Visit]:
    """All touches, in their order.

    Args:
        ball_radius, rod_radius: m.
        loads: whether there are reference loads.
        one_by_one: whether a person reads each reference load, so that the probe lets go after it.
    """
    plane, ball = KnownObject("plane", math.inf), KnownObject("ball", ball_radius)
    # after a heavy touch hysteresis raises the reading of a light one: forces only grow
    light, middle, heavy = (
        [Press(force, at, heading=0.8 * i) for i, at in enumerate(CORNERS_M)] for force in PLANE_FORCES_N
    )
    strokes = [Press(2.0, (0.0, 0.0), STROKE_M, heading, STROKE_HZ, STROKE_S) for heading in (0.0, 0.5 * math.pi)]
    yield Visit(plane, (*light, *middle, *strokes, *heavy), rest_s=REST_S)
    held = [Press(force, seconds=LOAD_S) for force in LOADS_N] if loads else []
    for i, some in enumerate([[one] for one in held] if one_by_one else [held] if held else []):
        yield Visit(plane, tuple(some), first=100 + i, load=True)
    round_ = [Press(force, at, heading=0.7 * i) for force in BALL_FORCES_N for i, at in enumerate(GRID_M)]
    yield Visit(ball, tuple(round_))
    for known, force in ((ball, BALL_FORCES_N[0]), (plane, PLANE_FORCES_N[1])):
        yield Visit(known, (Press(force, CORNERS_M[0] if known is plane else GRID_M[4]),), first=200, turned=True)
    for i, angle in enumerate(ROD_ANGLES_DEG):
        rod = KnownObject("rod", rod_radius, math.radians(angle))
        yield Visit(rod, (Press(2.0, roll=(1.5e-3, 0.0), heading=math.nan),), first=300 + i)


@dataclass(frozen=True, slots=True)
class CalibrationRequest:
    """The array to calibrate, and the way to do it.

    Attributes:
        cell: name or path of the cell.
        target: interface and channels; None: those of the cell.
        at: point that is touched first, mm, base frame; None: the point under the probe in the start posture, or
            `PACKAGED_POINT_MM` of a packaged cell.
        ball_radius, rod_radius: m.
        reference: reference of the newtons.
        sigma: its relative standard deviation.
        own_gains: whether the file is for this array; False: for all arrays of its make.
        spread: relative standard deviation of the force between the arrays of a make.
        seed: seed of the emulation.
    """

    cell: str | Path
    target: Target | None = None
    at: Vec3 | None = None
    ball_radius: float = 0.025
    rod_radius: float = 0.025
    reference: ForceReference = "none"
    sigma: float = 0.01
    own_gains: bool = True
    spread: float = MAKE_SPREAD
    seed: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """Result of a calibration.

    Attributes:
        fit: the fit, which has the calibration.
        restless: taxels that show counts without load, (row, column).
        drift_counts: RMS change of the images from the first to the last second without load.
        notes: steps that were left out, and what is to be done by hand.
    """

    fit: ArrayFit
    restless: tuple[tuple[int, int], ...]
    drift_counts: float
    notes: tuple[str, ...]


def calibrate(
    request: CalibrationRequest, *, date: str, ask: Ask | None = None, say: Say = quiet, out: Path | None = None
) -> Calibrated:
    """Touch all objects, and fit the calibration.

    Args:
        request: the array and the way to do it.
        date: date for the file, ISO 8601.
        ask: asks a person at a real cell; None for an emulated cell.
        say: called with each step.
        out: folder for the recorded buses, with a folder for each visit; None keeps none.

    Raises:
        UsageError: when the cell cannot do it, or a person is needed and `ask` is None.
        PlanError: when the point is out of reach.
        SafetyStop, BusError: as in a run.
    """
    scene = _scene(request)
    at = scene.task.start_mm
    assert scene.sensor is not None and scene.arm is not None
    emulated = scene.sensor.emulated
    if not emulated and ask is None:
        raise UsageError("a real array: a person has to place the objects; leave --yes out")
    loads = request.reference in ("scale", "weights")
    every = list(visits(request.ball_radius, request.rod_radius, loads=loads, one_by_one=not emulated))
    notes: list[str] = []
    planned: list[tuple[int, Visit, Plan]] = []
    for number, visit in enumerate(every, start=1):
        there = _turned(scene) if visit.turned else scene
        if there is None:
            notes.append(
                f"left out: the {visit.known.name} with the probe turned, as the last joint cannot turn by half a turn"
            )
            continue
        planned.append((number, visit, _plan(replace(there, object=visit.known.settings(at)), visit)))
    array = resolve(scene).array  # read before the touches: its files may change meanwhile
    assert array is not None
    name = scene.sensor.serial_number
    if array.raw is not None and name is None and ask is not None and not emulated and request.own_gains:
        name = ask("Name of this array, as on its label (Enter: it has none): ").strip() or None
        if name is not None:
            notes.append(
                f'nothing on the bus shows which array it is: put sensor.serial_number = "{name}" into the cell'
            )
    dwells: list[Dwell] = []
    unloaded: list[NDArray[np.uint8]] = []
    placed: KnownObject | None = None
    serial: int | None = None
    for number, visit, plan in planned:
        if ask is not None and not emulated and visit.known != placed:
            ask(f"{visit.known.asked_for(at)} Then press Enter: ")
        placed = visit.known
        touches = f"{len(visit.presses)} touch{'es' * (len(visit.presses) != 1)}"
        say(f"visit {number} of {len(every)}: {touches} of the {visit.known.name}")
        folder = None if out is None else out / f"visit-{number:02d}"
        found, rest, serial = touch_object(plan, visit, folder, say, ask if not emulated else None)
        dwells += found
        unloaded += rest
    who = f"{scene.sensor.eds.rsplit('/', 1)[-1]}, node {array.node_id}"
    moved = f"{'emulated ' if scene.arm.emulated else ''}cell {Path(request.cell).stem}"
    fit = calibrate_array(
        dwells,
        pad=array.pad,
        reference=request.reference,
        reference_sigma=request.sigma,
        array=f"{'emulated ' if emulated else ''}{who}" + (f", seed {request.seed}" if emulated else ""),
        date=date,
        made_on=f"{moved}; plane, ball of {1e3 * request.ball_radius:g} mm, rod of {1e3 * request.rod_radius:g} mm",
        own_gains=request.own_gains,
        spread=request.spread,
    )
    if request.own_gains:
        fit = replace(fit, calibration=replace(fit.calibration, serial_number=serial or name))
    return Calibrated(fit, *_without_load(unloaded, array.rate_hz), tuple(notes))


def verify(
    request: CalibrationRequest, *, date: str, ask: Ask | None = None, say: Say = quiet, out: Path | None = None
) -> tuple[ArrayCalibration, Verification]:
    """Touch the ball at one place with three forces, and compare them with the calibration file that the cell names.

    Where it holds the date is written into the file.

    Args:
        request, date, ask, say, out: as of `calibrate`.

    Returns:
        The calibration as it was, and what the touches show beside it.

    Raises:
        UsageError: the cell names no calibration of this array; and as `calibrate`.
    """
    scene = _scene(request)
    array = resolve(scene).array
    assert array is not None and scene.sensor is not None
    file = Path(scene.sensor.calibration or "")
    if not file.is_file() or array.calibration.of_make:
        raise UsageError(
            f"{request.cell}: sensor.calibration: expected the file of this array, got"
            f" {scene.sensor.calibration or 'none'}; make one first: canprobe calibrate array {request.cell}"
        )
    calibration = load_calibration(str(file))
    if math.isnan(calibration.stiffness.depth):
        raise UsageError(f"{file}: stiffness.depth_n_m3: expected a number, got none: nothing to compare the way with")
    ball = KnownObject("ball", request.ball_radius)
    if not array.emulated:
        if ask is None:
            raise UsageError("a real array: a person has to place the ball; leave --yes out")
        ask(f"{ball.asked_for(scene.task.start_mm)} Then press Enter: ")
    visit = Visit(ball, tuple(Press(force) for force in VERIFIED_FORCES_N))
    plan = _plan(replace(scene, object=ball.settings(scene.task.start_mm)), visit)
    dwells, *_ = touch_object(plan, visit, out, say, ask)
    found = verify_calibration(calibration, dwells, array.pad)
    if found.holds:
        write_text(file, dump_calibration(replace(calibration, verified=date)))
    return calibration, found


def _scene(request: CalibrationRequest) -> Scene:
    """The scene of a press on the cell; on a lockstep bus frames take no time."""
    scene = load_scene("press", {"cell": request.cell})
    if request.target is not None:
        scene = request.target.applied_to(scene)
    bus = replace(scene.bus, timed=False) if scene.bus.interface == LOCKSTEP else scene.bus
    info = replace(scene.scene, name="calibrate-array", seed=request.seed)
    at = request.at or (PACKAGED_POINT_MM if str(request.cell) in packaged_files("cells") else _under_probe(scene))
    task = replace(scene.task, start_mm=at, approach_normal=(0.0, 0.0, 1.0), force_n=max(PLANE_FORCES_N))
    scene = replace(scene, scene=info, bus=bus, task=task, object=ObjectSettings("plane", position_mm=at))
    setup = resolve(scene)
    if setup.array is not None and setup.array.mode == "features":
        raise UsageError("sensor.mode: a calibration needs images, and this array sends features")
    if setup.arm is not None and task_rows(setup.arm.model) < 5:
        raise UsageError(f"{request.cell}: a calibration tilts the probe, and this arm holds its orientation")
    return scene


def _under_probe(scene: Scene) -> Vec3:
    """The point under the probe in the start posture, mm."""
    setup = resolve(scene)
    arm = setup.needed_arm()
    centre = (forward(arm.model.chain, arm.q_start) @ setup.probe.T_flange_probe)[:3, 3]
    x, y, z = (1e3 * (centre - (0.0, 0.0, setup.probe.radius + POINT_BELOW_PROBE_M))).round(1).tolist()
    return x, y, z


def _plan(scene: Scene, visit: Visit) -> Plan:
    """The plan of a visit, whose touches and rolls the arm reaches.

    Raises:
        PlanError: when it does not; the message has the option to type.
    """
    where = f"{visit.known.name} at ({', '.join(f'{value:g}' for value in scene.task.start_mm)}) mm"
    try:
        plan = make_plan(resolve(scene))
        arm, task = plan.setup.needed_arm(), plan.setup.task
        assert isinstance(task, Touch)
        x = (forward(arm.model.chain, arm.q_start) @ task.probe.T_flange_probe)[:3, 0]
        poses = _roll_task(plan, visit).poses(x)
        if problems := reach_problems(plan.setup, task, [(pose.centre, -pose.pole) for pose in poses]):
            raise PlanError(problems)
    except PlanError as error:
        way = "if the arm does not reach it, give another point with --at X Y Z, or another start posture in the cell"
        raise PlanError([*(f"{where}: {problem}" for problem in error.problems), way], error.ways_out) from error
    return plan


def _turned(scene: Scene) -> Scene | None:
    """The scene with the last joint half a turn further; None where it cannot go there."""
    last = resolve(scene).needed_arm().model.joints[-1]
    for name, joint in list(scene.joints.items())[-1:]:  # an external arm has none: its flange turns by less
        for turn in (180.0, -180.0):
            q = math.radians(joint.start_deg + turn)
            if not last.prismatic and last.q_min + 0.3 < q < last.q_max - 0.3:
                joints = {**scene.joints, name: replace(joint, start_deg=joint.start_deg + turn)}
                return replace(scene, joints=joints)
    return None


def touch_object(
    plan: Plan, visit: Visit, out: Path | None, say: Say, ask: Ask | None
) -> tuple[list[Dwell], list[NDArray[np.uint8]], int | None]:
    """Bring the cell up, touch, stop; the touches, the images before them, and the array's serial number (1018h:04).

    Args:
        plan, visit: the touches.
        out: folder of the files; None: there are none.
        say: called with each step.
        ask: asks for reference loads.
    """
    array, roll = plan.setup.array, _roll_task(plan, visit)
    assert array is not None
    with Session(plan, RunOptions(out, say)) as session:
        ids = [array.node_id] if array.raw is None else []
        serials = session.cell.bring_up.serial_numbers(ids)
        session.run(roll)
    log, truth = session.cell.log.arrays(), session.buses.truth
    touched = [p.at if not p.hz[1:] else (p.at, p.heading) for p in roll.presses]
    places = list(dict.fromkeys(touched))
    dwells = []
    for i, pressed in enumerate(roll.pressed):
        press = pressed.press
        force = None
        if visit.load and "force_n" in truth:
            rows = (log["touch"] == i + 1) & (log["phase"] == Phase.SCAN)
            rows[: int(np.argmax(rows)) + round(EFFECTIVE_REST_S * plan.setup.rate_hz)] = False
            force = float(truth["force_n"][: len(rows)][rows].mean())
        elif visit.load:
            force = _read(ask, press.force)
        place = visit.first + places.index(touched[i]) + 50 * bool(press.hz[1:])
        dwells.append(as_dwell(pressed, plan, visit, place, force))
    return dwells, roll.unloaded, next(iter(serials.values()), 0) or None


def _roll_task(plan: Plan, visit: Visit) -> RollTask:
    task = plan.setup.task
    assert isinstance(task, Touch)
    presses = [replace(p, heading=_along_rod(plan, visit.known)) if math.isnan(p.heading) else p for p in visit.presses]
    radius = math.inf if visit.known.name == "rod" else visit.known.radius
    return RollTask(plan, task, make_sensing(task), presses, radius, visit.rest_s)


def _read(ask: Ask | None, force: float) -> float:
    """Ask a person for the force (N) of a reference."""
    if ask is None:
        raise UsageError("reference loads: a person has to read them; leave --yes out")
    while True:
        answer = ask(f"Reading of the reference during the load of about {force:g} N, in N: ")
        try:
            found = float(answer)
        except ValueError:
            continue
        if 0.05 < found < 50.0:
            return found


def _along_rod(plan: Plan, known: KnownObject) -> float:
    """Heading of a rod's axis on the pad, rad."""
    arm, probe = plan.setup.needed_arm(), plan.setup.probe
    x, y = (forward(arm.model.chain, arm.q_start) @ probe.T_flange_probe)[:2, 0].tolist()
    # seen from outside the pad looks down: its v axis is on the other side
    return math.atan2(y, x) - known.angle


def as_dwell(pressed: RollRecord, plan: Plan, visit: Visit, place: int, force: float | None) -> Dwell:
    """Make the input of the fit from a touch: where its contacts should lie by joints and object.

    Args:
        pressed: record of the touch.
        plan: plan of the visit, whose scene has the object.
        visit: visit of the object.
        place: number of the place.
        force: force by the reference, N.
    """
    known, radius, poses = visit.known, plan.setup.probe.radius, pressed.T_base_probe
    assert plan.scene.object is not None
    shape = true_object(plan.scene.object)
    near = [shape.closest(T[:3, 3]) for T in poses]
    u, v = poses[0][:3, :2].T @ (math.sin(known.angle), -math.cos(known.angle), 0.0)  # across a rod
    larger, smaller = near[0].kappa.tolist()
    return Dwell(
        name=known.name,
        kappa=(larger, smaller),
        angle=math.atan2(v, u) if known.name == "rod" else 0.0,
        place=place,
        t_s=np.array(pressed.t_s),
        images=pressed.images,
        windows=[w or (0, 0, 16, 16) for w in pressed.windows],
        expected=np.array(
            [direction_to_pad(-T[:3, :3].T @ at.normal, radius) for T, at in zip(poses, near, strict=True)]
        ),
        push=np.array([radius - at.distance for at in near]),
        turn=math.pi if visit.turned else 0.0,
        force=force,
        to_and_fro=len(pressed.press.hz) > 1,
    )


def _without_load(images: Sequence[NDArray[np.uint8]], rate_hz: float) -> tuple[tuple[tuple[int, int], ...], float]:
    """Taxels that show counts in more than a tenth of the images without load, and the drift of the mean image."""
    if not images:
        return (), 0.0
    every = np.array(images, dtype=np.float64)
    restless = tuple((int(i), int(j)) for i, j in np.argwhere((every > 0.0).mean(axis=0) > 0.1))
    n = min(max(1, round(rate_hz)), len(every))
    return restless, float(np.sqrt(np.mean((every[-n:].mean(axis=0) - every[:n].mean(axis=0)) ** 2)))
