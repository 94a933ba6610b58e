"""The arithmetic of study `realtime`; the study itself runs on vcan0 only."""

import mmap
import os

import numpy as np
import pytest

from canprobe.lab.studies.realtime import Measured, findings, holding_scene
from canprobe.lab.studies.realtime_soak import findings as findings_of_soak
from canprobe.lab.studies.realtime_soak import resident_mib


def measured(case, sensor, rate_hz, cycles, overruns, *, seconds=10.0, response_us=(), compute_us=(), ended=""):
    late = np.where(np.arange(cycles) < overruns, 2_000_000, 0)
    response, compute = (1000 * np.array(us, np.int64) for us in (response_us, compute_us))
    return Measured(case, sensor, rate_hz, late, seconds, response, compute, ended=ended)


def test_findings_tell_rates_and_shares():
    cases = [
        measured("whole controller", "window", 400.0, 4001, 2, response_us=[500], compute_us=[750]),
        measured("bare clock", "none", 400.0, 4000, 1),
        measured("hold", "features", 400.0, 4001, 0),
        measured("hold", "features", 500.0, 4001, 40),
        measured("hold", "image", 400.0, 401, 0, seconds=1.0, ended="node 1: lost"),
    ]
    text = "\n".join(findings(cases))
    assert "whole controller at 400 Hz for 10 s: 5.0 overruns in 10 000 cycles (goal 1), 400.0 cycles" in text
    assert "does nothing: 2.5 overruns in 10 000 cycles" in text
    assert "p99 is 20 % of the period until the commands are out, 30 % with" in text
    assert "features: 400 Hz held without overruns of 400, 500 Hz" in text
    assert "image: no rate held" in text


def test_the_studies_scenes_leave_every_node_to_a_process_of_its_own():
    scene = holding_scene("features", 800.0)
    assert scene.emulated_node_ids == ()
    assert (scene.arm.missed_syncs, scene.limits.late_cycles_max_percent) == (250, 100), "measured, never ended"
    assert (scene.cycle.rate_hz, scene.sensor.rate_hz, scene.sensor.mode) == (800.0, 400.0, "features")


def test_a_cycle_is_an_overrun_from_half_a_period_on():
    loop = Measured("", "", 1e6, np.array([0, 100, 2600, 0]), 5e-6)
    assert (loop.overruns, loop.cycles, loop.missed) == (1, 4, 0)


# The arithmetic of `realtime --soak`; it runs on vcan0 only.

ZERO = dict.fromkeys(("overruns", "missed_pdos", "dropped_frames"), 0)
ZERO |= {"master_mib": 90.0, "nodes_mib": 80.0, "monitor_mib": 85.0}


def hour(leak_mib_h=0.0, drift_us=0.0, lost=0):
    return [
        ZERO
        | {
            "t_s": 60.0 * k,
            "master_mib": 90.0 + leak_mib_h * k / 60,
            "cycles": 24_000 * k,
            "latency_us": 400.0 + drift_us * k / 60,
            "frames_counted": 1000 * k,
            "frames_on_bus": 1000 * k + (lost if k == 60 else 0),
        }
        for k in range(61)
    ]


def test_a_sound_hour_shows_nothing():
    memory, latency, frames, cycles = findings_of_soak(hour())
    assert "master grew by +0.00 MiB/h" in memory
    assert "400 µs in the first tenth, 400 µs in the last" in latency
    assert "60000 frames counted by the master, 60000 by the interface" in frames and "+0 under way" in frames
    assert cycles.startswith("1440000 cycles, 0 overruns")


def test_a_leak_a_drift_and_a_loss_are_told():
    memory, latency, frames, _ = findings_of_soak(hour(leak_mib_h=3.0, drift_us=120.0, lost=7))
    assert "master grew by +3.00 MiB/h" in memory
    assert "405 µs in the first tenth, 515 µs in the last" in latency
    assert "+7 under way or lost" in frames


def test_a_cell_that_stops_early_leaves_its_samples_and_the_reason():
    first, memory, *_ = findings_of_soak(hour()[:11], "node 1: lost")
    assert first == "the cell stopped after 600 s: node 1: lost"
    assert "master grew by +0.00 MiB/h" in memory


def test_resident_memory_is_that_of_the_process():
    before = resident_mib(os.getpid())
    with mmap.mmap(-1, 32 << 20) as ballast:  # pages of its own: what the allocator keeps or gives back has no say
        for page in range(0, len(ballast), mmap.PAGESIZE):
            ballast[page] = 1
        assert resident_mib(os.getpid()) - before == pytest.approx(32, abs=8)
    assert resident_mib(os.getpid()) - before == pytest.approx(0, abs=8)
