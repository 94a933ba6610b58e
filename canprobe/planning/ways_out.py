"""What to change when a scene does not fit its bus: each way is planned too, and only those that fit are named."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

from canprobe.planning.cycle import INTERPOLATION_MAX, INTERPOLATION_US
from canprobe.planning.model import Traffic
from canprobe.planning.open_keys import candidates, opened, second_channel, written_value
from canprobe.protocol.tactile import WINDOW, WINDOWS
from canprobe.scene import Scene, TactileModeName

FD_ARRAY = "tactile_array_fd.eds"
Fit = Callable[[Scene], Traffic | None]
"""Traffic of a changed scene, or None where that does not fit either."""


def ways_out(scene: Scene, fit: Fit) -> list[str]:
    """Changes each of which makes the scene fit, with the load and the longest demand that it leaves."""
    found = []
    for text, changed in (*_changes(scene), *_together(scene, fit), *_quicker(scene, fit), *_slower(scene, fit)):
        traffic = fit(changed)
        if traffic is not None:
            peak = max(traffic.demands, key=lambda demand: demand.used_ns / demand.available_ns)
            share = f"{peak.used_ns / 1000:.0f} of {peak.available_ns / 1000:.0f} µs"
            found.append(f"{text}: load {100 * traffic.load:.0f} %, peak {share}")
    return found or ["fewer nodes or a faster bus"]


def _changes(scene: Scene) -> Iterator[tuple[str, Scene]]:
    if scene.bus.bitrate < 1_000_000:
        yield "bus.bitrate = 1000000", dataclasses.replace(scene, bus=dataclasses.replace(scene.bus, bitrate=1_000_000))
    if scene.bus.transmit_queue == "fifo":
        text = 'controllers that send their most urgent frame first (bus.transmit_queue = "priority")'
        yield text, dataclasses.replace(scene, bus=dataclasses.replace(scene.bus, transmit_queue="priority"))
    if scene.arm is not None and not scene.arm.grouped_rpdo:
        yield (
            "arm.grouped_rpdo = true",
            dataclasses.replace(scene, arm=dataclasses.replace(scene.arm, grouped_rpdo=True)),
        )
    if scene.sensor is None:
        return
    smaller: dict[TactileModeName, tuple[TactileModeName, ...]] = {
        "image": ("window", "features"),
        "window": ("features",),
    }
    if scene.sensor.mode == "window":
        for side in reversed([side for side in WINDOWS if side < int(scene.sensor.window)]):
            sensor = dataclasses.replace(scene.sensor, window=side)
            yield f"sensor.window = {side}", dataclasses.replace(scene, sensor=sensor)
    for mode in smaller.get(scene.sensor.mode, ()):
        kept = scene.sensor.window if mode == "window" else WINDOW  # only a window may have another size
        text = f'sensor.mode = "{mode}"' + " without sensor.window" * (kept != scene.sensor.window)
        sensor = dataclasses.replace(scene.sensor, mode=mode, window=kept)
        yield text, dataclasses.replace(scene, sensor=sensor)
    if scene.arm is not None:
        own = second_channel(scene.bus.channel)
        if scene.sensor.channel in (None, scene.bus.channel):
            text = f'a bus of its own for the sensor (sensor.channel = "{own}")'
            yield text, dataclasses.replace(scene, sensor=dataclasses.replace(scene.sensor, channel=own))
    if not scene.bus.fd and scene.sensor.emulated:
        fd = dataclasses.replace(scene, bus=dataclasses.replace(scene.bus, fd=True))
        yield "bus.fd = true", fd
        sensor = dataclasses.replace(scene.sensor, eds=FD_ARRAY)
        yield f'CAN FD: bus.fd = true and sensor.eds = "{FD_ARRAY}"', dataclasses.replace(fd, sensor=sensor)


def _together(scene: Scene, fit: Fit) -> Iterator[tuple[str, Scene]]:
    """The cheapest of what the plan could choose by itself, where it takes more than one change."""
    for changed, choices in candidates(opened(scene)):
        differing = [choice for choice in choices if choice.value != written_value(scene, choice.key)]
        if fit(changed) is not None:
            if len(differing) > 1:
                yield " and ".join(f"{choice.key} = {choice.value}" for choice in differing), changed
            return


def _quicker(scene: Scene, fit: Fit) -> Iterator[tuple[str, Scene]]:
    """A controller that takes no longer than the bus leaves it, in whole microseconds."""
    idle = fit(_computing(scene, 0.0))
    if idle is None or idle.budget.slack_ns is None:
        return
    left_us = idle.budget.slack_ns // 1000
    if 0 < left_us < scene.cycle.compute_us:
        yield f"cycle.compute_us = {left_us}", _computing(scene, float(left_us))


def _computing(scene: Scene, compute_us: float) -> Scene:
    return dataclasses.replace(scene, cycle=dataclasses.replace(scene.cycle, compute_us=compute_us))


def _slower(scene: Scene, fit: Fit) -> Iterator[tuple[str, Scene]]:
    """The fastest cycle of whole hertz that fits, at the same number of cycles a tactile frame."""
    for rate in _representable_rates(below=scene.cycle.rate_hz):
        changed = dataclasses.replace(scene, cycle=dataclasses.replace(scene.cycle, rate_hz=rate))
        text = f"cycle.rate_hz = {rate:g}"
        if scene.sensor is not None:
            tactile = rate * scene.sensor.rate_hz / scene.cycle.rate_hz
            changed = dataclasses.replace(changed, sensor=dataclasses.replace(scene.sensor, rate_hz=tactile))
            text += f" with sensor.rate_hz = {tactile:.6g}"
        if fit(changed) is not None:
            yield text, changed
            return


def _representable_rates(below: float) -> list[float]:
    """Whole rates that 1006h and 60C2h can express, fastest first."""
    per_second = 1_000_000 // INTERPOLATION_US
    rates = [per_second / units for units in range(1, INTERPOLATION_MAX + 1) if per_second % units == 0]
    return [rate for rate in rates if rate < below]
