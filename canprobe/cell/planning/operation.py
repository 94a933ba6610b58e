"""The mode of operation in which each drive is commanded, and the objects that hold the period of its targets.

Cyclic synchronous position is taken where the drive has it, else interpolated position. 60C2h is value · 10^index s;
devices take whole milliseconds only, or anything down to microseconds. The default index of the device comes first, as
it is the one that surely works; then the others from milliseconds down. A drive without 60C2h takes the period from
1006h, where it has that object.
Source: CiA 402-2, objects 6060h, 60C1h, 60C2h, 6502h; CiA 301, object 1006h.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.eds.packaged import MISSED_SYNCS, sync_patience
from canprobe.fieldbus.protocol.cia402 import OperationMode

Place = tuple[int, int]

TARGETS: Mapping[OperationMode, Place] = {
    OperationMode.CYCLIC_SYNC_POSITION: (0x607A, 0),
    OperationMode.INTERPOLATED_POSITION: (0x60C1, 1),
}
"""Modes in which the cell can drive, the best first, with the object of their target."""
INTERPOLATION_TIME = 0x60C2
SYNC_PERIOD = 0x1006
_MODE_NAMES: Mapping[int, str] = {
    1: "profile position",
    2: "velocity",
    3: "profile velocity",
    4: "profile torque",
    6: "homing",
    7: "interpolated position",
    8: "cyclic synchronous position",
    9: "cyclic synchronous velocity",
    10: "cyclic synchronous torque",
}
TIME_INDICES = (-3, -4, -5, -6)
FINEST, COARSEST = -6, 0
"""Indices between which a unit is a whole number of microseconds, and no more than a second."""
MAX_TIME_UNITS = 0xFFFF


def choose_mode(device: DeviceCapabilities) -> OperationMode | None:
    """The best mode in which the cell can command a device; None where there is none.

    Where 6502h does not list the modes, the objects decide; bring-up confirms the mode in 6061h.
    """
    listed = device.description.modes
    for mode, target in TARGETS.items():
        if (listed is None or mode in listed) and device.has(*target):
            return mode
    return None


def operation_problems(device: DeviceCapabilities) -> list[str]:
    """Why a device cannot be driven in the cycle, whatever the rate."""
    problems = []
    if choose_mode(device) is None:
        problems.append(f"{device.eds}: {_modes_offered(device)}; needed: {_mode_text(8)}, or {_mode_text(7)}")
    if not device.has(INTERPOLATION_TIME, 1) and not device.has(SYNC_PERIOD):
        missing = "objects 60C2h (interpolation time period) and 1006h (period of SYNC) are missing"
        problems.append(f"{device.eds}: {missing}; the drive needs one of them to know the period of its targets")
    return problems


def follows_sync_period(device: DeviceCapabilities) -> bool:
    """Whether a drive knows the period of its targets only by 1006h."""
    return not device.has(INTERPOLATION_TIME, 1) and device.has(SYNC_PERIOD)


def early_stops(setup: Setup, devices: Mapping[int, DeviceCapabilities]) -> Iterator[str]:
    """Warnings for drives that by their EDS stop after fewer missed SYNCs than the scene says."""
    if (arm := setup.arm) is None:
        return
    early: dict[tuple[str, int, int], list[int]] = {}
    for node_id in arm.node_ids:
        device, index = devices[node_id], sync_patience(devices[node_id].od)
        if index is None or (entry := device.description.entry(index)) is None:
            continue
        if index == MISSED_SYNCS and entry.writable and entry.allows(arm.missed_syncs):
            continue
        if 0 < (held := device.number(index) or 0) < arm.missed_syncs:
            early.setdefault((device.eds, index, held), []).append(node_id)
    for (eds, index, held), node_ids in early.items():
        nodes, syncs = ", ".join(map(str, node_ids)), f"{held} missed SYNC{'s' * (held > 1)}"
        yield (
            f"arm.missed_syncs = {arm.missed_syncs}: by {index:04X}h of {eds} nodes {nodes} stop by themselves after"
            f" {syncs}, before their master takes them for lost; set arm.missed_syncs = {held}, or raise {index:04X}h"
            " in the drives and in their EDS"
        )


def homing_problems(device: DeviceCapabilities) -> list[str]:
    """Why a device cannot be homed, whatever the method."""
    listed = device.description.modes
    if listed is None or OperationMode.HOMING in listed:
        return []
    names = ", ".join(map(_mode_text, sorted(listed))) or "none"
    return [f"{device.eds}: its modes (6502h) are {names}; needed: {_mode_text(OperationMode.HOMING)}"]


def _modes_offered(device: DeviceCapabilities) -> str:
    listed = device.description.modes
    lacking = [f"{index:04X}h:{sub:02X}" for mode, (index, sub) in TARGETS.items() if listed is None or mode in listed]
    if lacking:
        return f"object {' or '.join(lacking)} (target position) is missing"
    return f"its modes (6502h) are {', '.join(map(_mode_text, sorted(listed or ()))) or 'none'}"


def _mode_text(mode: int) -> str:
    return f"{_MODE_NAMES[mode]} ({mode})" if mode in _MODE_NAMES else f"mode {mode}"
