"""Changes that make a scene fit its bus: each one is planned, and only those that fit are named."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

from canprobe.cell.planning.model import Traffic
from canprobe.cell.planning.open_keys import KEYS, candidates, free_channel, opened, wants_torque
from canprobe.cell.planning.window import (
    windows_of,
)
from canprobe.cell.scene.setup import Array, Setup
from canprobe.fieldbus.protocol.tactile import DEFAULT_WINDOW

FD_ARRAY = "tactile_array_fd.eds"
Fit = Callable[[Setup], tuple[Setup, Traffic] | None]
"""Closes a changed setup, and gives it with the traffic of its fullest bus; None where it does not fit either."""


def ways_out(setup: Setup, fit: Fit, sound: Callable[[Setup], bool]) -> list[str]:
    """Changes each of which makes the scene fit its bus, with the load and the longest demand that it leaves.

    Args:
        setup: setup whose bus is overloaded.
        fit: see `Fit`.
        sound: function of a closed setup: whether the change asks for nothing new elsewhere in the plan.
    """
    found = []
    for text, changed in (*_changes(setup), *_together(setup, fit), *_quicker(setup, fit), *_slower(setup, fit)):
        fitting = fit(changed)
        if fitting is not None and sound(fitting[0]):
            closed, traffic = fitting
            peak = max(traffic.demands, key=lambda demand: demand.used_ns / demand.available_ns)
            share = f"{peak.used_ns / 1000:.0f} of {peak.available_ns / 1000:.0f} µs"
            less = ", without 6077h" if wants_torque(setup) and not wants_torque(closed) else ""
            found.append(f"{text}: load {100 * traffic.load:.0f} %, peak {share}{less}")
    return found or ["fewer nodes or a faster bus"]


def _changes(setup: Setup) -> Iterator[tuple[str, Setup]]:
    """Single changes of what is sent, and of the bus."""
    bus, array = setup.bus, setup.array
    if bus.bitrate < 1_000_000:
        yield "bus.bitrate = 1000000", setup.changed("bus", bitrate=1_000_000)
    if bus.transmit_queue == "fifo":
        text = 'controllers that send their most urgent frame first (bus.transmit_queue = "priority")'
        yield text, setup.changed("bus", transmit_queue="priority")
    if setup.arm is not None and not setup.arm.grouped:
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
    if setup.arm is not None and any(array.channel == drive.channel for drive in setup.arm.drives):
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
    if idle is None or (slack_ns := idle[1].budget.slack_ns) is None:
        return
    left_us = slack_ns // 1000
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
