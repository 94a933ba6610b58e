"""Arms, drives and arrays of other people, drawn by seed: what the plan accepts is brought up and moves."""

from __future__ import annotations

import pytest

pytest.importorskip("pinocchio", reason="the URDFs come with pin")

from combinations import draw, outcome_of


@pytest.mark.parametrize("seed", [seed for seed in range(1, 13) if seed != 5])  # 5 takes long
def test_accepted_means_done(tmp_path, seed):
    combination = draw(seed, tmp_path)
    outcome = outcome_of(combination.path)
    assert outcome.keeps, f"{combination.what}: {outcome}"
