"""What a scene leaves to the plan ("auto"), and in which order the plan tries it.

What costs least is tried first: other mappings and priorities before other hardware (CAN FD, a second bus), and less
from the sensor last of all. What a scene writes is kept.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from canprobe.planning.contact_window import window_choices
from canprobe.planning.model import Choice
from canprobe.scene_setup import ArrayMode, Setup

AUTO = "auto"
_MODES: dict[str, tuple[ArrayMode, ...]] = {"listen": ("image", "window", "features")}
_FOLLOWING: tuple[ArrayMode, ...] = ("window", "features")


@dataclass(frozen=True, slots=True)
class _OpenKey:
    """One key that may say "auto".

    Attributes:
        key: section and name in a scene file.
        part: of the setup that has it.
        field: its name there.
        options: of a setup: (value, why), the dearest last.
    """

    key: str
    part: Literal["bus", "arm", "array"]
    field: str
    options: Callable[[Setup], tuple[tuple[Any, str], ...]]

    def value(self, setup: Setup) -> Any:
        """What the setup says; None where it has no such part."""
        part: Any = {"bus": setup.bus, "arm": setup.arm, "array": setup.array}[self.part]
        return None if part is None else getattr(part, self.field)

    def put(self, setup: Setup, value: Any) -> Setup:
        """The setup with another value."""
        change = {"bus": setup.with_bus, "arm": setup.with_arm, "array": setup.with_array}[self.part]
        return change(**{self.field: value})

    def written(self, setup: Setup) -> str:
        """The value as a scene file writes it; an array without a channel of its own is on the scene's."""
        value = self.value(setup)
        return _written(setup.bus.channel if self.key == "sensor.channel" and value is None else value)


def _modes(setup: Setup) -> tuple[tuple[Any, str], ...]:
    why = {
        "image": "nothing is left out",
        "window": "the window round the contact holds the patch",
        "features": "the sensor computes force, centroid and moments itself",
    }
    return tuple((mode, why[mode]) for mode in _MODES.get(setup.kind, _FOLLOWING))


def _channels(setup: Setup) -> tuple[tuple[Any, str], ...]:
    one = (setup.bus.channel, "one bus carries everything")
    return (
        (one,) if setup.arm is None else (one, (second_channel(setup.bus.channel), "a bus of its own for the sensor"))
    )


def second_channel(channel: str) -> str:
    """The next channel's name: can1 after can0."""
    match = re.fullmatch(r"(.*?)(\d+)", channel)
    return f"{match[1]}{int(match[2]) + 1}" if match else f"{channel}2"


_KEYS = (  # the last is varied first
    _OpenKey("sensor.mode", "array", "mode", _modes),
    _OpenKey("sensor.window", "array", "window", window_choices),
    _OpenKey("sensor.channel", "array", "channel", _channels),
    _OpenKey(
        "bus.fd",
        "bus",
        "fd",
        lambda _: ((False, "classical frames do"), (True, "PDOs of up to 64 bytes in CAN FD frames")),
    ),
    _OpenKey(
        "arm.grouped_rpdo",
        "arm",
        "grouped",
        lambda _: ((False, "each drive has its target to itself"), (True, "two targets share an RPDO through dummies")),
    ),
    _OpenKey(
        "bus.cob_ids",
        "bus",
        "cob_ids",
        lambda _: (("default", "the cell's own identifiers do"), ("by_deadline", "priorities follow the deadlines")),
    ),
)


def candidates(setup: Setup) -> Iterator[tuple[Setup, tuple[Choice, ...]]]:
    """Every setup that the open keys allow, the best first; the setup itself where nothing is open."""
    keys = [key for key in _KEYS if key.value(setup) == AUTO]
    window_open = any(key.key == "sensor.window" for key in keys)
    for options in itertools.product(*(key.options(setup) for key in keys)):
        candidate = setup
        choices = []
        for key, (value, why) in zip(keys, options, strict=True):
            candidate = key.put(candidate, value)
            choices.append(Choice(key.key, _written(value), why))
        array = candidate.array
        if not window_open or array is None or array.mode == "window":
            yield candidate, tuple(choices)
        elif array.window == window_choices(setup)[0][0]:  # a frame without a window is tried once
            yield candidate, tuple(choice for choice in choices if choice.key != "sensor.window")


def opened(setup: Setup) -> Setup:
    """The setup with every key left to the plan that stands at its default; what the array sends stays."""
    parts = {"bus": setup.bus, "arm": setup.arm, "array": setup.array}
    for key in _KEYS:
        if key.key in ("sensor.mode", "sensor.window") or parts[key.part] is None:
            continue
        if key.value(setup) in (None, False, "default"):
            setup = key.put(setup, AUTO)
    return setup


def written_value(setup: Setup, path: str) -> str:
    """An open key's value as a scene file writes it."""
    return next(key for key in _KEYS if key.key == path).written(setup)


def _written(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool | int) else f'"{value}"'
