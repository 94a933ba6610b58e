"""Rules of what goes together in a scene: sections and kinds of task, keys across sections."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from canprobe.cell.scene.hardware import JointSettings, Vec3
from canprobe.cell.scene.model import FORCES, SPEEDS, TOUCH_KINDS, Posture, TargetPoints, WireSettings, highest
from canprobe.cell.scene.toml_files import toml_value
from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.raw_image import FramePattern, ImageFormat
from canprobe.fieldbus.protocol.tactile import MAX_SIDE, WINDOW_SIZES
from canprobe.mechanics.robot.chain import MAX_JOINTS

_USUALLY = {
    "arm": ("may", ""),
    "sensor": ("may", ""),
    "wire": ("default", ""),
    "probe": ("default", ""),
    "object": ("may", ""),
    "carrier": ("mounted", ""),
    "shape": ("default", ""),
    "servo": ("default", ""),
    "plant": ("default", ""),
    "emulate": ("default", ""),
}
_BESIDES = {
    "scan": {
        "arm": ("must", "a scan moves the probe"),
        "sensor": ("must", "a scan follows the contact that it measures"),
    },
    "press": {
        "arm": ("must", "a press moves the probe"),
        "sensor": ("must", "a press holds the force that it measures"),
        "shape": ("never", "one touch without motion shows no shape"),
    },
    "calibrate": {
        "arm": ("must", "a calibration moves the probe"),
        "sensor": ("must", "a calibration measures where the ball is touched"),
        "carrier": ("never", "the ball stands still"),
        "shape": ("never", "the ball's shape is known"),
        "servo": ("never", "no surface is followed"),
    },
    "listen": {
        "arm": ("never", "listening moves nothing"),
        "sensor": ("must", "there is nothing else to listen to"),
        "carrier": ("never", "listening moves nothing"),
        "shape": ("never", "without motion there is no shape to estimate"),
        "servo": ("never", "listening moves nothing"),
    },
    "free": {
        "arm": ("must", "free motion moves the arm"),
        "wire": ("may", ""),
        "probe": ("mounted", ""),
        "object": ("never", "free motion touches nothing"),
        "carrier": ("never", "free motion touches nothing"),
        "shape": ("never", "without touch there is no shape to estimate"),
        "servo": ("never", "there is no touch to control"),
    },
}
SECTIONS_OF_TASK: Mapping[str, Mapping[str, tuple[str, str]]] = {
    task: {**_USUALLY, "joints": besides["arm"], **besides} for task, besides in _BESIDES.items()
}
"""For each task and section (need, why). Need: "must" be given, "default" when left out, "may" be given, "never", and
"mounted": there where the cell has it."""

START = "start"
"""Name of the posture that the joints' start keys describe."""
_Complaint = Iterator[tuple[str, str]]
_RULES: list[tuple[tuple[str, ...], Callable[..., _Complaint]]] = []


def _across(*keys: str) -> Callable[[Callable[..., _Complaint]], Callable[..., _Complaint]]:
    """A rule across keys: it takes their values and yields the key path that is wrong, with the complaint.

    It is asked where all of them have a value; a key with a question mark may be absent.
    """

    def take(rule: Callable[..., _Complaint]) -> Callable[..., _Complaint]:
        _RULES.append((keys, rule))
        return rule

    return take


@_across("arm.kind", "joints")
def _joints_missing(kind: str, joints: Mapping[str, JointSettings]) -> _Complaint:
    if kind == "external":
        if joints:
            yield "joints", 'not with arm.kind = "external", which has no joints; remove the sections'
    elif not 1 <= len(joints) <= MAX_JOINTS:
        yield "joints", f"expected 1 to {MAX_JOINTS} sections [joints.NAME], got {len(joints)}"


@_across("joints", "postures")
def _posture_of_other_joints(joints: Mapping[str, JointSettings], postures: Mapping[str, Posture]) -> _Complaint:
    for name, posture in postures.items():
        if name == START:
            yield f"postures.{name}", "it is what the joints have as start_deg or start_mm; choose another name"
        elif joints and len(posture) != len(joints):
            yield f"postures.{name}", f"expected a position of each of the {len(joints)} joints, got {len(posture)}"


@_across("task.start_posture", "postures?")
def _no_such_posture(name: str, postures: Mapping[str, Posture] | None) -> _Complaint:
    if name not in (postures or {}):
        known = ", ".join(postures or {}) or "none"
        yield "task.start_posture", f"expected a posture of [postures] ({known}), got {name}"


@_across("joints", "arm.urdf?")
def _joint_incomplete(joints: Mapping[str, JointSettings], urdf: str | None) -> _Complaint:
    for name, joint in joints.items():
        turns = joint.kind == "revolute"
        needed = ["counts_per_turn"] if turns else ["counts_per_m"]
        if urdf is None:
            needed += ["min_deg", "max_deg", "speed_deg_s"] if turns else ["min_mm", "max_mm", "speed_mm_s"]
        for key in needed:
            if getattr(joint, key) is None:
                yield f"joints.{name}.{key}", f"missing: a {joint.kind} joint needs it"
        home = "home_deg" if turns else "home_mm"
        if joint.zero == "homing" and getattr(joint, home) is None:
            yield f"joints.{name}.{home}", 'missing: zero = "homing" needs it'
        for other in joint.coupling or ():
            if other not in joints or other == name:
                names = ", ".join(key for key in joints if key != name)
                yield f"joints.{name}.coupling", f"expected names of other joints ({names}), got {other}"


@_across("joints", "sensor.node_id?", "wire.kind?", "carrier.node_id?")
def _duplicate_node(
    joints: Mapping[str, JointSettings], sensor: int | None, wire: str | None, carrier: int | None
) -> _Complaint:
    owners = {sensor: "sensor"} if sensor is not None and wire != "frames" else {}
    if carrier is not None and owners.setdefault(carrier, "carrier") == "sensor":
        yield "carrier.node_id", f"expected another node id than sensor.node_id, got {carrier}"
    for number, (name, joint) in enumerate(joints.items(), start=1):
        node_id = joint.node_id or number
        other = owners.setdefault(node_id, name)
        if other in ("sensor", "carrier"):
            yield f"{other}.node_id", f"expected a node id that no joint has, got {node_id}, as joints.{name}"
        elif other != name:
            yield f"joints.{name}.node_id", f"expected node ids all different, got {node_id}, as joints.{other} has"


@_across("task.strategy", "outputs.surface_map")
def _explores_without_map(strategy: str, surface_map: bool) -> _Complaint:
    if strategy == "explore" and not surface_map:
        yield "outputs.surface_map", 'expected true with task.strategy = "explore", which goes by the map, got false'


@_across("task.kind", "sensor.emulated", "object?")
def _object_missing(kind: str, sensor: bool, obj: object) -> _Complaint:
    if kind in TOUCH_KINDS and sensor and obj is None:
        yield "object", "missing: an emulated sensor touches nothing without an [object]; describe the true object"


@_across("task.kind", "arm.emulated", "sensor.emulated")
def _half_emulated(kind: str, arm: bool, sensor: bool) -> _Complaint:
    if kind in TOUCH_KINDS and arm and not sensor:
        why = "a real sensor cannot measure what an emulated arm touches; emulate both, or only the sensor"
        yield "sensor.emulated", f"expected true: {why}"


@_across("shape.method", "shape.also")
def _main_method_repeated(method: str, also: tuple[str, ...]) -> _Complaint:
    if method in also:
        yield "shape.also", f'expected methods besides the main one, got "{method}", which shape.method has already'


@_across("task.kind", "task.approach_normal", "task.heading_deg")
def _heading_along_normal(kind: str, normal: tuple[float, ...], heading: float) -> _Complaint:
    turn = math.radians(heading)
    along = (normal[0] * math.cos(turn) + normal[1] * math.sin(turn)) / math.hypot(*normal)
    if kind == "scan" and abs(along) >= 0.99:
        why = f"expected a heading across task.approach_normal, got {heading:g}, which runs along it"
        yield "task.heading_deg", why


@_across("carrier.emulated", "arm.emulated")
def _half_moved(carrier: bool, arm: bool) -> _Complaint:
    if carrier != arm:
        why = "an emulated carrier moves an emulated object, a real one a real object"
        yield "carrier.emulated", f"expected {toml_value(arm)}, as arm.emulated: {why}"


@_across("carrier", "joints", "plant.fidelity", "task.strategy?")
def _moved_object(carrier: object, joints: Mapping[str, JointSettings], fidelity: str, strategy: str) -> _Complaint:
    if strategy == "explore":
        yield "task.strategy", "expected a path that can be planned in time with a [carrier], got explore"
    if fidelity == "dynamic" or any(joint.stiffness_nm_rad or joint.stiffness_n_m for joint in joints.values()):
        yield "plant.fidelity", "expected an ideal arm with rigid joints with a [carrier]: no other is emulated"


@_across("joints", "plant.fidelity")
def _compliant_dynamic(joints: Mapping[str, JointSettings], fidelity: str) -> _Complaint:
    for name, joint in joints.items():
        if fidelity == "dynamic" and (joint.stiffness_nm_rad or joint.stiffness_n_m):
            key = "stiffness_n_m" if joint.kind == "prismatic" else "stiffness_nm_rad"
            yield f"joints.{name}.{key}", 'expected plant.fidelity = "ideal": the joints of a dynamic arm are rigid'


@_across("task.kind", "object.kind", "object.radius_mm?", "task.ball_radius_mm")
def _not_a_ball(kind: str, obj: str, radius: float | None, ball: float) -> _Complaint:
    if kind == "calibrate" and (obj, radius) != ("sphere", ball):
        what = f'kind = "sphere", radius_mm = {ball:g} (task.ball_radius_mm)'
        yield "object", f"expected the ball that is touched: {what}"


@_across("object.kind", "object.radius_x_mm", "object.radius_y_mm")
def _two_radii(kind: str, x: float, y: float) -> _Complaint:
    if kind == "saddle" and (x * y >= 0 or min(abs(x), abs(y)) < 1):
        why = "expected the radii of a saddle to have opposite signs and 1 mm or more"
        yield "object.radius_y_mm", f"{why}, got {x:g} and {y:g}"
    if kind == "ellipsoid" and min(x, y) < 1:
        yield "object.radius_x_mm", f"expected the radii of an ellipsoid to be 1 mm or more, got {x:g} and {y:g}"


@_across("object.kind", "object.ring_radius_mm", "object.radius_mm")
def _torus_radii(kind: str, ring: float, tube: float) -> _Complaint:
    if kind == "torus" and ring <= tube:
        yield "object.ring_radius_mm", f"expected more than object.radius_mm = {tube:g}, got {ring:g}"


@_across("task.kind", "task.force_n", "limits.force_max_n")
def _force_target(kind: str, force: float | TargetPoints, limit: float) -> _Complaint:
    if kind in TOUCH_KINDS and highest(force) >= limit:
        yield "task.force_n", f"expected less than limits.force_max_n = {limit:g}, got {highest(force):g}"


@_across("task.kind", "task.force_n", "task.speed_mm_s")
def _target_tables(kind: str, force: float | TargetPoints, speed: float | TargetPoints) -> _Complaint:
    for key, target, allowed in (("force_n", force, FORCES), ("speed_mm_s", speed, SPEEDS)):
        if not isinstance(target, Mapping):
            continue
        bad = kind == "calibrate" or (kind == "press" and "path_mm" in target)
        if bad or len(target) != 1 or not all(target.values()):
            wanted = {"calibrate": "a number", "press": "points over time_s, as there is no path"}
            expects = f'expected {wanted.get(kind, "points over path_mm or over time_s")} with task.kind = "{kind}"'
            got = ", ".join(f"{len(points)} points over {over}" for over, points in target.items())
            yield f"task.{key}", f"{expects}, got {got or 'an empty table'}"
        for over, points in target.items():
            last = 0.0
            for number, (place, value) in enumerate(points, 1):
                if place < last or not allowed.accepts(value):
                    expects = f"expected {over} from {last:g} on and a number {allowed.text} in point {number}"
                    yield f"task.{key}.{over}", f"{expects}, got [{place:g}, {value:g}]"
                    break
                last = place


@_across("cycle.rate_hz", "sensor.rate_hz")
def _sensor_rate(cycle: float, sensor: float) -> _Complaint:
    if sensor > cycle:
        why = "frames are triggered by SYNC"
        yield "sensor.rate_hz", f"expected at most cycle.rate_hz = {cycle:g}, got {sensor:g}: {why}"


@_across("sensor.serial_number", "wire.kind?")
def _name_of_a_node(serial: int | str, wire: str | None) -> _Complaint:
    if isinstance(serial, str) and wire != "frames":
        yield "sensor.serial_number", f"expected the number of 1018h:04, which a CANopen node has, got {serial!r}"


@_across("sensor.rows", "sensor.columns", "sensor.pitch_mm", "sensor.positions_mm?", "sensor.normals?")
def _taxel_positions(rows: int, columns: int, pitch: object, positions: object, normals: object) -> _Complaint:
    if positions is None and normals is not None:
        yield "sensor.normals", "only with sensor.positions_mm"
    for key, points in (("positions_mm", positions), ("normals", normals)):
        if isinstance(points, tuple) and len(points) != rows * columns:
            expects = f"expected {rows * columns} points, sensor.rows × sensor.columns"
            yield f"sensor.{key}", f"{expects}, got {len(points)}"
    if isinstance(normals, tuple) and not all(any(normal) for normal in normals):
        yield "sensor.normals", "expected directions, got one that is all zero"
    if isinstance(positions, tuple) and isinstance(pitch, tuple):
        yield "sensor.pitch_mm", f"expected one distance with sensor.positions_mm, got {list(pitch)}"
    elif isinstance(positions, tuple) and isinstance(pitch, float) and len(positions) == rows * columns > 1:
        yield from _taxels_apart(positions, pitch)
    if isinstance(normals, tuple) and sum(normal[2] for normal in normals) < 0.0:
        why = "expected outward normals, z away from the flange, got most that point inside: turn them"
        yield "sensor.normals", why


def _taxels_apart(positions: Sequence[Vec3], pitch: float) -> _Complaint:
    """Complaint about taxels in one place, or whose places are in another unit: the pitch gives their distance."""
    first: dict[Vec3, int] = {}
    for number, place in enumerate(positions, 1):
        if (other := first.setdefault(place, number)) != number:
            yield "sensor.positions_mm", f"expected a place for each taxel, got {list(place)} for {other} and {number}"
            return
    across = max(math.dist(positions[0], place) for place in positions)
    if across < TINY_SHARE * pitch:
        got = f"got {across:g} mm from one end to the other; are they in metres? multiply by 1000"
        yield "sensor.positions_mm", f"expected taxels about sensor.pitch_mm = {pitch:g} apart, {got}"


TINY_SHARE = 0.1
"""Width of an array over its pitch below which the places of its taxels are in another unit."""
_WIRE = ("ids", "frames", "byte_order", "axes", "normal_axis", "signed", "unloaded_counts", "full_scale_counts", "poll")


@_across("wire", "sensor.rows", "sensor.columns", "sensor.mode", "sensor.window", *(f"wire.{key}" for key in _WIRE))
def _array_fits_wire(
    wire: WireSettings, rows: int, columns: int, mode: str, window: int | str, *_read: object
) -> _Complaint:
    if wire.kind == "frames":
        yield from _raw_frames(wire, rows, columns, mode)
        return
    if rows > MAX_SIDE or columns > MAX_SIDE:
        key = "rows" if rows > MAX_SIDE else "columns"
        got = f"got {max(rows, columns)}: its header names a taxel in 8 bits"
        yield f"sensor.{key}", f'expected at most {MAX_SIDE} with wire.kind = "canopen", {got}'
    elif mode == "window" and isinstance(window, int) and window > min(rows, columns):
        least = min(rows, columns)
        way_out = 'take a smaller one, or sensor.mode = "image"'
        if least < min(WINDOW_SIZES):
            way_out = f'the smallest window has {min(WINDOW_SIZES)}: set sensor.mode = "image"'
        expects = f"expected at most the {least} taxels of sensor.rows and columns"
        yield "sensor.window", f"{expects}, got {window}; {way_out}"


def _raw_frames(wire: WireSettings, rows: int, columns: int, mode: str) -> _Complaint:
    if mode != "image":
        yield "sensor.mode", f'expected "image" with wire.kind = "frames", got "{mode}": the device sends whole images'
    if wire.normal_axis > wire.axes:
        yield "wire.normal_axis", f"expected at most wire.axes = {wire.axes}, got {wire.normal_axis}"
    if wire.unloaded_counts == wire.full_scale_counts:
        yield "wire.full_scale_counts", f"expected another value than wire.unloaded_counts = {wire.unloaded_counts}"
    if (wire.sampling == "polled") != bool(wire.poll):
        needs = "missing: a polled device needs it" if not wire.poll else 'only with wire.sampling = "polled"'
        yield "wire.poll", needs
    if wire.tare_images and wire.sampling == "sync":
        why = 'not with wire.sampling = "sync": nothing is sampled before the cycle; give unloaded_counts'
        yield "wire.tare_images", why
    try:
        image = image_format(wire, rows, columns)
    except ProtocolError as error:
        yield "wire.frames", str(error)
        return
    low, high = image.range
    for key, counts in (("unloaded_counts", wire.unloaded_counts), ("full_scale_counts", wire.full_scale_counts)):
        if not low <= counts <= high:
            kind = "signed" if wire.signed else "unsigned"
            way = "; set wire.signed = true for two's complement" if counts < 0 and not wire.signed else ""
            expects = f"expected {low} to {high} in {image.bits} {kind} bits of wire.frames"
            yield f"wire.{key}", f"{expects}, got {counts}{way}"


def image_format(wire: WireSettings, rows: int, columns: int) -> ImageFormat:
    """Layout of the images of a device of raw frames.

    Raises:
        ProtocolError: its keys contradict each other.
    """
    ids: list[int] = []
    for text in wire.ids:
        first, _, last = text.replace("h", "").partition("-")
        ids += range(int(first, 16), int(last or first, 16) + 1)
    frames = tuple(FramePattern.parse(text, wire.byte_order, signed=wire.signed) for text in wire.frames)
    return ImageFormat(tuple(ids), frames, rows, columns, wire.axes, wire.order == "columns")


@_across("cycle.rate_hz", "cycle.compute_us")
def _compute_time(rate: float, compute_us: float) -> _Complaint:
    if compute_us * rate >= 1e6:
        cycle = f"the {1e6 / rate:g} µs of a cycle (cycle.rate_hz = {rate:g})"
        yield "cycle.compute_us", f"expected less than {cycle}, got {compute_us:g}"


def broken_rules(lookup: Callable[[str], Any]) -> Iterator[tuple[str, str]]:
    """Every rule that a scene breaks, as (key path, complaint).

    Args:
        lookup: value at a key path (`section` or `section.key`), None where absent; raises LookupError where the key
            has a problem already.
    """
    for keys, rule in _RULES:
        try:
            values = [lookup(key.rstrip("?")) for key in keys]
        except LookupError:
            continue
        if all(value is not None or key.endswith("?") for key, value in zip(keys, values, strict=True)):
            yield from rule(*values)
