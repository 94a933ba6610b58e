"""The cycle in CANopen's objects: SYNC, the SYNCs of one tactile frame, and its period as each drive takes it.

A drive takes the period of its targets by 60C2h (interpolation time period), or else by 1006h (period of SYNC).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.planning.model import SYNC_OVERFLOW, Interpolation, SyncPlan
from canprobe.cell.planning.operation import (
    COARSEST,
    FINEST,
    INTERPOLATION_TIME,
    MAX_TIME_UNITS,
    SYNC_PERIOD,
    TIME_INDICES,
    follows_sync_period,
)
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.eds.description import DescribedEntry

CYCLES_TO_EFFECT = 2
"""Cycles from a SYNC until its command begins to take effect; the lag of the drives comes on top."""
_TOLERANCE = 1e-5  # of a rate written with six digits


def plan_sync(setup: Setup) -> tuple[SyncPlan, bool]:
    """The SYNC of a scene, in whole µs, and whether it has exactly the rate of the scene.

    Source: CiA 301 object 1006h (period in µs).
    """
    period_us = max(1, round(1e6 / setup.rate_hz))
    exact = abs(period_us * setup.rate_hz / 1e6 - 1) < _TOLERANCE
    return SyncPlan(1e6 / period_us, period_us * 1000, period_us, SYNC_OVERFLOW), exact


def plan_ratio(setup: Setup) -> tuple[int, str | None, list[float]]:
    """Number of SYNCs for one tactile frame (18xxh:02), why the rate is not possible, and the possible ones, Hz.

    The possible rates are listed where the rate is not, the nearest first.
    """
    array = setup.array
    if array is None or (array.raw is not None and array.raw.sampling == "free"):
        return 1, None, []
    exact = setup.rate_hz / array.rate_hz
    ratio = max(1, round(exact))
    if abs(exact / ratio - 1) < _TOLERANCE and (SYNC_OVERFLOW % ratio == 0 or array.raw is not None):
        return ratio, None, []
    counts = [count for count in range(1, SYNC_OVERFLOW + 1) if array.raw is not None or SYNC_OVERFLOW % count == 0]
    rates = [setup.rate_hz / count for count in sorted(counts, key=lambda count: abs(count - exact))]
    what = f"sensor.rate_hz = {array.rate_hz:g}: "
    if array.raw is not None:
        return ratio, f"{what}an image every {exact:.4g} cycles cannot be asked for", rates
    what += f"a frame every {exact:.4g} SYNCs cannot be triggered; the SYNC counter runs to {SYNC_OVERFLOW}, so"
    return min(ratio, SYNC_OVERFLOW), f"{what} cycle.rate_hz must be 1, 2, 3, 4, 5, 6, 8, … times it", rates


@dataclass(frozen=True, slots=True)
class _Offer:
    """Values that 60C2h:01 of a device takes, and indices that 60C2h:02 takes, the default first."""

    values: range
    indices: tuple[int, ...]

    def __str__(self) -> str:
        if not self.values:
            return (
                "60C2h:01 takes no value by the EDS: no integer, read-only without a default, or limits that leave none"
            )
        if not self.indices:
            return f"60C2h:02 takes no unit of 10^{FINEST} to 10^{COARSEST} s by the EDS"
        values = f"{self.values[0]} to {self.values[-1]}" if len(self.values) > 1 else str(self.values[0])
        return f"60C2h takes {values} · 10^{' or '.join(map(str, sorted(self.indices)))} s"


def _offer(device: DeviceCapabilities) -> _Offer:
    value, index = (device.description.entry(INTERPOLATION_TIME, sub) for sub in (1, 2))
    default = index.initial if index is not None and isinstance(index.initial, int) else TIME_INDICES[0]
    indices = [default]
    if index is not None and index.writable:
        indices = [number for number in dict.fromkeys((default, *TIME_INDICES)) if index.allows(number)]
    return _Offer(_values(value), tuple(number for number in indices if FINEST <= number <= COARSEST))


def _values(entry: DescribedEntry | None) -> range:
    if entry is None:
        return range(0)
    if not entry.writable:
        return range(entry.initial, entry.initial + 1) if isinstance(entry.initial, int) else range(0)
    most = min(MAX_TIME_UNITS, (1 << entry.bits) - 1)
    low, high = 1 if entry.low is None else int(entry.low), most if entry.high is None else int(entry.high)
    return range(max(1, low), min(most, high) + 1)


def interpolations(device: DeviceCapabilities, period_us: int) -> tuple[Interpolation, ...]:
    """A period as the 60C2h of a device may express it, the first choice first; empty where it cannot."""
    offer, found = _offer(device), []
    for index in offer.indices:
        value, rest = divmod(period_us, 10 ** (index - FINEST))
        if not rest and value in offer.values:
            found.append(Interpolation(value, index))
    return tuple(found)


def _can_take(device: DeviceCapabilities, period_us: int) -> bool:
    """Whether a drive can be given a period, by 60C2h or else by 1006h."""
    if not follows_sync_period(device):
        return bool(interpolations(device, period_us))
    entry = device.description.entry(SYNC_PERIOD)
    assert entry is not None
    return entry.allows(period_us) if entry.writable else entry.initial == period_us


def _period_offer(device: DeviceCapabilities) -> str:
    """The periods that a drive takes, in words."""
    if not follows_sync_period(device):
        return str(_offer(device))
    entry = device.description.entry(SYNC_PERIOD)
    assert entry is not None
    if not entry.writable:
        return f"1006h is {entry.access}, {'without a value' if entry.initial is None else f'{entry.initial!r} µs'}"
    low, high = 1 if entry.low is None else entry.low, (1 << entry.bits) - 1 if entry.high is None else entry.high
    return f"1006h takes {low} to {high} µs"


def period_problem(
    rate_hz: float, period_us: int, exact: bool, devices: Iterable[DeviceCapabilities]
) -> tuple[str | None, list[float]]:
    """Why a rate cannot be set, and the nearest rates that every drive can, Hz; None and none where it can.

    Args:
        rate_hz: rate that the scene asks for.
        period_us: nearest period in whole µs.
        exact: whether that period has exactly the rate.
        devices: the drives; without any, 1006h decides.
    """
    makes = {device.eds: device for device in devices}
    unable = [device for device in makes.values() if not _can_take(device, period_us)]
    if exact and not unable:
        return None, []
    why = "1006h counts µs" if not exact else "; ".join(f"{device.eds}: {_period_offer(device)}" for device in unable)
    near = _nearest_rates(1e6 / rate_hz, list(makes.values()))
    unsuited = "" if near else "; no period suits all drives"
    what = f"cycle.rate_hz = {rate_hz:g}: a SYNC period of {1e6 / rate_hz:.6g} µs cannot be set ({why}){unsuited}"
    return what, near


def _nearest_rates(period_us: float, devices: Sequence[DeviceCapabilities]) -> list[float]:
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


def _periods(device: DeviceCapabilities) -> set[int]:
    """Every period that 60C2h of a device can express, µs."""
    offer = _offer(device)
    return {value * 10 ** (index - FINEST) for index in offer.indices for value in offer.values}
