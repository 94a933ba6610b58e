"""Study `realtime --link`: its set-ups follow from seeds, a hold shows what is true, and the words of both tables."""

import pytest

from canprobe.lab.studies.link_setups import KINDS, MACHINES, draw_machine, draw_setup
from canprobe.lab.studies.realtime_link import RATES_HZ, findings, measure_machine, rate_findings


def test_set_ups_and_machines_follow_from_their_seed():
    assert [draw_setup(seed) for seed in range(9)] == [draw_setup(seed) for seed in range(9)]
    assert {draw_setup(seed).kind for seed in range(200)} == set(KINDS)
    assert [draw_machine(seed).kind for seed in range(3)] == list(MACHINES)


def row(**changes):
    sound = {"kind": "delay", "verdict": "fit", "truth": "fit", "cause": None, "overruns_percent": 0.0, "ended": ""}
    return sound | {"true_overruns_percent": 0.0} | changes


def test_findings_count_what_is_judged_right_and_what_is_dangerous():
    rows = [
        row(),
        row(truth="unfit", ended="node 1: lost"),
        row(verdict="unfit", truth="unfit", cause="delay", overruns_percent=6.0, true_overruns_percent=4.0),
    ]
    right, dangerous, named, ratios = findings(rows)
    assert right.startswith("2 of 3") and dangerous.startswith("1 set-ups") and "1 of 1" in named
    assert "× 1.50 to × 1.50, 1 set-ups" in ratios


def test_predictions_count_from_enough_late_syncs_on():
    sound = {"kind": "machine", "late": 30.0, "predicted_percent": 1.0, "seen_percent": 1.2, "ratio": 0.83}
    (said,) = rate_findings([sound, sound | {"ratio": 3.0, "late": 3.0}, sound | {"ratio": None}])
    assert "1 of 1 within x 1.5" in said
    assert rate_findings([sound | {"ratio": None}]) == ["no machine had late SYNCs"]


@pytest.mark.slow(reason="whole cells at five rates")
def test_a_machine_has_overruns_where_a_check_foresees_them():
    rows = measure_machine((3600, 1.0))
    assert [found["rate_hz"] for found in rows] == list(RATES_HZ)
    assert rows[0]["seen_percent"] <= rows[-1]["seen_percent"]
    assert rows[-1]["predicted_percent"] > 0.5 and rows[-1]["seen_percent"] > 0.5
