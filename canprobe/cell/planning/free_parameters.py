"""Keys that a scene leaves to the plan ("auto"), and changes that make a scene fit its bus.

The plan tries the values of open keys in an order, the best first. Where the bus is overloaded, changes of these and of
other keys are planned each, and only those that fit are named.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from canprobe.cell.planning.array import window_choices, windows_of
from canprobe.cell.planning.model import Choice
from canprobe.cell.planning.pdos import BusPlan
from canprobe.cell.scene.hardware import TactileModeName
from canprobe.cell.scene.setup import Array, Setup
from canprobe.fieldbus.protocol.tactile import DEFAULT_WINDOW

AUTO = "auto"
MODES: dict[TactileModeName, str] = {
    "image": "nothing is left out",
    "window": "the window round the contact holds the patch",
    "features": "the sensor computes force, centroid and moments itself",
}


@dataclass(frozen=True, slots=True)
class _FreeParameter:
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
    if not setup.drives:
        return [(setup.bus.channel, "one bus carries everything")]
    first, *others = dict.fromkeys(drive.channel for drive in setup.drives)
    return [
        (first, "beside its drives" if others else "one bus carries everything"),
        *((channel, "beside its drives") for channel in others),
        (free_channel(setup), "a separate bus for the sensor"),
    ]


def free_channel(setup: Setup) -> str:
    """The next channel that no node is on."""
    nodes = (*setup.drives, *(one for one in (setup.array, setup.carrier) if one is not None))
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
_TORQUE = _FreeParameter("arm.torque", "arm", "torque", lambda _: ((True, "recorded"), (False, "only recorded")))
KEYS = (  # the last is varied first
    _FreeParameter("sensor.mode", "array", "mode", _modes),
    _FreeParameter("sensor.window", "array", "window", window_choices),
    _TORQUE,
    _FreeParameter("sensor.channel", "array", "channel", _channels),
    _FreeParameter("bus.fd", "bus", "fd", lambda _: _FD),
    _FreeParameter("arm.grouped_rpdo", "arm", "grouped", lambda _: _GROUPED),
    _FreeParameter("bus.cob_ids", "bus", "cob_ids", lambda _: _COB_IDS),
)


def candidates(setup: Setup) -> Iterator[tuple[Setup, tuple[Choice, ...]]]:
    """Every setup that the open keys allow, the best first; the setup itself where nothing is open.

    Whatever is open, the motor torque is given up before anything that the task works with: it is only recorded.
    """
    keys = [key for key in KEYS if key.value(setup) == AUTO or (key is _TORQUE and wants_torque(setup))]
    window_open = any(key.field == "window" for key in keys)
    for chosen in itertools.product(*(key.options(setup) for key in keys)):
        candidate, choices = setup, []
        for key, (value, why) in zip(keys, chosen, strict=True):
            candidate = candidate.changed(key.part, **{key.field: value})
            choices += [Choice(key.key, value, why)] if key is not _TORQUE else []
        array = candidate.array
        if not window_open or array is None or array.mode == "window":
            yield candidate, tuple(choices)
        elif array.window == window_choices(setup)[0][0]:  # a frame without a window is tried once
            yield candidate, tuple(choice for choice in choices if choice.key != "sensor.window")


def opened(setup: Setup) -> Setup:
    """The setup with every key left to the plan that stands at its default; what the array sends stays."""
    for key in KEYS:
        default = key is not _TORQUE and key.value(setup) in (setup.bus.channel, False, "default")
        if default and getattr(setup, key.part) is not None:
            setup = setup.changed(key.part, **{key.field: AUTO})
    return setup


def wants_torque(setup: Setup) -> bool:
    return setup.arm is not None and setup.arm.torque


FD_ARRAY = "tactile_array_fd.eds"
Fit = Callable[[Setup], BusPlan | None]
"""Plans the bus of a modified setup; None where it does not fit."""


def suggested_changes(setup: Setup, fit: Fit, sound: Callable[[Setup], bool]) -> list[str]:
    """Changes each of which makes the scene fit its bus, with the load and the longest demand that it leaves.

    Args:
        setup: setup whose bus is overloaded.
        fit: see `Fit`.
        sound: function of a closed setup: whether the change asks for nothing new elsewhere in the plan.
    """
    found = []
    for text, changed in (*_changes(setup), *_together(setup, fit), *_quicker(setup, fit), *_slower(setup, fit)):
        fitting = fit(changed)
        if fitting is not None and sound(fitting.setup):
            busiest = max(fitting.buses, key=lambda bus: bus.load)
            peak = max(busiest.demands, key=lambda demand: demand.share)
            share = f"{peak.used_ns / 1000:.0f} of {peak.available_ns / 1000:.0f} µs"
            less = ", without 6077h" if wants_torque(setup) and not wants_torque(fitting.setup) else ""
            found.append(f"{text}: load {100 * busiest.load:.0f} %, peak {share}{less}")
    return found or ["fewer nodes or a faster bus"]


def _changes(setup: Setup) -> Iterator[tuple[str, Setup]]:
    """Single changes of what is sent, and of the bus."""
    bus, array = setup.bus, setup.array
    if bus.bitrate < 1_000_000:
        yield "bus.bitrate = 1000000", setup.changed("bus", bitrate=1_000_000)
    if bus.transmit_queue == "fifo":
        text = 'controllers that send their most urgent frame first (bus.transmit_queue = "priority")'
        yield text, setup.changed("bus", transmit_queue="priority")
    if setup.arm is not None and setup.drives and not setup.arm.grouped:
        yield "arm.grouped_rpdo = true", setup.changed("arm", grouped=True)
    yield from _split(setup)
    if array is None:
        return
    if array.raw is not None:
        yield from _own_bus(setup, array)
        return
    if array.mode == "window":
        for side in reversed([side for side in windows_of(array) if side < int(array.window)]):
            yield f"sensor.window = {side}", setup.changed("array", window=side)
    if array.mode == "image":
        yield 'sensor.mode = "window"', setup.changed("array", mode="window")
    if array.mode != "features":  # only a window may have another size
        text = 'sensor.mode = "features"' + " without sensor.window" * (array.mode == "window")
        yield text, setup.changed("array", mode="features", window=DEFAULT_WINDOW)
    yield from _own_bus(setup, array)
    if not bus.fd and array.emulated:
        fd = setup.changed("bus", fd=True)
        yield "bus.fd = true", fd
        yield f'CAN FD: bus.fd = true and sensor.eds = "{FD_ARRAY}"', fd.changed("array", eds=FD_ARRAY)


def _own_bus(setup: Setup, array: Array) -> Iterator[tuple[str, Setup]]:
    """The array on a separate bus, where it shares one with drives."""
    if any(array.channel == drive.channel for drive in setup.drives):
        own = free_channel(setup)
        yield f'a separate bus for the sensor (sensor.channel = "{own}")', setup.changed("array", channel=own)


def _split(setup: Setup) -> Iterator[tuple[str, Setup]]:
    """The second half of the drives on a separate bus."""
    arm = setup.arm
    if arm is None or len(arm.drives) < 2 or len({drive.channel for drive in arm.drives}) > 1:
        return
    own, kept = free_channel(setup), len(arm.drives) // 2
    drives = (*arm.drives[:kept], *(replace(drive, channel=own) for drive in arm.drives[kept:]))
    keys = " and ".join(f'joints.{joint.name}.channel = "{own}"' for joint in arm.model.joints[kept:])
    yield f"a second bus for half of the drives ({keys})", setup.changed("arm", drives=drives)


def _together(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """The cheapest combination of the keys that a plan can choose, where one change is not enough."""
    now = {key.key: key.value(setup) for key in KEYS}
    for changed, choices in candidates(opened(setup)):
        if fit(changed) is not None:
            differing = [choice for choice in choices if choice.value != now[choice.key]]
            if len(differing) > 1:
                yield " and ".join(f"{choice.key} = {choice.written}" for choice in differing), changed
            return


def _quicker(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """A computing time that the bus leaves to the controller, in whole microseconds."""
    idle = fit(replace(setup, compute_ns=0))
    if idle is None or idle.budget is None or idle.budget.slack_ns is None:
        return
    left_us = idle.budget.slack_ns // 1000
    if 0 < left_us * 1000 < setup.compute_ns:
        yield f"cycle.compute_us = {left_us}", replace(setup, compute_ns=left_us * 1000)


_SLOWEST_US = 25_500
_DIVISORS_US = [us for us in range(500, 1_000_000, 100) if 1_000_000 % us == 0]


def _slower(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """The fastest cycle of whole hertz, or of whole milliseconds, that fits, with images as fast as the scene's."""
    periods_us = {us for us in range(1000, _SLOWEST_US, 1000)} | {us for us in _DIVISORS_US if us < _SLOWEST_US}
    rates = sorted((float(f"{1e6 / us:.6g}") for us in periods_us), reverse=True)
    for rate in (rate for rate in rates if rate < setup.rate_hz):
        images, changed = at_rate(setup, rate)
        if fit(changed) is not None:
            yield f"cycle.rate_hz = {rate:.6g}{images}", changed
            return


def at_rate(setup: Setup, rate: float) -> tuple[str, Setup]:
    """The setup at another rate of the cycle, Hz, and the rate of images that this asks for, as text."""
    changed, images = replace(setup, rate_hz=rate), ""
    if setup.array is not None:
        tactile = rate / math.ceil(rate / setup.array.rate_hz - 1e-9)  # the cycle is a multiple
        changed = changed.changed("array", rate_hz=tactile)
        images = f" with sensor.rate_hz = {tactile:.6g}" * (abs(tactile / setup.array.rate_hz - 1.0) > 1e-5)
    return images, changed
