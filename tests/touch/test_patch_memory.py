"""What the pad remembers, against the sum over all past places."""

from __future__ import annotations

import numpy as np
import pytest

from canprobe.touch.patch_memory import TIMES_S, PadMemory


def remembered(t, uv):
    """(3,) uu, uv, vv of the way back, each past place with the share of the memory that it filled, all memories."""
    total = np.zeros(3)
    back = uv - uv[-1]
    for tau in TIMES_S:
        filled = np.exp(-(t[-1] - t[1:]) / tau) - np.exp(-(t[-1] - t[:-1]) / tau)
        total += filled @ np.stack([back[1:, 0] ** 2, back[1:, 0] * back[1:, 1], back[1:, 1] ** 2], axis=1)
    return total


def test_it_is_the_sum_over_past_places():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.004, 0.05, 300))
    uv = 1e-3 * np.cumsum(rng.normal(size=(300, 2)), axis=0)
    memory = PadMemory()
    for i in range(300):
        found = memory.add(t[i], *uv[i])
        if i % 60 == 59:
            assert found == pytest.approx(remembered(t[: i + 1], uv[: i + 1]), rel=1e-9, abs=1e-18)


def test_a_patch_that_rests_leaves_nothing_and_one_that_has_moved_is_forgotten():
    memory = PadMemory()
    for i in range(200):
        assert memory.add(0.05 * i, 1e-3, -2e-3) == pytest.approx((0.0, 0.0, 0.0), abs=1e-17)
    moved = [memory.add(10.0 + 0.05 * i, 3e-3, -2e-3)[0] for i in range(4000)]
    full = 1.0 - np.exp(-10.0 / np.array(TIMES_S))
    assert moved[0] == pytest.approx(4e-6 * full.sum(), rel=0.1)
    assert np.all(np.diff(moved) < 0.0)
    assert moved[-1] < 0.005 * moved[0]


def test_a_reset_forgets():
    memory = PadMemory()
    memory.add(0.0, 0.0, 0.0)
    memory.add(1.0, 0.0, 0.0)
    memory.reset()
    assert memory.add(1.1, 5e-3, 0.0) == (0.0, 0.0, 0.0)
