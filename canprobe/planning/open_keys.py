"""What a scene leaves to the plan ("auto"), and in which order the plan tries it.

What costs least is tried first: other mappings and priorities before other hardware (CAN FD, a second bus), and less
from the sensor last of all. What a scene writes is kept.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

from canprobe.planning.contact_window import window_choices
from canprobe.planning.model import Choice
from canprobe.scene import Scene, TactileModeName

AUTO = "auto"
_MODES: dict[str, tuple[TactileModeName, ...]] = {"listen": ("image", "window", "features")}
_FOLLOWING: tuple[TactileModeName, ...] = ("window", "features")


@dataclass(frozen=True, slots=True)
class _OpenKey:
    """One key that may say "auto".

    Attributes:
        key: section and name.
        options: of a scene: (value, why), the dearest last.
        put: the scene with a value.
    """

    key: str
    options: Callable[[Scene], tuple[tuple[Any, str], ...]]
    put: Callable[[Scene, Any], Scene]


def _modes(scene: Scene) -> tuple[tuple[Any, str], ...]:
    why = {
        "image": "nothing is left out",
        "window": "the window round the contact holds the patch",
        "features": "the sensor computes force, centroid and moments itself",
    }
    return tuple((mode, why[mode]) for mode in _MODES.get(scene.task.kind, _FOLLOWING))


def _channels(scene: Scene) -> tuple[tuple[Any, str], ...]:
    one = (scene.bus.channel, "one bus carries everything")
    return (
        (one,) if scene.arm is None else (one, (second_channel(scene.bus.channel), "a bus of its own for the sensor"))
    )


def second_channel(channel: str) -> str:
    """The next channel's name: can1 after can0."""
    match = re.fullmatch(r"(.*?)(\d+)", channel)
    return f"{match[1]}{int(match[2]) + 1}" if match else f"{channel}2"


def _sensor(key: str) -> Callable[[Scene, Any], Scene]:
    return lambda scene, value: replace(scene, sensor=replace(scene.sensor, **{key: value}))  # type: ignore[type-var]


def _arm(key: str) -> Callable[[Scene, Any], Scene]:
    return lambda scene, value: replace(scene, arm=replace(scene.arm, **{key: value}))  # type: ignore[type-var]


def _bus(key: str) -> Callable[[Scene, Any], Scene]:
    return lambda scene, value: replace(scene, bus=replace(scene.bus, **{key: value}))


_KEYS = (  # the last is varied first
    _OpenKey("sensor.mode", _modes, _sensor("mode")),
    _OpenKey("sensor.window", window_choices, _sensor("window")),
    _OpenKey("sensor.channel", _channels, _sensor("channel")),
    _OpenKey(
        "bus.fd",
        lambda _: ((False, "classical frames do"), (True, "PDOs of up to 64 bytes in CAN FD frames")),
        _bus("fd"),
    ),
    _OpenKey(
        "arm.grouped_rpdo",
        lambda _: ((False, "each drive has its target to itself"), (True, "two targets share an RPDO through dummies")),
        _arm("grouped_rpdo"),
    ),
    _OpenKey(
        "bus.cob_ids",
        lambda _: (("default", "the cell's own identifiers do"), ("by_deadline", "priorities follow the deadlines")),
        _bus("cob_ids"),
    ),
)


def candidates(scene: Scene) -> Iterator[tuple[Scene, tuple[Choice, ...]]]:
    """Every scene that the open keys allow, the best first; the scene itself where nothing is open."""
    keys = [key for key in _KEYS if _value(scene, key.key) == AUTO]
    window_open = any(key.key == "sensor.window" for key in keys)
    for options in itertools.product(*(key.options(scene) for key in keys)):
        candidate = scene
        choices = []
        for key, (value, why) in zip(keys, options, strict=True):
            candidate = key.put(candidate, value)
            choices.append(Choice(key.key, _written(value), why))
        sensor = candidate.sensor
        if not window_open or sensor is None or sensor.mode == "window":
            yield candidate, tuple(choices)
        elif sensor.window == window_choices(scene)[0][0]:  # a frame without a window is tried once
            yield candidate, tuple(choice for choice in choices if choice.key != "sensor.window")


def opened(scene: Scene) -> Scene:
    """The scene with every key left to the plan that stands at its default; what the sensor sends stays."""
    for key in _KEYS:
        if key.key in ("sensor.mode", "sensor.window"):
            continue
        value = _value(scene, key.key)
        section = key.key.partition(".")[0]
        if getattr(scene, section) is not None and value in (None, False, "default"):
            scene = key.put(scene, AUTO)
    return scene


def written_value(scene: Scene, path: str) -> str:
    """A key's value as a scene file writes it; a sensor without a channel of its own is on the scene's."""
    value = _value(scene, path)
    return _written(scene.bus.channel if path == "sensor.channel" and value is None else value)


def _value(scene: Scene, path: str) -> Any:
    section, _, key = path.partition(".")
    return getattr(getattr(scene, section), key, None)


def _written(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool | int) else f'"{value}"'
