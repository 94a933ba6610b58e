"""What to change when a scene does not fit its bus: each way is planned too, and only those that fit are named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

from canprobe.planning.cycle import INTERPOLATION_MAX, INTERPOLATION_US
from canprobe.planning.model import Traffic
from canprobe.planning.open_keys import candidates, opened, second_channel, written_value
from canprobe.protocol.tactile import WINDOW, WINDOWS
from canprobe.scene_setup import ArrayMode, Setup

FD_ARRAY = "tactile_array_fd.eds"
Fit = Callable[[Setup], Traffic | None]
"""Traffic of a changed scene, or None where that does not fit either."""


def ways_out(setup: Setup, fit: Fit) -> list[str]:
    """Changes each of which makes the scene fit, with the load and the longest demand that it leaves."""
    found = []
    for text, changed in (*_changes(setup), *_together(setup, fit), *_quicker(setup, fit), *_slower(setup, fit)):
        traffic = fit(changed)
        if traffic is not None:
            peak = max(traffic.demands, key=lambda demand: demand.used_ns / demand.available_ns)
            share = f"{peak.used_ns / 1000:.0f} of {peak.available_ns / 1000:.0f} µs"
            found.append(f"{text}: load {100 * traffic.load:.0f} %, peak {share}")
    return found or ["fewer nodes or a faster bus"]


def _changes(setup: Setup) -> Iterator[tuple[str, Setup]]:
    bus, array = setup.bus, setup.array
    if bus.bitrate < 1_000_000:
        yield "bus.bitrate = 1000000", setup.with_bus(bitrate=1_000_000)
    if bus.transmit_queue == "fifo":
        text = 'controllers that send their most urgent frame first (bus.transmit_queue = "priority")'
        yield text, setup.with_bus(transmit_queue="priority")
    if setup.arm is not None and not setup.arm.grouped:
        yield "arm.grouped_rpdo = true", setup.with_arm(grouped=True)
    if array is None:
        return
    smaller: dict[ArrayMode, tuple[ArrayMode, ...]] = {
        "image": ("window", "features"),
        "window": ("features",),
    }
    if array.mode == "window":
        for side in reversed([side for side in WINDOWS if side < int(array.window)]):
            yield f"sensor.window = {side}", setup.with_array(window=side)
    for mode in smaller.get(array.mode, ()):
        kept = array.window if mode == "window" else WINDOW  # only a window may have another size
        text = f'sensor.mode = "{mode}"' + " without sensor.window" * (kept != array.window)
        yield text, setup.with_array(mode=mode, window=kept)
    if setup.arm is not None and array.channel in (None, bus.channel):
        own = second_channel(bus.channel)
        yield f'a bus of its own for the sensor (sensor.channel = "{own}")', setup.with_array(channel=own)
    if not bus.fd and array.emulated:
        fd = setup.with_bus(fd=True)
        yield "bus.fd = true", fd
        yield f'CAN FD: bus.fd = true and sensor.eds = "{FD_ARRAY}"', fd.with_array(eds=FD_ARRAY)


def _together(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """The cheapest of what the plan could choose by itself, where it takes more than one change."""
    for changed, choices in candidates(opened(setup)):
        differing = [choice for choice in choices if choice.value != written_value(setup, choice.key)]
        if fit(changed) is not None:
            if len(differing) > 1:
                yield " and ".join(f"{choice.key} = {choice.value}" for choice in differing), changed
            return


def _quicker(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """A controller that takes no longer than the bus leaves it, in whole microseconds."""
    idle = fit(replace(setup, compute_ns=0))
    if idle is None or idle.budget.slack_ns is None:
        return
    left_us = idle.budget.slack_ns // 1000
    if 0 < left_us * 1000 < setup.compute_ns:
        yield f"cycle.compute_us = {left_us}", replace(setup, compute_ns=left_us * 1000)


def _slower(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """The fastest cycle of whole hertz that fits, at the same number of cycles a tactile frame."""
    for rate in _representable_rates(below=setup.rate_hz):
        changed = replace(setup, rate_hz=rate)
        text = f"cycle.rate_hz = {rate:g}"
        if setup.array is not None:
            tactile = rate * setup.array.rate_hz / setup.rate_hz
            changed = changed.with_array(rate_hz=tactile)
            text += f" with sensor.rate_hz = {tactile:.6g}"
        if fit(changed) is not None:
            yield text, changed
            return


def _representable_rates(below: float) -> list[float]:
    """Whole rates that 1006h and 60C2h can express, fastest first."""
    per_second = 1_000_000 // INTERPOLATION_US
    rates = [per_second / units for units in range(1, INTERPOLATION_MAX + 1) if per_second % units == 0]
    return [rate for rate in rates if rate < below]
