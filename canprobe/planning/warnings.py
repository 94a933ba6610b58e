"""What a plan carries out and yet tells its user first: where the numbers in it do not hold."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.planning.cut_patch import TOLERATED, cut_patch
from canprobe.planning.model import PlannedPdo
from canprobe.protocol.frame_bits import WORST_ERROR_BITS
from canprobe.scene_setup import Bus, Setup


def plan_warnings(setup: Setup, pdos: Sequence[PlannedPdo]) -> tuple[str, ...]:
    """Everything that a user has to know before he trusts the plan, most important first."""
    return (*_window(setup), *_errors(setup.bus, pdos))


def _window(setup: Setup) -> list[str]:
    cut = cut_patch(setup)
    return (
        [] if cut is None else [f"{cut.text}; {' or '.join(cut.ways)} leaves less than {100 * TOLERATED:.0f} % outside"]
    )


def _errors(bus: Bus, pdos: Sequence[PlannedPdo]) -> list[str]:
    if bus.bit_error_rate <= 0 or not pdos:
        return []
    longest = max(pdo.bits_worst for pdo in pdos)
    lost = 1.0 - (1.0 - bus.bit_error_rate) ** longest
    each_us = (WORST_ERROR_BITS + longest) * 1e6 / bus.bitrate
    return [
        f"bus.bit_error_rate = {bus.bit_error_rate:g}: response times hold for a wire without errors; each error adds "
        f"up to {each_us:.0f} µs, and up to {100 * lost:.2g} % of the frames have one"
    ]
