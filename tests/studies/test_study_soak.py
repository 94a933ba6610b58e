"""The arithmetic of study `soak`; the study itself runs on vcan0 only."""

from __future__ import annotations

import mmap
import os
from dataclasses import replace

import pytest

from canprobe.studies.soak import Sample, findings, resident_mib

ZERO = Sample(0.0, 90.0, 80.0, 0, 0, 0, 0, 400.0, 0, 0)


def hour(leak_mib_h=0.0, drift_us=0.0, lost=0):
    return [
        replace(
            ZERO,
            t_s=60.0 * k,
            master_mib=90.0 + leak_mib_h * k / 60,
            cycles=24_000 * k,
            latency_us=400.0 + drift_us * k / 60,
            frames_counted=1000 * k,
            frames_on_bus=1000 * k + (lost if k == 60 else 0),
        )
        for k in range(61)
    ]


def test_a_sound_hour_shows_nothing():
    memory, latency, frames, cycles = findings(hour())
    assert "master grew by +0.00 MiB/h" in memory
    assert "400 µs in the first tenth, 400 µs in the last" in latency
    assert "60000 frames counted by the master, 60000 by the interface" in frames and "+0 under way" in frames
    assert cycles.startswith("1440000 cycles, 0 overruns")


def test_a_leak_a_drift_and_a_loss_are_told():
    memory, latency, frames, _ = findings(hour(leak_mib_h=3.0, drift_us=120.0, lost=7))
    assert "master grew by +3.00 MiB/h" in memory
    assert "405 µs in the first tenth, 515 µs in the last" in latency
    assert "+7 under way or lost" in frames


def test_resident_memory_is_that_of_the_process():
    before = resident_mib(os.getpid())
    with mmap.mmap(-1, 32 << 20) as ballast:  # pages of its own: what the allocator keeps or gives back has no say
        for page in range(0, len(ballast), mmap.PAGESIZE):
            ballast[page] = 1
        assert resident_mib(os.getpid()) - before == pytest.approx(32, abs=8)
    assert resident_mib(os.getpid()) - before == pytest.approx(0, abs=8)
