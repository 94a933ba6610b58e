"""What an external arm allows: the bandwidth of the servo behind its dead time, and what the plan says of it.

The force loop about the wanted depth is `a' = w (p - a)`, where p is the height that an image shows, a delay T later:
`p = (1 - g) a`, with g the stiffness of the contact in the slope of √F over what the servo assumes. While g is below 2
it settles at any delay. Above that it does up to `w T = (π - atan s) / s`, `s = √((g - 1)² - 1)`.

Source: a first-order loop with dead time on the verge of stability, Nyquist; docs/external-arm.md compares it with
the sampled loop and with runs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from canprobe.cell.scene.setup import Setup, Touch
from canprobe.errors import at_most

STIFFER = 2.5
"""Slope of √F over the assumed one up to which the loop has to settle: a contact six times as stiff as stated."""
_S = math.sqrt((STIFFER - 1.0) ** 2 - 1.0)
HIGHEST = (math.pi - math.atan(_S)) / (2.0 * math.pi * _S)
"""Highest bandwidth of the height correction times the delay of the loop."""


def external_problems(setup: Setup) -> Iterator[str]:
    """Why a cell with an external arm cannot be brought up."""
    if setup.arm is None or (external := setup.arm.external) is None:
        return
    if setup.array is None:
        yield "sensor: missing: without an array nothing is on the bus of a cell with an external arm"
    if external.emulated and not setup.bus.virtual:
        yield f"arm.emulated: expected false on {setup.bus.interface}: an external arm is emulated in virtual time only"
    if external.address is not None and not external.emulated and setup.bus.virtual:
        yield f"arm.address: the arm at {external.address} moves in real time, and {setup.bus.interface} does not"


def loop_delay_s(setup: Setup, task: Touch) -> float:
    """Longest time from a motion to the one that answers the image of it, s."""
    from canprobe.cell.planning.contact import blind_s

    return blind_s(setup.rate_hz, task.array, task.lag_s)


def servo_problems(setup: Setup) -> Iterator[str]:
    """Why the servo of an external arm would not settle."""
    task = setup.task
    if setup.arm is None or setup.arm.external is None or not isinstance(task, Touch):
        return
    delay_s = loop_delay_s(setup, task)
    if task.gains.height_hz > (highest := HIGHEST / delay_s):
        yield (
            f"servo.surface_height_hz = {task.gains.height_hz:g}: {1e3 * delay_s:.0f} ms from a motion to the answer to"
            f" it (arm.delay_ms, servo.drive_lag_ms, images and cycles) let a contact {STIFFER**2:.0f} times as stiff"
            f" as stated settle up to {highest:.3g} Hz; lower it to {at_most(highest)}, or arm.delay_ms where the"
            " interface of the arm allows it"
        )


def arm_text(setup: Setup) -> str:
    """The external arm in a line of the plan; empty with drives."""
    if setup.arm is None or (external := setup.arm.external) is None:
        return ""
    where = "emulated" if external.emulated else f"at {external.address}" if external.address else "given in Python"
    times = f"dead time {1e3 * external.delay_s:g} ms, stops by itself after {1e3 * external.stop_after_s:g} ms"
    line = f"external, {where}: poses at {setup.rate_hz:g} Hz, {times}"
    if not isinstance(task := setup.task, Touch):
        return line
    delay_s, has_hz = loop_delay_s(setup, task), task.gains.height_hz
    return f"{line}; the servo answers after {1e3 * delay_s:.0f} ms: {has_hz:g} of at most {HIGHEST / delay_s:.3g} Hz"
