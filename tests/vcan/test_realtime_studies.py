"""Study `realtime`, and its `--soak`, on a real vcan0: the masters cycle, and what is told is what was counted."""

from __future__ import annotations

import json

import pytest

from canprobe.cli import main

pytestmark = pytest.mark.vcan


@pytest.mark.slow(reason="a whole study on a real bus")
@pytest.mark.timeout(300)
def test_the_quick_study_measures_every_case(tmp_path, capsys):
    assert main(["study", "realtime", "--quick", "--json", "--out", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    rows = document["rows"]
    assert [(row["case"], row["sensor"], row["rate_hz"]) for row in rows] == [
        ("whole controller", "window", 400.0),
        ("bare clock", "none", 400.0),
        *(("hold", mode, 400.0) for mode in ("features", "window", "image")),
    ]
    assert sum(row["ended"] != "" for row in rows) <= 1  # a machine that stands still for 250 ms ends a case
    for row in rows:
        assert row["cycles"] > 50
        assert 0 < row["held_hz"] < 401
        assert 0 <= row["lateness_p50_us"] <= row["lateness_p99_us"] <= row["lateness_max_us"]
        if row["case"] in ("whole controller", "hold"):
            # answers within the period, computing time below a cycle: it did cycle with drives that answered
            assert 0 < row["latency_p50_us"] < 2500
            assert 0 < row["response_p50_us"] < row["compute_p50_us"] < 2500
    assert (tmp_path / "realtime.csv").read_text().count("\n") == 1 + len(rows)


@pytest.mark.slow(reason="a whole study on a real bus")
@pytest.mark.timeout(200)
def test_the_soak_counts_what_the_interface_counts(tmp_path, capsys):
    assert main(["study", "realtime", "--soak", "--quick", "--json", "--out", str(tmp_path)]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    first, last = rows[0], rows[-1]
    assert last["t_s"] - first["t_s"] > 9
    # what the emulated nodes have just sent may not be drained yet, at the first look and at the last: a cycle's frames
    assert abs(last["frames_on_bus"] - last["frames_counted"] + last["dropped_frames"]) <= 40
    assert last["frames_counted"] > 1000
    assert last["master_mib"] - rows[len(rows) // 2]["master_mib"] < 2
    assert last["nodes_mib"] - rows[len(rows) // 2]["nodes_mib"] < 2
