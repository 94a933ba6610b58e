"""Arms, drives and arrays of other people, drawn by seed: what the plan accepts is brought up and moves."""

from __future__ import annotations

import pytest

pytest.importorskip("pinocchio", reason="the URDFs come with pin")

from combinations import draw, outcome_of

LONG = pytest.mark.slow(reason="its plan and its scan take three seconds; the other nineteen take two")
SEEDS = [pytest.param(seed, marks=[LONG] * (seed == 5)) for seed in range(1, 21)]


@pytest.mark.parametrize("seed", SEEDS)
def test_accepted_means_done(tmp_path, seed):
    combination = draw(seed, tmp_path)
    outcome = outcome_of(combination.path)
    assert outcome.keeps, f"{combination.what}: {outcome}"
