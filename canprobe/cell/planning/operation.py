"""How each drive is commanded in the cycle: its mode of operation, and the period as its 60C2h can express it.

Cyclic synchronous position is taken where the drive has it, else interpolated position. 60C2h is value · 10^index s;
devices take whole milliseconds only, or anything down to microseconds. The default index of the device comes first, as
it is the one that surely works; then the others from milliseconds down. A drive without 60C2h takes the period from
1006h, where it has that.
Source: CiA 402-2, objects 6060h, 60C1h, 60C2h, 6502h; CiA 301, object 1006h.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from canprobe.cell.planning.devices import Abilities
from canprobe.cell.planning.model import Interpolation
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.eds.description import Entry
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
_INDICES = (-3, -4, -5, -6)
_FINEST, _COARSEST = -6, 0
"""Indices between which a unit is a whole number of microseconds, and no more than a second."""
_MOST = 0xFFFF


def choose_mode(device: Abilities) -> OperationMode | None:
    """The mode in which the cell can drive a device; None where it has none.

    Where 6502h does not list the modes, the objects decide; bring-up confirms the mode in 6061h.
    """
    listed = device.description.modes
    for mode, target in TARGETS.items():
        if (listed is None or mode in listed) and device.has(*target):
            return mode
    return None


def operation_problems(device: Abilities) -> list[str]:
    """Why a device cannot be driven in the cycle, whatever the rate."""
    problems = []
    if choose_mode(device) is None:
        problems.append(f"{device.eds}: {_modes_offered(device)}; needed: {_mode_text(8)}, or {_mode_text(7)}")
    if not device.has(INTERPOLATION_TIME, 1) and not device.has(SYNC_PERIOD):
        missing = "objects 60C2h (interpolation time period) and 1006h (period of SYNC) are missing"
        problems.append(f"{device.eds}: {missing}; the drive needs one of them to know the period of its targets")
    return problems


def follows_sync_period(device: Abilities) -> bool:
    """Whether a drive knows the period of its targets only by 1006h."""
    return not device.has(INTERPOLATION_TIME, 1) and device.has(SYNC_PERIOD)


def early_stops(setup: Setup, devices: Mapping[int, Abilities]) -> Iterator[str]:
    """Drives that take their master for dead sooner than the plan says, as their EDS has it."""
    arm = setup.arm
    early: dict[tuple[str, int, int], list[int]] = {}
    for node_id in arm.node_ids if arm is not None else ():
        assert arm is not None
        device, index = devices[node_id], sync_patience(devices[node_id].od)
        entry = device.description.entry(index) if index is not None else None
        if (
            index is None
            or entry is None
            or (index == MISSED_SYNCS and entry.writable and entry.allows(arm.missed_syncs))
        ):
            continue
        if 0 < (held := device.number(index) or 0) < arm.missed_syncs:
            early.setdefault((device.eds, index, held), []).append(node_id)
    for (eds, index, held), node_ids in early.items():
        assert arm is not None
        nodes, syncs = ", ".join(map(str, node_ids)), f"{held} missed SYNC{'s' * (held > 1)}"
        yield (
            f"arm.missed_syncs = {arm.missed_syncs}: by {index:04X}h of {eds} nodes {nodes} stop by themselves after"
            f" {syncs}, before their master takes them for lost; set arm.missed_syncs = {held}, or raise {index:04X}h"
            " in the drives and in their EDS"
        )


def homing_problems(device: Abilities) -> list[str]:
    """Why a device cannot be homed, whatever the method."""
    listed = device.description.modes
    if listed is None or OperationMode.HOMING in listed:
        return []
    names = ", ".join(map(_mode_text, sorted(listed))) or "none"
    return [f"{device.eds}: its modes (6502h) are {names}; needed: {_mode_text(OperationMode.HOMING)}"]


def _modes_offered(device: Abilities) -> str:
    listed = device.description.modes
    lacking = [f"{index:04X}h:{sub:02X}" for mode, (index, sub) in TARGETS.items() if listed is None or mode in listed]
    if lacking:
        return f"object {' or '.join(lacking)} (target position) is missing"
    return f"its modes (6502h) are {', '.join(map(_mode_text, sorted(listed or ()))) or 'none'}"


def _mode_text(mode: int) -> str:
    return f"{_MODE_NAMES[mode]} ({mode})" if mode in _MODE_NAMES else f"mode {mode}"


# 60C2h.


@dataclass(frozen=True, slots=True)
class _Offer:
    """What 60C2h of a device takes: values of :01, and indices of :02, the default first."""

    values: range
    indices: tuple[int, ...]

    def __str__(self) -> str:
        if not self.values:
            return (
                "60C2h:01 takes no value by the EDS: no integer, read-only without a default, or limits that leave none"
            )
        if not self.indices:
            return f"60C2h:02 takes no unit of 10^{_FINEST} to 10^{_COARSEST} s by the EDS"
        values = f"{self.values[0]} to {self.values[-1]}" if len(self.values) > 1 else str(self.values[0])
        return f"60C2h takes {values} · 10^{' or '.join(map(str, sorted(self.indices)))} s"


def _offer(device: Abilities) -> _Offer:
    value, index = (device.description.entry(INTERPOLATION_TIME, sub) for sub in (1, 2))
    default = index.initial if index is not None and isinstance(index.initial, int) else _INDICES[0]
    indices = [default]
    if index is not None and index.writable:
        indices = [number for number in dict.fromkeys((default, *_INDICES)) if index.allows(number)]
    return _Offer(_values(value), tuple(number for number in indices if _FINEST <= number <= _COARSEST))


def _values(entry: Entry | None) -> range:
    if entry is None:
        return range(0)
    if not entry.writable:
        return range(entry.initial, entry.initial + 1) if isinstance(entry.initial, int) else range(0)
    most = min(_MOST, (1 << entry.bits) - 1)
    low, high = 1 if entry.low is None else int(entry.low), most if entry.high is None else int(entry.high)
    return range(max(1, low), min(most, high) + 1)


def interpolations(device: Abilities, period_us: int) -> tuple[Interpolation, ...]:
    """A period as the 60C2h of a device may express it, the first choice first; empty where it cannot."""
    offer, found = _offer(device), []
    for index in offer.indices:
        value, rest = divmod(period_us, 10 ** (index - _FINEST))
        if not rest and value in offer.values:
            found.append(Interpolation(value, index))
    return tuple(found)


def _can_take(device: Abilities, period_us: int) -> bool:
    """Whether a drive can be given a period, by 60C2h or else by 1006h."""
    if not follows_sync_period(device):
        return bool(interpolations(device, period_us))
    entry = device.description.entry(SYNC_PERIOD)
    assert entry is not None
    return entry.allows(period_us) if entry.writable else entry.initial == period_us


def _period_offer(device: Abilities) -> str:
    """What periods a drive takes, in words."""
    if not follows_sync_period(device):
        return str(_offer(device))
    entry = device.description.entry(SYNC_PERIOD)
    assert entry is not None
    if not entry.writable:
        return f"1006h is {entry.access}, {'without a value' if entry.initial is None else f'{entry.initial!r} µs'}"
    low, high = 1 if entry.low is None else entry.low, (1 << entry.bits) - 1 if entry.high is None else entry.high
    return f"1006h takes {low} to {high} µs"


def period_problem(rate_hz: float, period_us: int, exact: bool, devices: Iterable[Abilities]) -> str | None:
    """Why a rate cannot be set, with the nearest rates that every drive can; None where it can.

    Args:
        rate_hz: as the scene asks.
        period_us: the nearest whole one.
        exact: whether it is that rate.
        devices: the drives; without any, 1006h decides.
    """
    makes = {device.eds: device for device in devices}
    unable = [device for device in makes.values() if not _can_take(device, period_us)]
    if exact and not unable:
        return None
    why = "1006h counts µs" if not exact else "; ".join(f"{device.eds}: {_period_offer(device)}" for device in unable)
    near = _nearest_rates(1e6 / rate_hz, list(makes.values()))
    take = f"take {' or '.join(f'{rate:.6g}' for rate in near)} Hz" if near else "no period suits all drives"
    return f"cycle.rate_hz = {rate_hz:g}: a SYNC period of {1e6 / rate_hz:.6g} µs cannot be set ({why}); {take}"


def _nearest_rates(period_us: float, devices: Sequence[Abilities]) -> list[float]:
    """The rates next to a period that every device can express, Hz, ascending."""
    timed = [device for device in devices if not follows_sync_period(device)]
    if timed:
        wanted = set.intersection(*map(_periods, timed))
    else:
        limits = [device.description.entry(SYNC_PERIOD) for device in devices]
        stated = {value for entry in limits if entry is not None for value in (entry.low, entry.high, entry.initial)}
        wanted = {int(period_us), int(period_us) + 1, *(int(us) for us in stated if isinstance(us, int | float))}
    common = {us for us in wanted if us > 0 and all(_can_take(device, us) for device in devices)}
    longer, shorter = [us for us in common if us >= period_us], [us for us in common if us < period_us]
    return [1e6 / us for us in (min(longer, default=0), max(shorter, default=0)) if us]


def _periods(device: Abilities) -> set[int]:
    """Every period that 60C2h of a device can express, µs."""
    offer = _offer(device)
    return {value * 10 ** (index - _FINEST) for index in offer.indices for value in offer.values}
