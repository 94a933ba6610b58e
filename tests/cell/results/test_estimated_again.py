"""Estimators that compute after the run: seldom enough for a long scan, scored, and after the early summary."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest

import canprobe


@pytest.mark.slow(reason="a long scan")
def test_a_long_scan_asks_them_forty_times_and_the_early_summary_has_only_the_estimator_in_the_loop() -> None:
    early: list[Any] = []
    result = canprobe.run(
        "sphere",
        {"shape.method": "recursive", "shape.also": ["chen1996"]},
        bus="direct",
        duration_s=8.0,
        files=False,
        early_summary=lambda summary: early.append(deepcopy(summary)),
    )
    (first,), whole = early, result.summary
    assert list(first["shape"]["methods"]) == ["recursive"] and list(whole["shape"]["methods"]) == [
        "recursive",
        "chen1996",
    ]
    assert first["shape"]["methods"]["recursive"] == whole["shape"]["methods"]["recursive"]
    assert {**first, "shape": None} == {**whole, "shape": None}
    times = [record.t_s for record in result.estimates["chen1996"]]
    assert 35 <= len(times) <= 40 and times[-1] - times[0] > 7.0
    dense = result.score("chen1996")["chen1996"]
    assert dense["estimates"] > 60  # where it is asked for, it answers every 0.1 s
    sparse = whole["shape"]["methods"]["chen1996"]
    assert abs(sparse["kappa_rms_error_per_m"] / dense["kappa_rms_error_per_m"] - 1.0) < 0.2
