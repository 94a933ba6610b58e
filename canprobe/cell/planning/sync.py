"""The cycle in CANopen's objects: SYNC, the SYNCs of one tactile frame, and its period as each drive takes it.

Cyclic synchronous position is taken where the drive has it, else interpolated position, else profile position, in which
a drive goes to each target on a ramp of its own and needs no period. The others take the period of their targets by
60C2h (interpolation time period), value · 10^index s, or else by 1006h (period of SYNC). Devices take whole
milliseconds only, or anything down to microseconds. The default index of the device comes first, as it is the one that
surely works; then the others from milliseconds down.
Source: CiA 402-2, objects 6060h, 60C1h, 60C2h, 6502h; CiA 301, object 1006h.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.planning.model import SYNC_OVERFLOW, SyncPlan
from canprobe.cell.planning.node_configuration import Interpolation
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.eds.description import DescribedEntry
from canprobe.fieldbus.eds.packaged import MISSED_SYNCS, sync_patience
from canprobe.fieldbus.protocol.cia402 import INTERPOLATION_TIME, OperationMode

Place = tuple[int, int]

TARGETS: Mapping[OperationMode, Place] = {
    OperationMode.CYCLIC_SYNC_POSITION: (0x607A, 0),
    OperationMode.INTERPOLATED_POSITION: (0x60C1, 1),
    OperationMode.PROFILE_POSITION: (0x607A, 0),
}
"""Modes in which the cell can drive, the best first, with the object of their target."""
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
MAX_TIME_UNITS, _MAX_PERIOD_US = 0xFFFF, 0xFFFF_FFFF


def choose_mode(device: DeviceCapabilities) -> OperationMode | None:
    """The best mode in which the cell can command a device; None where there is none.

    Where 6502h does not list the modes, the objects decide; bring-up confirms the mode in 6061h.
    """
    listed = device.description.modes
    for mode, target in TARGETS.items():
        if (listed is None or mode in listed) and device.has(*target):
            return mode
    return None


def is_profiled(device: DeviceCapabilities) -> bool:
    """Whether a drive goes by profile position."""
    return choose_mode(device) is OperationMode.PROFILE_POSITION


def operation_problems(device: DeviceCapabilities, setup: Setup) -> list[str]:
    """Why a device cannot be driven in the cycle, whatever the rate."""
    problems = []
    needed = f"needed: {_mode_text(8)}, or {_mode_text(7)}"
    if choose_mode(device) is None:
        problems.append(f"{device.eds}: {_modes_offered(device)}; {needed}, or {_mode_text(1)} for motions by hand")
    elif is_profiled(device):
        slow = f'in profile position it lags on ramps of its own, too slow for task.kind = "{setup.kind}"'
        by_hand = "`canprobe console CELL`, `move CELL` and `home CELL` go by profile position"
        return [f"{device.eds}: {_modes_offered(device)}; {slow}; {needed}; {by_hand}"] if setup.touch else []
    if not device.has(INTERPOLATION_TIME, 1) and not device.has(SYNC_PERIOD):
        missing = "objects 60C2h (interpolation time period) and 1006h (period of SYNC) are missing"
        problems.append(f"{device.eds}: {missing}; the drive needs one of them to know the period of its targets")
    return problems


def follows_sync_period(device: DeviceCapabilities) -> bool:
    """Whether a drive knows the period of its targets only by 1006h."""
    return not is_profiled(device) and not device.has(INTERPOLATION_TIME, 1) and device.has(SYNC_PERIOD)


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
    wanted = {target for mode, target in TARGETS.items() if listed is None or mode in listed}
    if lacking := [f"{index:04X}h:{sub:02X}" for index, sub in sorted(wanted) if not device.has(index, sub)]:
        return f"object {' or '.join(lacking)} (target position) is missing"
    return f"its modes (6502h) are {', '.join(map(_mode_text, sorted(listed or ()))) or 'none'}"


def _mode_text(mode: int) -> str:
    return f"{_MODE_NAMES[mode]} ({mode})" if mode in _MODE_NAMES else f"mode {mode}"


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
    """Periods that a device takes: value · 10^index s.

    Attributes:
        values: values of 60C2h:01; of a device that has none those of 1006h.
        indices: values of 60C2h:02, the default first; -6 for 1006h.
        text: the same in words.
    """

    values: range
    indices: tuple[int, ...]
    text: str

    def expressions(self, period_us: int) -> tuple[Interpolation, ...]:
        """A period as the device may be given it, the first choice first; empty where it cannot."""
        quotients = [(index, *divmod(period_us, 10 ** (index - FINEST))) for index in self.indices]
        return tuple(Interpolation(n, index) for index, n, rest in quotients if not rest and n in self.values)


def _offer(device: DeviceCapabilities) -> _Offer:
    if follows_sync_period(device):
        period = device.description.entry(SYNC_PERIOD)
        assert period is not None
        values = _values(period, _MAX_PERIOD_US)
        text = f"1006h takes {period.low or 1} to {values.stop - 1} µs"
        if not period.writable:
            stated = "without a value" if period.initial is None else f"{period.initial!r} µs"
            text = f"1006h is {period.access}, {stated}"
        return _Offer(values, (FINEST,), text)
    value, index = (device.description.entry(INTERPOLATION_TIME, sub) for sub in (1, 2))
    default = index.initial if index is not None and isinstance(index.initial, int) else TIME_INDICES[0]
    able = [default]
    if index is not None and index.writable:
        able = [number for number in dict.fromkeys((default, *TIME_INDICES)) if index.allows(number)]
    values, indices = _values(value, MAX_TIME_UNITS), tuple(number for number in able if FINEST <= number <= COARSEST)
    span = f"{values[0]} to {values[-1]}" if len(values) > 1 else "".join(map(str, values))
    text = f"60C2h takes {span} · 10^{' or '.join(map(str, sorted(indices)))} s"
    if not values:
        text = "60C2h:01 takes no value by the EDS: no integer, read-only without a default, or limits that leave none"
    elif not indices:
        text = f"60C2h:02 takes no unit of 10^{FINEST} to 10^{COARSEST} s by the EDS"
    return _Offer(values, indices, text)


def _values(entry: DescribedEntry | None, most: int) -> range:
    """The values from 1 to `most` that an entry takes."""
    if entry is None:
        return range(0)
    if not entry.writable:
        return range(entry.initial, entry.initial + 1) if isinstance(entry.initial, int) else range(0)
    most = min(most, (1 << entry.bits) - 1)
    low, high = 1 if entry.low is None else int(entry.low), most if entry.high is None else int(entry.high)
    return range(max(1, low), min(most, high) + 1)


def interpolations(device: DeviceCapabilities, period_us: int) -> tuple[Interpolation, ...]:
    """A period as the 60C2h of a device may express it, the first choice first; empty where it needs none."""
    return () if is_profiled(device) or follows_sync_period(device) else _offer(device).expressions(period_us)


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
    offers = {device.eds: _offer(device) for device in devices}
    unable = [f"{eds}: {offer.text}" for eds, offer in offers.items() if not offer.expressions(period_us)]
    if exact and not unable:
        return None, []
    why = "1006h counts µs" if not exact else "; ".join(unable)
    near = _nearest_rates(1e6 / rate_hz, list(offers.values()))
    unsuited = "" if near else "; no period suits all drives"
    what = f"cycle.rate_hz = {rate_hz:g}: a SYNC period of {1e6 / rate_hz:.6g} µs cannot be set ({why}){unsuited}"
    return what, near


def _nearest_rates(period_us: float, offers: Sequence[_Offer]) -> list[float]:
    """The rates next to a period that every device can express, Hz, ascending."""
    few = [offer for offer in offers if len(offer.values) <= MAX_TIME_UNITS]  # 1006h may have too many to try each
    if few:
        each = ({n * 10 ** (index - FINEST) for index in one.indices for n in one.values} for one in few)
        wanted = set.intersection(*each)
    else:
        ends = {end for offer in offers for end in (offer.values[0], offer.values[-1])}
        wanted = {int(period_us), int(period_us) + 1, *ends}
    common = {us for us in wanted if us > 0 and all(offer.expressions(us) for offer in offers)}
    longer, shorter = [us for us in common if us >= period_us], [us for us in common if us < period_us]
    return [1e6 / us for us in (min(longer, default=0), max(shorter, default=0)) if us]
