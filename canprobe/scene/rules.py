"""What of a scene goes together: one table of needs per kind of task, one of rules across keys, and checked new
values.
"""

from __future__ import annotations

import math
import tomllib
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from canprobe.errors import UsageError
from canprobe.scene.checks import MismatchError, convert
from canprobe.scene.model import TOUCH_KINDS, Scene

# Which parts of a scene go together: one table of needs per kind of task, and one table of rules across keys.

SECTIONS_OF_TASK: Mapping[str, Mapping[str, tuple[str, str]]] = {
    # section: (need, why). need: "must" be given, "default" when left out, "may" be given, "never"
    "scan": {
        "arm": ("must", "a scan moves the probe"),
        "sensor": ("must", "a scan follows what it feels"),
        "probe": ("default", ""),
        "object": ("may", ""),
        "shape": ("default", ""),
        "servo": ("default", ""),
        "plant": ("default", ""),
    },
    "press": {
        "arm": ("must", "a press moves the probe"),
        "sensor": ("must", "a press holds the force it feels"),
        "probe": ("default", ""),
        "object": ("may", ""),
        "shape": ("never", "one touch without motion shows no shape"),
        "servo": ("default", ""),
        "plant": ("default", ""),
    },
    "calibrate": {
        "arm": ("must", "a calibration moves the probe"),
        "sensor": ("must", "a calibration feels the ball"),
        "probe": ("default", ""),
        "object": ("may", ""),
        "shape": ("never", "the ball's shape is known"),
        "servo": ("never", "no surface is followed"),
        "plant": ("default", ""),
    },
    "listen": {
        "arm": ("never", "listening moves nothing"),
        "sensor": ("must", "there is nothing else to listen to"),
        "probe": ("default", ""),
        "object": ("may", ""),
        "shape": ("never", "without motion there is no shape to estimate"),
        "servo": ("never", "listening moves nothing"),
        "plant": ("default", ""),
    },
    "free": {
        "arm": ("must", "free motion moves the arm"),
        "sensor": ("never", "free motion feels nothing"),
        "probe": ("may", ""),
        "object": ("never", "free motion touches nothing"),
        "shape": ("never", "without touch there is no shape to estimate"),
        "servo": ("never", "there is no touch to control"),
        "plant": ("default", ""),
    },
}


@dataclass(frozen=True, slots=True)
class Rule:
    """A condition across keys.

    Attributes:
        where: the key path that the message names.
        keys: key paths (`section` or `section.key`) whose values `wrong` takes, None where absent.
        wrong: returns the complaint, or None.
    """

    where: str
    keys: tuple[str, ...]
    wrong: Callable[..., str | None]


def _duplicate_node(arm_ids: tuple[int, ...] | None, sensor_id: int | None) -> str | None:
    if arm_ids is None or sensor_id not in arm_ids:
        return None
    return f"expected a node id of its own, got {sensor_id}, which arm.node_ids has too"


def _object_missing(kind: str, sensor: bool | None, obj: object) -> str | None:
    if kind not in TOUCH_KINDS or not sensor or obj is not None:
        return None
    return "missing: an emulated sensor touches nothing without an [object]; describe the true object"


def _half_emulated(kind: str, arm: bool | None, sensor: bool | None) -> str | None:
    if kind not in TOUCH_KINDS or arm is None or sensor is None or arm is False or sensor is True:
        return None
    return "expected true: a real sensor cannot feel what an emulated arm touches; emulate both, or only the sensor"


def _main_method_repeated(method: str | None, also: tuple[str, ...] | None) -> str | None:
    if also is None or method not in also:
        return None
    return f'expected methods besides the main one, got "{method}", which shape.method has already'


def _heading_along_normal(kind: str, normal: tuple[float, ...] | None, heading: float | None) -> str | None:
    if kind != "scan" or normal is None or heading is None:
        return None
    along = (normal[0] * math.cos(math.radians(heading)) + normal[1] * math.sin(math.radians(heading))) / math.hypot(
        *normal
    )
    if abs(along) < 0.99:
        return None
    return f"expected a heading across task.approach_normal, got {heading:g}, which runs along it"


def _not_a_ball(kind: str, obj: str | None, radius: float | None, ball: float | None) -> str | None:
    if kind != "calibrate" or obj is None or ball is None or (obj == "sphere" and radius == ball):
        return None
    return f'expected the ball that is touched: kind = "sphere", radius_mm = {ball:g} (task.ball_radius_mm)'


def _saddle_radii(kind: str | None, x: float | None, y: float | None) -> str | None:
    if kind != "saddle" or x is None or y is None or (x * y < 0 and min(abs(x), abs(y)) >= 1):
        return None
    return f"expected the radii of a saddle to have opposite signs and 1 mm or more, got {x:g} and {y:g}"


def _ellipsoid_radii(kind: str | None, x: float | None, y: float | None) -> str | None:
    if kind != "ellipsoid" or x is None or y is None or min(x, y) >= 1:
        return None
    return f"expected the radii of an ellipsoid to be 1 mm or more, got {x:g} and {y:g}"


def _torus_radii(kind: str | None, ring: float | None, tube: float | None) -> str | None:
    if kind != "torus" or ring is None or tube is None or ring > tube:
        return None
    return f"expected more than object.radius_mm = {tube:g}, got {ring:g}"


def _force_target(kind: str, force: float | None, limit: float | None) -> str | None:
    if kind not in TOUCH_KINDS or force is None or limit is None or force < limit:
        return None
    return f"expected less than limits.force_max_n = {limit:g}, got {force:g}"


def _sensor_rate(cycle: float | None, sensor: float | None) -> str | None:
    if cycle is None or sensor is None or sensor <= cycle:
        return None
    return f"expected at most cycle.rate_hz = {cycle:g}, got {sensor:g}: frames are triggered by SYNC"


def _compute_time(rate: float | None, compute_us: float | None) -> str | None:
    if rate is None or compute_us is None or compute_us * rate < 1e6:
        return None
    return f"expected less than the {1e6 / rate:g} µs of a cycle (cycle.rate_hz = {rate:g}), got {compute_us:g}"


RULES: tuple[Rule, ...] = (
    Rule("sensor.node_id", ("arm.node_ids", "sensor.node_id"), _duplicate_node),
    Rule("object", ("task.kind", "sensor.emulated", "object"), _object_missing),
    Rule("sensor.emulated", ("task.kind", "arm.emulated", "sensor.emulated"), _half_emulated),
    Rule("shape.also", ("shape.method", "shape.also"), _main_method_repeated),
    Rule("task.heading_deg", ("task.kind", "task.approach_normal", "task.heading_deg"), _heading_along_normal),
    Rule("object", ("task.kind", "object.kind", "object.radius_mm", "task.ball_radius_mm"), _not_a_ball),
    Rule("object.radius_y_mm", ("object.kind", "object.radius_x_mm", "object.radius_y_mm"), _saddle_radii),
    Rule("object.radius_x_mm", ("object.kind", "object.radius_x_mm", "object.radius_y_mm"), _ellipsoid_radii),
    Rule("object.ring_radius_mm", ("object.kind", "object.ring_radius_mm", "object.radius_mm"), _torus_radii),
    Rule("task.force_n", ("task.kind", "task.force_n", "limits.force_max_n"), _force_target),
    Rule("sensor.rate_hz", ("cycle.rate_hz", "sensor.rate_hz"), _sensor_rate),
    Rule("cycle.compute_us", ("cycle.rate_hz", "cycle.compute_us"), _compute_time),
)


def broken_rules(lookup: Callable[[str], Any]) -> Iterator[tuple[str, str]]:
    """Every rule that a scene breaks, as (key path, complaint).

    Args:
        lookup: value at a key path, None where absent; raises LookupError where the key has a problem already.
    """
    for rule in RULES:
        try:
            complaint = rule.wrong(*(lookup(key) for key in rule.keys))
        except LookupError:
            continue
        if complaint is not None:
            yield rule.where, complaint


# What a caller puts in the place of a scene's own values: checked as those of a scene file are.

_Section = TypeVar("_Section")


def need_scene(scene: object) -> None:
    """Complain about anything else in the place of a scene, such as its name.

    Raises:
        UsageError: with what was got.
    """
    if not isinstance(scene, Scene):
        raise UsageError(f"scene: expected what canprobe.load_scene returns, got {scene!r}")


def with_values(section: _Section, **values: object) -> _Section:
    """A section of a scene with some of its values replaced.

    Args:
        section: one of the dataclasses of `canprobe.scene`.
        values: by key, numbers of numpy too; None keeps what the section has.

    Raises:
        UsageError: naming the key, what was expected and what was got.
    """
    given = {key: value for key, value in values.items() if value is not None}
    if not given:
        return section
    annotations = typing.get_type_hints(type(section), include_extras=True)
    changes = {key: _checked(key, value, annotations[key]) for key, value in given.items()}
    return replace(section, **changes)  # type: ignore[type-var]  # a dataclass, as all sections are


def with_choices(scene: Scene, choices: Mapping[str, str]) -> Scene:
    """A scene with what was chosen in the place of its "auto".

    Args:
        scene: with open keys.
        choices: value by key path, as a scene file writes it: `{"sensor.mode": '"window"'}`.
    """
    for path, text in choices.items():
        section, _, key = path.partition(".")
        value = tomllib.loads(f"value = {text}")["value"]
        scene = replace(scene, **{section: replace(getattr(scene, section), **{key: value})})
    return scene


def _checked(key: str, value: object, annotation: Any) -> Any:
    try:
        return convert(value.item() if isinstance(value, np.generic) else value, annotation)
    except MismatchError as mismatch:
        raise UsageError(f"{key}: expected {mismatch}, got {value!r}") from None
