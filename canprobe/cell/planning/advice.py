"""What a plan says besides: the parts that its scene does not need, the files that its run writes, and warnings."""

from __future__ import annotations

import importlib.util
from collections.abc import Container, Iterator, Sequence

from canprobe.cell.planning.array import cut_patch, measured_share, patch_across_taxels, support_of
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.free_parameters import MODES
from canprobe.cell.planning.model import PlannedPdo
from canprobe.cell.scene.geometry import mesh_warnings
from canprobe.cell.scene.rules import SECTIONS_OF_TASK
from canprobe.cell.scene.setup import Arm, Array, Calibrate, Setup, Touch, Touching
from canprobe.errors import at_most, install_line
from canprobe.fieldbus.bus.real.adapters import bus_open_to_others
from canprobe.fieldbus.protocol.frame_bits import WORST_ERROR_BITS

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
_BY_ARRAY = f'sensor.mode = "features": {MODES["features"]}'
IMAGE, OWN_WINDOW = "full image (32 PDOs)", "window (8 PDOs)"
ARRAY_NODE_PARTS = "node of the array, its PDOs and its supervision by heartbeat"
ESTIMATOR, SURFACE_MAP, FIGURE = "surface estimator", "surface map", "figure"
BUS_PARTS, BUS_LOG = "bus, bring-up by SDO and their log (bus.log)", "log of the bus (bus.log)"
TRUTH_PARTS = "truth and scores against it"


def omitted_features(setup: Setup) -> tuple[tuple[str, str], ...]:
    """Everything that a closed setup leaves out, as (what, why)."""
    return *_not_sent(setup), *_not_computed(setup), *_not_emulated(setup), *_not_shown(setup)


def _not_sent(setup: Setup) -> Iterator[tuple[str, str]]:
    array, kind = setup.array, setup.kind
    if setup.bus.direct:
        yield BUS_PARTS, 'bus.interface = "direct": counts and images pass in the place of frames'
    elif not setup.outputs.bus_log:
        yield BUS_LOG, "outputs.bus_log = false"
    if setup.arm is None:
        yield "drives, their PDOs, joint limits", f'no [arm]: task.kind = "{kind}" moves nothing'
    elif setup.arm.external is not None:
        yield "drives, their PDOs, torques and homing", 'arm.kind = "external": poses of the flange take their place'
    elif not setup.arm.torque:
        yield "motor torque (6077h)", "arm.torque is false, or the bus has no room for it beside what the task needs"
    if array is None:
        yield "tactile node and its PDOs", f'no [sensor]: task.kind = "{kind}" touches nothing'
    elif array.raw is not None:
        yield ARRAY_NODE_PARTS, 'wire.kind = "frames": the device knows no CANopen'
    elif array.mode == "window":
        yield IMAGE, _by_window(setup.touch, int(array.window))
    elif array.mode == "image":
        yield OWN_WINDOW, "the full image is sent"
    else:
        yield from ((what, _BY_ARRAY) for what in (IMAGE, OWN_WINDOW, "taxels and patch features in the master"))


def _not_computed(setup: Setup) -> Iterator[tuple[str, str]]:
    array, shape, kind = setup.array, setup.shape, setup.kind
    if shape is None:
        yield ESTIMATOR, SECTIONS_OF_TASK[kind]["shape"][1] or "no [shape]"
    elif not shape.patch or (array is not None and array.mode == "features"):
        support = support_of(setup)
        lacking = support is not None and not support.curvature
        off = f"the array: {support}" if lacking else "shape.patch = false"
        yield "curvature from the patch", _BY_ARRAY if shape.patch else off
    if shape is not None and not setup.outputs.surface_map:
        yield SURFACE_MAP, "outputs.surface_map = false"
    if kind in _NO_STRATEGY:
        yield "exploration strategy", _NO_STRATEGY[kind]
    if not isinstance(setup.task, Touch):
        yield "tactile servo", f'task.kind = "{kind}" controls no force'


def _not_emulated(setup: Setup) -> Iterator[tuple[str, str]]:
    array, kind = setup.array, setup.kind
    if not setup.emulates:
        yield "emulator", "every node is real"
        yield TRUTH_PARTS, "no emulated node"
    elif setup.truth.object is None and kind != "free":
        yield TRUTH_PARTS, "no [object]: nothing to compare with"
    elif not setup.outputs.truth:
        yield TRUTH_PARTS, "outputs.truth = false: true values, errors and the map's coverage are null in summary.json"
    if setup.truth.fidelity == "ideal" and setup.emulates_arm:
        yield "arm dynamics", 'plant.fidelity = "ideal": each drive tracks as a second-order system'
    for effect, what in _EFFECTS.items():
        if array is not None and effect in setup.truth.without:
            yield what, f"plant.{effect} = false"


def _not_shown(setup: Setup) -> Iterator[tuple[str, str]]:
    if not setup.outputs.figures:
        yield FIGURE, "outputs.figures = false"
    elif importlib.util.find_spec("matplotlib") is None:
        yield FIGURE, f"the study extra is not installed: {install_line('study')}"
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
        setup: closed setup of the scene.
        absent: names of the parts that the plan leaves out.
    """
    mapped = ESTIMATOR not in absent and SURFACE_MAP not in absent
    written = {
        "summary.json": True,
        "log.npz": True,
        "tactile.npz": setup.array is not None,
        "bus.log": BUS_PARTS not in absent and BUS_LOG not in absent,
        "scene.toml": True,
        "truth.npz": TRUTH_PARTS not in absent,
        "tool.toml": setup.kind == "calibrate",
        "surface.npz": mapped,
        "report.png": FIGURE not in absent,
        "surface.png": mapped and FIGURE not in absent,
        **{output: True for name in setup.bridge.use if (output := BRIDGES[name].output) is not None},
    }
    return tuple(file for file, is_written in written.items() if is_written)


MISSED_SYNCS_REAL = 10
"""SYNC periods for which real drives and their master may wait for each other without a warning."""


def _open_to_others(setup: Setup) -> Iterator[str]:
    """Warnings where other machines reach the cell, with the key that keeps it on this one."""
    bridge = setup.bridge
    yield from bus_open_to_others(setup.bus.interface, setup.bus.channel)
    if "ros2" in bridge.use and not bridge.ros2_loopback:
        may = "can start, stop and move the cell" if bridge.ros2_commands else "sees the cell"
        yield (
            f"bridge.ros2_loopback = false: every machine on this network segment {may};"
            " bridge.ros2_loopback = true keeps its topics on this machine, CYCLONEDDS_URI on some interfaces"
        )


def _calibration_warnings(array: Array, setup: Setup) -> Iterator[str]:
    """Warnings of what the calibration of an array does not state, and of what is taken for it."""
    from canprobe.mechanics.touch.image.calibration import NO_FORCE_REFERENCE
    from canprobe.mechanics.touch.image.force_errors import MAKE_SPREAD, UNSTATED

    if array.newtons == NO_FORCE_REFERENCE:
        yield (
            "sensor.calibration: the array measures in nominal newtons, as good as its stated full scale;"
            " `canprobe calibrate array CELL --force-reference scale` gives them a reference"
        )
    lacking = []
    if array.calibration.force is UNSTATED:
        lacking.append(
            "without section [force] creep is not corrected, and the force is taken to be known to"
            f" {100 * UNSTATED.array:g} %, {100 * UNSTATED.spread:g} % from array to array and"
            f" {100 * UNSTATED.creep_sigma:g} % a decade of creep (1σ)"
        )
    if array.calibration.noise.assumed:
        lacking.append("without slow_um and height_um the noise of contacts is taken to be that of the emulated array")
    if array.calibrated and lacking:
        yield (
            f"sensor.calibration: a file of an earlier form: {'; '.join(lacking)};"
            " `canprobe calibrate array CELL` measures what is missing"
        )
    if array.calibrated and array.calibration.of_make:
        its, name = array.calibration.serial_number, array.serial if array.raw is None else array.raw.serial
        of = its if isinstance(its, str) else f"{its:#x}"
        this, same, usable = "has no name", "", ""
        if name is not None:
            this = f"is {name:#x} (1018h:04)" if isinstance(name, int) else f"is {name}"
        if array.raw is not None:
            same = f'; or, if it is that one: sensor.serial_number = "{its}"'
        if (touch := setup.touch) is not None:
            from canprobe.cell.planning.contact import highest_known_force  # only where something is touched

            limit = setup.limits.force_max
            highest = highest_known_force(array, touch.probe, limit, (0.0, touch.duration_s))
            usable = f", so that {at_most(highest)} N may be at limits.force_max_n = {limit:g}"
        yield (
            f"sensor.calibration: of the array {of}, and this one {this}: its forces are known to"
            f" {100 * MAKE_SPREAD:g} % (1σ){usable}, and curvature is less certain, as of any array of the make;"
            f" type: canprobe calibrate array CELL{same}"
        )


def warnings(setup: Setup, pdos: Sequence[PlannedPdo]) -> Iterator[str]:
    """Warnings that a user must know before trusting the plan, most important first."""
    bus = setup.bus
    yield from _open_to_others(setup)
    if setup.arm is not None:
        yield from setup.arm.warnings
    if setup.truth.object is not None:
        from canprobe.mechanics.touch.mesh_fit import MeshHeights

        if isinstance(setup.truth.object, MeshHeights):
            yield from mesh_warnings(setup.truth.object.fit)
    real = any(not drive.emulated for drive in setup.drives)
    if real and setup.arm is not None and (missed := setup.arm.missed_syncs) > MISSED_SYNCS_REAL:
        yield (
            f"arm.missed_syncs = {missed}: real drives stay enabled for {1e3 * missed / setup.rate_hz:g} ms after the"
            " last SYNC of a master that stalls or dies, and a drive that falls silent is waited for as long: an object"
            f" that moves is pressed without supervision until then; leave it at {MISSED_SYNCS_REAL} or below, more is"
            " for emulated nodes"
        )
    if setup.array is not None:
        yield from _calibration_warnings(setup.array, setup)
    if setup.touch is not None:
        yield from _beyond_what_is_known(setup.touch)
    if (cut := cut_patch(setup)) is not None:
        yield cut[0]
    if setup.arm is not None and setup.touch is not None:
        yield from _held_rows(setup.arm)
    if bus.bit_error_rate > 0 and pdos:
        longest = max(pdo.bits_worst for pdo in pdos)
        lost = 1.0 - (1.0 - bus.bit_error_rate) ** longest
        each_us = (WORST_ERROR_BITS + longest) * 1e6 / bus.bitrate
        yield (
            f"bus.bit_error_rate = {bus.bit_error_rate:g}: response times hold for a wire without errors; each error "
            f"adds up to {each_us:.0f} µs, and up to {100 * lost:.2g} % of the frames have one"
        )


def _beyond_what_is_known(task: Touch | Calibrate) -> Iterator[str]:
    """Warnings of a force that the calibration has not seen, and of a speed beyond those that settings rest on."""
    from canprobe.mechanics.touch.image.force_errors import BEYOND_SIGMA
    from canprobe.mechanics.touch.online.beyond import FASTEST_M_S, beyond_factor

    errors = task.array.calibration.force
    if more := errors.beyond(task.force):
        yield (
            f"task.force_n = {task.force:g}: the calibration of the array has forces up to {errors.highest:g} N; beyond"
            f" them the force errs by {100 * BEYOND_SIGMA * more:.1f} % more (1σ), and regions are wider"
        )
    if isinstance(task, Touch) and task.shape and task.scan and (wider := beyond_factor(0.0, task.scan.speed)) > 1.0:
        yield (
            f"task.speed_mm_s = {1e3 * task.scan.speed:g}: what curvature is known to was found up to"
            f" {1e3 * FASTEST_M_S:g} mm/s; regions are {wider:.2f} times as wide"
        )


def _held_rows(arm: Arm) -> Iterator[str]:
    """The part of the probe's pose that an arm of less than six joints leaves open."""
    from canprobe.mechanics.robot.inverse import FIXED_POLE, FULL_POSE, rolls_last, task_rows

    rows = task_rows(arm.model)
    if rows >= FULL_POSE:
        return
    name = f"the {arm.model.name} arm of {arm.model.n} joints"
    if rows == FIXED_POLE:
        rolls = arm.model.n > FIXED_POLE and rolls_last(arm.model)
        last = f"; joint {arm.model.n} only turns the probe about its pole, and stays where it starts"
        yield (
            f"{name} holds the place of the probe, not its tilt: task.rolling_share is 1, and the contact wanders "
            f"on the array{last * rolls}"
        )
    else:
        yield f"{name} holds position and pole of the probe and leaves the turn about the pole free"
