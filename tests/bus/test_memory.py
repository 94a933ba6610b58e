"""Memory taken before it is needed."""

from __future__ import annotations

import pytest

import canprobe
from canprobe.bus.memory import LARGEST_RESERVE, LEAST_RESERVE, reserve_memory
from canprobe.scene_loader import load_scene


def held(cycles):
    """Bytes for small objects that are taken, from what holds them."""
    kept = reserve_memory(cycles)
    assert all(len(block) == 480 for block in kept)
    return len(kept) * (256 << 10)


@pytest.mark.parametrize(
    "cycles, size", [(0, LEAST_RESERVE), (1024, LEAST_RESERVE + (4 << 20)), (10**9, LARGEST_RESERVE)]
)
def test_as_much_as_the_cycles_will_keep(cycles, size):
    assert held(cycles) == pytest.approx(size / 2, rel=0.05)


def test_a_plan_knows_about_how_many_cycles_it_takes():
    assert canprobe.plan(load_scene("cylinder")).cycles == 23 * 400
