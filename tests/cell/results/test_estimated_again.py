"""Estimators that compute after the run: seldom enough for a long scan, scored, and after the early summary."""

from copy import deepcopy

import canprobe


def test_a_long_scan_asks_them_seldom_and_the_early_summary_has_only_the_estimator_in_the_loop(monkeypatch):
    """As a scan of minutes does it, here with at most five answers."""
    monkeypatch.setattr("canprobe.cell.results.open_cell.MOST_REPLAYED", 5)
    keys = {"shape.also": ["chen1996"], "task.clearance_mm": 0.2, "task.duration_s": 2.0, "cycle.rate_hz": 200.0}
    early = []
    result = canprobe.run(
        "sphere", keys, bus="direct", files=False, early_summary=lambda summary: early.append(deepcopy(summary))
    )
    (first,), whole = early, result.summary
    assert list(first["shape"]["methods"]) == ["recursive"]
    assert list(whole["shape"]["methods"]) == ["recursive", "chen1996"]
    assert first["shape"]["methods"]["recursive"] == whole["shape"]["methods"]["recursive"]
    assert {**first, "shape": None} == {**whole, "shape": None}
    times = [record.t_s for record in result.estimates["chen1996"]]
    assert 4 <= len(times) <= 5 and times[-1] - times[0] > 1.0
    assert result.score("chen1996")["chen1996"]["estimates"] > 10  # where it is asked for, it answers every 0.1 s
