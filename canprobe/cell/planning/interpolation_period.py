"""The cycle's period as object 60C2h (interpolation time period) of each drive can express it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from canprobe.cell.planning.abilities import Abilities
from canprobe.cell.planning.model import Interpolation
from canprobe.cell.planning.operation import (
    COARSEST,
    FINEST,
    INTERPOLATION_TIME,
    MAX_TIME_UNITS,
    SYNC_PERIOD,
    TIME_INDICES,
    follows_sync_period,
)
from canprobe.fieldbus.eds.description import DescribedEntry


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


def _offer(device: Abilities) -> _Offer:
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


def interpolations(device: Abilities, period_us: int) -> tuple[Interpolation, ...]:
    """A period as the 60C2h of a device may express it, the first choice first; empty where it cannot."""
    offer, found = _offer(device), []
    for index in offer.indices:
        value, rest = divmod(period_us, 10 ** (index - FINEST))
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
    rate_hz: float, period_us: int, exact: bool, devices: Iterable[Abilities]
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
    return {value * 10 ** (index - FINEST) for index in offer.indices for value in offer.values}
