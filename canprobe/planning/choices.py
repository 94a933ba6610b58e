"""What a scene leaves to the plan, in which order the plan tries it, and what to change where nothing fits.

What costs least is tried first: other mappings and priorities before other hardware (CAN FD, a second bus), and less
from the sensor last of all. What a scene writes is kept.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

from canprobe.planning.model import SYNC_OVERFLOW, Choice, SyncPlan, Traffic
from canprobe.protocol.tactile import WINDOW, WINDOWS
from canprobe.scene.setup import ArrayMode, Probe, Setup

# Can the cycle be said in CANopen's objects: SYNC period, interpolation period, tactile trigger.

INTERPOLATION_US = 100  # 60C2h with index −4
INTERPOLATION_MAX = 255  # 60C2h:01 is an UNSIGNED8
_TOLERANCE = 1e-5  # of a rate written with six digits


def plan_sync(setup: Setup) -> tuple[SyncPlan, list[str]]:
    """The SYNC of a scene, and why its period cannot be had.

    Source: CiA 301 object 1006h (period in µs), CiA 402 object 60C2h (interpolation period, here n·10⁻⁴ s).
    """
    step_us = 1 if setup.arm is None else INTERPOLATION_US
    period_us = max(1, round(1e6 / setup.rate_hz / step_us)) * step_us
    exact = abs(period_us * setup.rate_hz / 1e6 - 1) < _TOLERANCE
    units = period_us // INTERPOLATION_US
    problems = []
    if not exact:
        problems.append(_not_representable(setup.rate_hz, step_us))
    if setup.arm is not None and units > INTERPOLATION_MAX:
        slowest = 1e6 / (INTERPOLATION_MAX * INTERPOLATION_US)
        problems.append(
            f"cycle.rate_hz = {setup.rate_hz:g}: 60C2h holds at most {INTERPOLATION_MAX}·10⁻⁴ s; "
            f"take {slowest:.1f} Hz or more"
        )
    interpolation = None if setup.arm is None else units
    return SyncPlan(1e6 / period_us, period_us * 1000, period_us, SYNC_OVERFLOW, interpolation), problems


def _not_representable(rate_hz: float, step_us: int) -> str:
    what = "1006h counts µs" if step_us == 1 else "1006h counts µs and 60C2h n·10⁻⁴ s"
    below = int(1e6 / rate_hz / step_us)
    near = sorted(1e6 / (count * step_us) for count in (below, below + 1) if count > 0)
    return (
        f"cycle.rate_hz = {rate_hz:g}: a SYNC period of {1e6 / rate_hz:.3f} µs cannot be set ({what}); "
        f"take {' or '.join(f'{rate:.6g}' for rate in near)} Hz"
    )


def plan_ratio(setup: Setup) -> tuple[int, list[str]]:
    """How many SYNCs make one tactile frame (18xxh:02), and why the rate cannot be had."""
    if setup.array is None:
        return 1, []
    exact = setup.rate_hz / setup.array.rate_hz
    ratio = max(1, round(exact))
    if abs(exact / ratio - 1) < _TOLERANCE and SYNC_OVERFLOW % ratio == 0:
        return ratio, []
    fitting = [count for count in range(1, SYNC_OVERFLOW + 1) if SYNC_OVERFLOW % count == 0]
    near = sorted(fitting, key=lambda count: abs(count - exact))[:2]
    rates = " or ".join(f"{setup.rate_hz / count:.6g}" for count in sorted(near))
    return min(ratio, SYNC_OVERFLOW), [
        f"sensor.rate_hz = {setup.array.rate_hz:g}: a frame every {exact:.4g} SYNCs cannot be triggered; the SYNC "
        f"counter runs to {SYNC_OVERFLOW}, so cycle.rate_hz must be 1, 2, 3, 4, 5, 6, 8, … times it; take {rates} Hz"
    ]


# Which window the plan chooses: the smallest that always holds the contact patch at the target force, if it fits.
#
# The patch is that on a plane, the widest that a surface makes which is nowhere hollow. The layer on the probe is a bed
# of springs: a sphere of radius R with stiffness k a volume, pressed in by d, has the force F = π k R d² and a patch of
# radius a = √(2 R d). The window follows the centroid in steps of a taxel and lets it be off its middle by so much
# before it moves, which has to be room on both sides.
# Source: Johnson, Contact Mechanics (1985), 4.3, the elastic foundation.

PITCH_M = 1.5875e-3
FOLLOWING_TAXELS = 0.75
"""By how much the contact's centroid may be off the middle of the window before the window moves."""


def patch_radius_m(force_n: float, probe: Probe) -> float:
    """Radius of the contact patch on a plane, m."""
    depth = math.sqrt(force_n / (math.pi * probe.stiffness * probe.radius))
    return math.sqrt(2.0 * probe.radius * depth)


def patch_across_taxels(force_n: float, probe: Probe) -> float:
    """Diameter of the contact patch on a plane, in taxels."""
    return 2.0 * patch_radius_m(force_n, probe) / PITCH_M


def taxels_needed(force_n: float, probe: Probe) -> float:
    """Taxels along a window that always holds the patch."""
    return patch_across_taxels(force_n, probe) + 2.0 * FOLLOWING_TAXELS


def window_choices(setup: Setup) -> tuple[tuple[int, str], ...]:
    """Windows by preference, with the reason; without a force to hold the largest first."""
    touch = setup.touch
    if touch is None:
        return tuple((side, "the largest that fits; nothing is pressed") for side in reversed(WINDOWS))
    needed = taxels_needed(touch.force, touch.probe)
    patch = (
        f"at {touch.force:g} N the patch on a plane has {2e3 * patch_radius_m(touch.force, touch.probe):.1f} mm across"
        f" and asks for {needed:.1f} taxels with {FOLLOWING_TAXELS:g} on each side for following it"
    )
    enough = [side for side in WINDOWS if side >= needed]
    less = [side for side in reversed(WINDOWS) if side < needed]
    return (
        *((side, f"{patch}: the smallest that holds it") for side in enough[:1]),
        *((side, f"{patch}: the largest that fits, cutting its rim") for side in less),
        *((side, f"{patch}: no smaller one can be had") for side in enough[1:]),
    )


# What a scene leaves to the plan ("auto"), and in which order the plan tries it.

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


# What to change when a scene does not fit its bus: each way is planned too, and only those that fit are named.

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


# What a window that cuts the contact patch does to the force.
#
# Where enough of the patch is inside, the cell carries it on beyond the window (`canprobe.touch.patch.image`), and the
# force errs by a little. Else what lies outside presses unmeasured: the servo holds the measured force, so that the
# true one is as much larger as the window misses. The patch is that of `patch_radius_m`, the elastic foundation on a
# plane: its pressure falls from the middle to the rim as 1 - r²/a². The window follows the contact and may be off its
# middle by `FOLLOWING_TAXELS`; the array's blur, which carries some of the rim back inside, is left out.

TOLERATED = 0.05
"""Share of the force that a window may miss without a warning; the array itself errs by as much."""
CARRIED_SIDE, CARRIED_SHARE = 6, 0.5
"""Smallest window, and share of the force inside, from which the rest of a patch follows."""
CARRIED_ERROR = 0.1
"""Share of the force by which it then errs at the most, on the emulated array with its spread, blur and noise."""
_STEPS = 200
_HALVINGS = 40


def measured_share(force_n: float, probe: Probe, side: int, off_taxels: float = FOLLOWING_TAXELS) -> float:
    """Share of a force that a window feels.

    Args:
        force_n: on a plane.
        probe: the layer on it.
        side: taxels along the window.
        off_taxels: by how much the window's middle is off the contact's, along one of its sides.
    """
    radius = patch_radius_m(force_n, probe) / PITCH_M
    first, last = max(-radius, off_taxels - side / 2), min(radius, off_taxels + side / 2)
    width = max(last - first, 0.0) / _STEPS
    columns = (_column(first + (step + 0.5) * width, radius, side / 2) for step in range(_STEPS))
    return min(width * sum(columns) / (math.pi / 2 * radius**2), 1.0)


def _column(x: float, radius: float, half: float) -> float:
    """Integral of 1 - (x² + y²)/a² over y within the patch and the window."""
    height = min(half, math.sqrt(max(radius**2 - x**2, 0.0)))
    return 2.0 * height * (1.0 - (x / radius) ** 2) - 2.0 / 3.0 * height**3 / radius**2


def true_force_n(force_n: float, probe: Probe, side: int, most_n: float) -> float | None:
    """The force that presses where a window measures `force_n`, at the most; None where it is above `most_n`."""
    if most_n * measured_share(most_n, probe, side) < force_n:
        return None
    low, high = force_n, most_n
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if middle * measured_share(middle, probe, side) < force_n else (low, middle)
    return high


@dataclass(frozen=True, slots=True)
class CutPatch:
    """What a window does that feels too little of the force.

    Attributes:
        text: for people, with the numbers.
        true_n: what presses at the most where the target is measured; None: more than `limits.force_max_n`, which only
            the measured force is held against.
        ways: to feel it.
    """

    text: str
    true_n: float | None
    ways: tuple[str, ...]


def cut_patch(setup: Setup) -> CutPatch | None:
    """What the window of a scene misses; None where it feels nearly all of the force, or nothing is pressed."""
    touch = setup.touch
    if touch is None or touch.array.mode != "window":
        return None
    force, probe, side, most = touch.force, touch.probe, int(touch.array.window), setup.limits.force_max
    share = measured_share(force, probe, side)
    if share >= 1.0 - TOLERATED:
        return None
    across = 2.0 * patch_radius_m(force, probe) / PITCH_M
    cuts = (
        f"sensor.window = {side} cuts the contact patch, which is {across:.1f} taxels across on a plane at "
        f"{force:g} N; as little as {100 * share:.0f} % of that force lies inside"
    )
    if side >= CARRIED_SIDE and share >= CARRIED_SHARE:
        carried = f"the rest is carried on from there, and the force errs by up to {100 * CARRIED_ERROR:.0f} %"
        return CutPatch(f"{cuts}; {carried}", force * (1.0 + CARRIED_ERROR), _ways(force, probe))
    true_n = true_force_n(force, probe, side, most)
    presses = f"more than limits.force_max_n = {most:g} N" if true_n is None else f"up to {true_n:.2g} N"
    unfelt = f"and where the window measures {force:g} N, {presses} can press"
    return CutPatch(f"{cuts}, {unfelt}", true_n, _ways(force, probe))


def _ways(force: float, probe: Probe) -> tuple[str, ...]:
    enough = [side for side in WINDOWS if measured_share(force, probe, side) >= 1.0 - TOLERATED]
    larger = f"sensor.window = {enough[0]}" if enough else 'sensor.mode = "image"'
    return larger, "a smaller task.force_n"
