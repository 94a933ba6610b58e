"""Keys that a scene leaves to the plan ("auto"), and the order in which the plan tries their values."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from canprobe.cell.planning.model import Choice
from canprobe.cell.planning.window import (
    window_choices,
)
from canprobe.cell.scene.hardware import TactileModeName
from canprobe.cell.scene.setup import Setup

AUTO = "auto"
MODES: dict[TactileModeName, str] = {
    "image": "nothing is left out",
    "window": "the window round the contact holds the patch",
    "features": "the sensor computes force, centroid and moments itself",
}


@dataclass(frozen=True, slots=True)
class _OpenKey:
    """One key that may say "auto".

    Attributes:
        key: section and name in a scene file.
        part: part of the setup that has it.
        field: its name there.
        options: values to try for a setup, as (value, why), the dearest last.
    """

    key: str
    part: Literal["bus", "arm", "array"]
    field: str
    options: Callable[[Setup], Sequence[tuple[Any, str]]]

    def value(self, setup: Setup) -> Any:
        """The value in the setup; None where it has no such part."""
        return getattr(getattr(setup, self.part), self.field, None)


def _modes(setup: Setup) -> list[tuple[TactileModeName, str]]:
    """All modes where the array only listens; else those that follow the contact."""
    return [(mode, why) for mode, why in MODES.items() if mode != "image" or setup.kind == "listen"]


def _channels(setup: Setup) -> list[tuple[str, str]]:
    if setup.arm is None:
        return [(setup.bus.channel, "one bus carries everything")]
    first, *others = dict.fromkeys(drive.channel for drive in setup.arm.drives)
    return [
        (first, "beside its drives" if others else "one bus carries everything"),
        *((channel, "beside its drives") for channel in others),
        (free_channel(setup), "a separate bus for the sensor"),
    ]


def free_channel(setup: Setup) -> str:
    """The next channel that no node is on."""
    nodes = (*(setup.arm.drives if setup.arm is not None else ()), *((setup.array,) if setup.array is not None else ()))
    channel, taken = setup.bus.channel, {setup.bus.channel, *(node.channel for node in nodes)}
    while channel in taken:
        channel = second_channel(channel)
    return channel


def second_channel(channel: str) -> str:
    """The next channel's name: can1 after can0."""
    match = re.fullmatch(r"(.*?)(\d+)", channel)
    return f"{match[1]}{int(match[2]) + 1}" if match else f"{channel}2"


_FD = ((False, "classical frames do"), (True, "PDOs of up to 64 bytes in CAN FD frames"))
_GROUPED = ((False, "each drive has its own target RPDO"), (True, "two targets share an RPDO through dummies"))
_COB_IDS = (
    ("default", "the cell's own identifiers do"),
    ("by_deadline", "priorities follow the deadlines"),
)
KEYS = (  # the last is varied first
    _OpenKey("sensor.mode", "array", "mode", _modes),
    _OpenKey("sensor.window", "array", "window", window_choices),
    _OpenKey("sensor.channel", "array", "channel", _channels),
    _OpenKey("bus.fd", "bus", "fd", lambda _: _FD),
    _OpenKey("arm.grouped_rpdo", "arm", "grouped", lambda _: _GROUPED),
    _OpenKey("bus.cob_ids", "bus", "cob_ids", lambda _: _COB_IDS),
)


def candidates(setup: Setup) -> Iterator[tuple[Setup, tuple[Choice, ...]]]:
    """Every setup that the open keys allow, the best first; the setup itself where nothing is open.

    Whatever is open, the motor torque is given up before anything that the task works with: it is only recorded.
    """
    keys = [key for key in KEYS if key.value(setup) == AUTO]
    window_open = any(key.field == "window" for key in keys)
    sensing = [key for key in keys if key.part == "array" and key.field != "channel"]
    wiring = [key for key in keys if key not in sensing]
    for chosen in itertools.product(*(key.options(setup) for key in sensing)):
        for torque in (True, False) if wants_torque(setup) else (True,):
            for others in itertools.product(*(key.options(setup) for key in wiring)):
                candidate, choices = setup, []
                for key, (value, why) in zip((*sensing, *wiring), (*chosen, *others), strict=True):
                    candidate = candidate.changed(key.part, **{key.field: value})
                    choices.append(Choice(key.key, value, why))
                if not torque:
                    candidate = candidate.changed("arm", torque=False)
                array = candidate.array
                if not window_open or array is None or array.mode == "window":
                    yield candidate, tuple(choices)
                elif array.window == window_choices(setup)[0][0]:  # a frame without a window is tried once
                    yield candidate, tuple(choice for choice in choices if choice.key != "sensor.window")


def opened(setup: Setup) -> Setup:
    """The setup with every key left to the plan that stands at its default; what the array sends stays."""
    for key in KEYS:
        if getattr(setup, key.part) is not None and key.value(setup) in (setup.bus.channel, False, "default"):
            setup = setup.changed(key.part, **{key.field: AUTO})
    return setup


def wants_torque(setup: Setup) -> bool:
    return setup.arm is not None and setup.arm.torque
