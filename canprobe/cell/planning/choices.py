"""Every decision of a plan with its reason: what it chooses where a scene leaves that open, what would make a scene
fit that does not, what it leaves out, and of what it warns.

What costs least is tried first: other mappings and priorities before other hardware (CAN FD, a second bus), and less
from the array last of all. What a scene writes is kept.
"""

from __future__ import annotations

import importlib.util
import ipaddress
import itertools
import math
import re
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from canprobe.cell.planning.array import support_of
from canprobe.cell.planning.bridges import bridge_outputs
from canprobe.cell.planning.model import Choice, PlannedPdo, Traffic
from canprobe.cell.planning.window import (
    TOLERATED,
    cut_patch,
    measured_share,
    patch_across_taxels,
    window_choices,
    windows_of,
)
from canprobe.cell.scene.setup import Arm, Array, ArrayMode, Setup, Touch, Touching
from canprobe.errors import install_line
from canprobe.fieldbus.protocol.frame_bits import WORST_ERROR_BITS
from canprobe.fieldbus.protocol.tactile import WINDOW
from canprobe.mechanics.robot.inverse import FIXED_POLE, FULL_POSE, task_rows
from canprobe.mechanics.touch.patch.array_calibration import NOMINAL

# What a scene leaves to the plan ("auto"), and in which order the plan tries it.

AUTO = "auto"
_MODES: dict[ArrayMode, str] = {
    "image": "nothing is left out",
    "window": "the window round the contact holds the patch",
    "features": "the sensor computes force, centroid and moments itself",
}


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
    options: Callable[[Setup], Sequence[tuple[Any, str]]]

    def value(self, setup: Setup) -> Any:
        """What the setup says; None where it has no such part."""
        return getattr(getattr(setup, self.part), self.field, None)

    def written(self, setup: Setup) -> str:
        """The value as a scene file writes it."""
        return _written(self.value(setup))


def _written(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool | int) else f'"{value}"'


def _modes(setup: Setup) -> list[tuple[ArrayMode, str]]:
    """Of an array that only listens all; of one that is touched those that follow the contact."""
    return [(mode, why) for mode, why in _MODES.items() if mode != "image" or setup.kind == "listen"]


def _channels(setup: Setup) -> list[tuple[str, str]]:
    if setup.arm is None:
        return [(setup.bus.channel, "one bus carries everything")]
    first, *others = dict.fromkeys(drive.channel for drive in setup.arm.drives)
    return [
        (first, "beside its drives" if others else "one bus carries everything"),
        *((channel, "beside its drives") for channel in others),
        (_free_channel(setup), "a separate bus for the sensor"),
    ]


def _free_channel(setup: Setup) -> str:
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
_KEYS = (  # the last is varied first
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
    keys = [key for key in _KEYS if key.value(setup) == AUTO]
    window_open = any(key.field == "window" for key in keys)
    sensing = [key for key in keys if key.part == "array" and key.field != "channel"]
    wiring = [key for key in keys if key not in sensing]
    for chosen in itertools.product(*(key.options(setup) for key in sensing)):
        for torque in (True, False) if _wants_torque(setup) else (True,):
            for others in itertools.product(*(key.options(setup) for key in wiring)):
                candidate, choices = setup, []
                for key, (value, why) in zip((*sensing, *wiring), (*chosen, *others), strict=True):
                    candidate = candidate.changed(key.part, **{key.field: value})
                    choices.append(Choice(key.key, _written(value), why))
                if not torque:
                    candidate = candidate.changed("arm", torque=False)
                array = candidate.array
                if not window_open or array is None or array.mode == "window":
                    yield candidate, tuple(choices)
                elif array.window == window_choices(setup)[0][0]:  # a frame without a window is tried once
                    yield candidate, tuple(choice for choice in choices if choice.key != "sensor.window")


def opened(setup: Setup) -> Setup:
    """The setup with every key left to the plan that stands at its default; what the array sends stays."""
    for key in _KEYS:
        if getattr(setup, key.part) is not None and key.value(setup) in (setup.bus.channel, False, "default"):
            setup = setup.changed(key.part, **{key.field: AUTO})
    return setup


# What to change when a scene does not fit its bus: each way is planned too, and only those that fit are named.

FD_ARRAY = "tactile_array_fd.eds"
Fit = Callable[[Setup], tuple[Setup, Traffic] | None]
"""A changed setup as the plan closes it and the traffic of its fullest bus; None where that does not fit either."""


def ways_out(setup: Setup, fit: Fit) -> list[str]:
    """Changes each of which makes the scene fit, with the load and the longest demand that it leaves."""
    found = []
    for text, changed in (*_changes(setup), *_together(setup, fit), *_quicker(setup, fit), *_slower(setup, fit)):
        if (fitting := fit(changed)) is not None:
            closed, traffic = fitting
            peak = max(traffic.demands, key=lambda demand: demand.used_ns / demand.available_ns)
            share = f"{peak.used_ns / 1000:.0f} of {peak.available_ns / 1000:.0f} µs"
            less = ", without 6077h" if _wants_torque(setup) and not _wants_torque(closed) else ""
            found.append(f"{text}: load {100 * traffic.load:.0f} %, peak {share}{less}")
    return found or ["fewer nodes or a faster bus"]


def _wants_torque(setup: Setup) -> bool:
    return setup.arm is not None and setup.arm.torque


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
        yield text, setup.changed("array", mode="features", window=WINDOW)
    yield from _own_bus(setup, array)
    if not bus.fd and array.emulated:
        fd = setup.changed("bus", fd=True)
        yield "bus.fd = true", fd
        yield f'CAN FD: bus.fd = true and sensor.eds = "{FD_ARRAY}"', fd.changed("array", eds=FD_ARRAY)


def _own_bus(setup: Setup, array: Array) -> Iterator[tuple[str, Setup]]:
    """The array on a bus of its own, where it shares one with drives."""
    if setup.arm is not None and any(array.channel == drive.channel for drive in setup.arm.drives):
        own = _free_channel(setup)
        yield f'a separate bus for the sensor (sensor.channel = "{own}")', setup.changed("array", channel=own)


def _split(setup: Setup) -> Iterator[tuple[str, Setup]]:
    """The second half of the drives on a bus of their own."""
    arm = setup.arm
    if arm is None or len(arm.drives) < 2 or len({drive.channel for drive in arm.drives}) > 1:
        return
    own, kept = _free_channel(setup), len(arm.drives) // 2
    drives = (*arm.drives[:kept], *(replace(drive, channel=own) for drive in arm.drives[kept:]))
    keys = " and ".join(f'joints.{joint.name}.channel = "{own}"' for joint in arm.model.joints[kept:])
    yield f"a second bus for half of the drives ({keys})", setup.changed("arm", drives=drives)


def _together(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """The cheapest combination of what the plan could choose, where one change is not enough."""
    now = {key.key: key.written(setup) for key in _KEYS}
    for changed, choices in candidates(opened(setup)):
        if fit(changed) is not None:
            differing = [choice for choice in choices if choice.value != now[choice.key]]
            if len(differing) > 1:
                yield " and ".join(f"{choice.key} = {choice.value}" for choice in differing), changed
            return


def _quicker(setup: Setup, fit: Fit) -> Iterator[tuple[str, Setup]]:
    """A controller that takes no longer than the bus leaves it, in whole microseconds."""
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
        changed, text = replace(setup, rate_hz=rate), f"cycle.rate_hz = {rate:.6g}"
        if setup.array is not None:
            tactile = rate / math.ceil(rate / setup.array.rate_hz)  # the cycle is a multiple
            changed = changed.changed("array", rate_hz=tactile)
            text += f" with sensor.rate_hz = {tactile:.6g}" * (tactile != setup.array.rate_hz)
        if fit(changed) is not None:
            yield text, changed
            return


# What a scene does not need, and the files that follow from what it does.

_NO_SHAPE = {
    "press": "one touch without motion shows no shape",
    "calibrate": "the ball is known",
    "listen": "nothing moves",
    "free": "nothing is touched",
}
_NO_STRATEGY = {
    "press": "the probe holds still",
    "calibrate": "no surface is followed",
    "listen": "nothing moves",
    "free": "the joints swing, no surface is followed",
}
_EFFECTS = {
    "noise": "taxel noise",
    "gain_error": "taxel gain error",
    "blur": "cover blur",
    "hysteresis": "taxel hysteresis",
    "creep": "taxel creep",
    "crosstalk": "taxel crosstalk",
    "saturation": "taxel saturation",
    "threshold": "the array's own threshold",
}
_BY_ARRAY = f'sensor.mode = "features": {_MODES["features"]}'
IMAGE, OWN_WINDOW = "full image (32 PDOs)", "window (8 PDOs)"
RAW_DEVICE = "node of the array, its PDOs and its supervision by heartbeat"
ESTIMATOR, FIGURE, PAGE = "surface estimator", "figure", "replay to share (report.html)"
BUS = "bus, bring-up by SDO and their log (bus.log)"
TRUTH = "truth and scores against it"


def left_out(setup: Setup) -> tuple[tuple[str, str], ...]:
    """Everything that a closed setup leaves out, as (what, why)."""
    return *_not_sent(setup), *_not_computed(setup), *_not_emulated(setup), *_not_shown(setup)


def _not_sent(setup: Setup) -> Iterator[tuple[str, str]]:
    array, kind = setup.array, setup.kind
    if setup.bus.direct:
        yield BUS, 'bus.interface = "direct": counts and images pass in the place of frames'
    if setup.arm is None:
        yield "drives, their PDOs, joint limits", f'no [arm]: task.kind = "{kind}" moves nothing'
    elif not setup.arm.torque:
        yield "motor torque (6077h)", "arm.torque is false, or the bus has no room for it beside what the task needs"
    if array is None:
        yield "tactile node and its PDOs", f'no [sensor]: task.kind = "{kind}" feels nothing'
    elif array.raw is not None:
        yield RAW_DEVICE, 'wire.kind = "frames": the device knows no CANopen'
    elif array.mode == "window":
        yield IMAGE, _by_window(setup.touch, int(array.window))
    elif array.mode == "image":
        yield OWN_WINDOW, "the full image is sent"
    else:
        yield from ((what, _BY_ARRAY) for what in (IMAGE, OWN_WINDOW, "taxels and patch features in the master"))


def _not_computed(setup: Setup) -> Iterator[tuple[str, str]]:
    array, shape, kind = setup.array, setup.shape, setup.kind
    if shape is None:
        yield ESTIMATOR, _NO_SHAPE.get(kind, "no [shape]")
    elif not shape.patch or (array is not None and array.mode == "features"):
        support = support_of(setup)
        lacking = support is not None and not support.curvature
        off = f"the array: {support}" if lacking else "shape.patch = false"
        yield "curvature from the patch", _BY_ARRAY if shape.patch else off
    if kind in _NO_STRATEGY:
        yield "exploration strategy", _NO_STRATEGY[kind]
    if not isinstance(setup.task, Touch):
        yield "tactile servo", f'task.kind = "{kind}" controls no force'


def _not_emulated(setup: Setup) -> Iterator[tuple[str, str]]:
    arm, array, kind = setup.arm, setup.array, setup.kind
    if not setup.emulates:
        yield "emulator", "every node is real"
        yield TRUTH, "no emulated node"
    elif setup.truth.object is None and kind != "free":
        yield TRUTH, "no [object]: nothing to compare with"
    if arm is not None and setup.truth.fidelity == "ideal" and any(drive.emulated for drive in arm.drives):
        yield "arm dynamics", 'plant.fidelity = "ideal": each drive tracks as a second-order system'
    for effect, what in _EFFECTS.items():
        if array is not None and effect in setup.truth.without:
            yield what, f"plant.{effect} = false"


def _not_shown(setup: Setup) -> Iterator[tuple[str, str]]:
    if not setup.figures:
        yield from ((what, "scene.figures = false") for what in (FIGURE, PAGE))
    else:
        if importlib.util.find_spec("matplotlib") is None:
            yield FIGURE, f"the study extra is not installed: {install_line('study')}"
        if setup.kind == "listen":
            yield PAGE, 'task.kind = "listen": nothing moves'
        elif importlib.util.find_spec("viser") is None:
            yield PAGE, f"the view extra is not installed: {install_line('view')}"
    if not setup.bridge.use:
        yield "bridges to other tools", "no [bridge]: no other tool is fed"


def _by_window(touch: Touching | None, side: int) -> str:
    name = f"the {side}×{side} window round the contact"
    if touch is None:
        return f"{name} is sent"
    pitch = touch.array.pad.pitch_m
    if side >= patch_across_taxels(touch.force, touch.probe, pitch):
        return f"{name} holds the patch"
    outside = 1.0 - measured_share(touch.force, touch.probe, side, pitch)
    return f"{name} is sent, with up to {100 * outside:.0f} % of the force outside"


def outputs(setup: Setup, absent: Container[str]) -> tuple[str, ...]:
    """The files that a run of this scene writes.

    Args:
        setup: of the scene.
        absent: what the plan leaves out.
    """
    written = {
        "summary.json": True,
        "log.npz": True,
        "tactile.npz": setup.array is not None,
        "bus.log": BUS not in absent,
        "scene.toml": True,
        "truth.npz": TRUTH not in absent,
        "tool.toml": setup.kind == "calibrate",
        "surface.npz": ESTIMATOR not in absent,
        "report.png": FIGURE not in absent,
        "surface.png": FIGURE not in absent and ESTIMATOR not in absent,
        "report.html": PAGE not in absent,
    }
    return (*(file for file, is_written in written.items() if is_written), *bridge_outputs(setup))


def _long_waits(missed_syncs: int, rate_hz: float) -> Iterator[str]:
    """What real drives may do that wait for long."""
    if missed_syncs <= MISSED_SYNCS_REAL:
        return
    waited_ms = 1e3 * missed_syncs / rate_hz
    yield (
        f"arm.missed_syncs = {missed_syncs}: real drives stay enabled for {waited_ms:g} ms after the last SYNC of"
        " a master that stalls or dies, and a drive that falls silent is waited for as long: an object that moves is"
        f" pressed without supervision until then; leave it at {MISSED_SYNCS_REAL} or below, more is for emulated nodes"
    )


def _held_rows(arm: Arm) -> str:
    name = f"the {arm.model.name} arm of {arm.model.n} joints"
    if task_rows(arm.model) == FIXED_POLE:
        return (
            f"{name} keeps the orientation of the probe: task.rolling_share is 1, and the contact wanders on the array"
        )
    return f"{name} holds position and pole of the probe and leaves the turn about the pole free"


# What a plan carries out and yet says first: who else can command it, and where the numbers in it do not hold.

ON_THIS_MACHINE = "ff11::ca"
"""A multicast group of interface-local scope, which no packet leaves or enters. Source: RFC 4291, 2.7."""


def _open_to_others(setup: Setup) -> Iterator[str]:
    """What lets other machines reach the cell, and what to write to keep it on this one."""
    bridge = setup.bridge
    yield from bus_open_to_others(setup.bus.interface, setup.bus.channel)
    if "ros2" in bridge.use and not bridge.ros2_loopback:
        may = "can start, stop and move the cell" if bridge.ros2_commands else "sees the cell"
        yield (
            f"bridge.ros2_loopback = false: every machine on this network segment {may};"
            " bridge.ros2_loopback = true keeps its topics on this machine, CYCLONEDDS_URI on some interfaces"
        )


def bus_open_to_others(interface: str, channel: str) -> Iterator[str]:
    """A warning, where other machines reach a bus.

    Args:
        interface: of python-can.
        channel: of it.
    """
    if interface == "udp_multicast" and not _is_interface_local(channel):
        yield (
            f"bus.channel = {channel}: every machine on this network segment hears this bus and can command its"
            f" nodes; --channel {ON_THIS_MACHINE} keeps it on this machine"
        )


def _is_interface_local(channel: str) -> bool:
    try:
        group = ipaddress.ip_address(channel)
    except ValueError:
        return False
    return group.version == 6 and group.is_multicast and int(group) >> 112 & 0xF == 1


MISSED_SYNCS_REAL = 10
"""SYNC periods for which real drives and their master may wait for each other without a warning."""


def warnings(setup: Setup, pdos: Sequence[PlannedPdo]) -> Iterator[str]:
    """What a user has to know before trusting the plan, most important first."""
    cut, bus = cut_patch(setup), setup.bus
    yield from _open_to_others(setup)
    if setup.arm is not None:
        yield from setup.arm.warnings
    if setup.arm is not None and not all(drive.emulated for drive in setup.arm.drives):
        yield from _long_waits(setup.arm.missed_syncs, setup.rate_hz)
    if setup.array is not None and setup.array.newtons == NOMINAL:
        yield (
            "sensor.calibration: the array measures in nominal newtons, as good as its stated full scale;"
            " `canprobe calibrate array CELL --force-reference scale` gives them a reference"
        )
    if cut is not None:
        yield f"{cut.text}; {' or '.join(cut.ways)} leaves less than {100 * TOLERATED:.0f} % outside"
    if setup.arm is not None and setup.touch is not None and task_rows(setup.arm.model) < FULL_POSE:
        yield _held_rows(setup.arm)
    if bus.bit_error_rate > 0 and pdos:
        longest = max(pdo.bits_worst for pdo in pdos)
        lost = 1.0 - (1.0 - bus.bit_error_rate) ** longest
        each_us = (WORST_ERROR_BITS + longest) * 1e6 / bus.bitrate
        yield (
            f"bus.bit_error_rate = {bus.bit_error_rate:g}: response times hold for a wire without errors; each error "
            f"adds up to {each_us:.0f} µs, and up to {100 * lost:.2g} % of the frames have one"
        )
