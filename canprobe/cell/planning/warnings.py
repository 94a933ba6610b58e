"""Warnings of a plan that fits: who else can command the cell, and where the plan's numbers do not hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from canprobe.cell.planning.array import TOLERATED_LOSS_SHARE, cut_patch
from canprobe.cell.planning.model import PlannedPdo
from canprobe.cell.scene.setup import Arm, Array, Setup
from canprobe.cell.scene.surface_files import mesh_warnings
from canprobe.fieldbus.bus.real.adapters import bus_open_to_others
from canprobe.fieldbus.protocol.frame_bits import WORST_ERROR_BITS
from canprobe.mechanics.robot.inverse import FIXED_POLE, FULL_POSE, rolls_last, task_rows
from canprobe.mechanics.touch.image.calibration import NO_FORCE_REFERENCE
from canprobe.mechanics.touch.image.force_errors import UNSTATED
from canprobe.mechanics.touch.mesh_fit import MeshHeights

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


def _unstated(array: Array) -> list[str]:
    """What the calibration of an array does not state, and what is taken for it."""
    lacking = []
    if array.calibration.force is UNSTATED:
        lacking.append(
            "without section [force] creep is not corrected, and the force is taken to be known to"
            f" {100 * UNSTATED.array:g} %, {100 * UNSTATED.spread:g} % from array to array and"
            f" {100 * UNSTATED.creep_sigma:g} % a decade of creep (1σ)"
        )
    if array.calibration.noise.assumed:
        lacking.append("without slow_um and height_um the noise of contacts is taken to be that of the emulated array")
    return lacking


def warnings(setup: Setup, pdos: Sequence[PlannedPdo]) -> Iterator[str]:
    """Warnings that a user must know before trusting the plan, most important first."""
    cut, bus = cut_patch(setup), setup.bus
    yield from _open_to_others(setup)
    if setup.arm is not None:
        yield from setup.arm.warnings
    if isinstance(setup.truth.object, MeshHeights):
        yield from mesh_warnings(setup.truth.object.fit)
    if setup.arm is not None and not all(drive.emulated for drive in setup.arm.drives):
        yield from _long_waits(setup.arm.missed_syncs, setup.rate_hz)
    if setup.array is not None and setup.array.newtons == NO_FORCE_REFERENCE:
        yield (
            "sensor.calibration: the array measures in nominal newtons, as good as its stated full scale;"
            " `canprobe calibrate array CELL --force-reference scale` gives them a reference"
        )
    if setup.array is not None and setup.array.calibrated and (lacking := _unstated(setup.array)):
        yield (
            f"sensor.calibration: a file of an earlier form: {'; '.join(lacking)};"
            " `canprobe calibrate array CELL` measures what is missing"
        )
    if cut is not None:
        yield f"{cut.text}; {' or '.join(cut.ways)} leaves less than {100 * TOLERATED_LOSS_SHARE:.0f} % outside"
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


def _long_waits(missed_syncs: int, rate_hz: float) -> Iterator[str]:
    """Warning for real drives that wait long for a SYNC."""
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
        rolls = arm.model.n > FIXED_POLE and rolls_last(arm.model)
        last = f"; joint {arm.model.n} only turns the probe about its pole, and stays where it starts"
        return (
            f"{name} holds the place of the probe, not its tilt: task.rolling_share is 1, and the contact wanders "
            f"on the array{last * rolls}"
        )
    return f"{name} holds position and pole of the probe and leaves the turn about the pole free"
