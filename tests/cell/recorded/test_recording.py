"""Logs that cannot be replayed: each is told with what is wrong and where."""

from __future__ import annotations

import numpy as np
import pytest
from candump_lines import can_id_of, restamped, stamp_us

import canprobe
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock_steps import RecordedBus


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [x for x in lines if can_id_of(x) != "080"], "on can0 0 SYNC"),
        (lambda lines: [], "no frame at all; node 1 "),
        (
            lambda lines: [x[:-4] if can_id_of(x) == "182" else x for x in lines],
            r"node 2 .*\(\d+ PDOs of a wrong length\)",
        ),
        (
            lambda lines: [x[:-2] + "00" * 8 if can_id_of(x) == "080" else x for x in lines],
            r"0 SYNC \(080h\) of 0 or 1 byte, but \d+ frames 080h of 8 bytes",
        ),
        (lambda lines: [restamped(x, 2 * stamp_us(x)) for x in lines], "a SYNC every 5.000 ms, but .* every 2.500 ms"),
        (lambda lines: [line for line in lines for _ in range(2)], r"on can0 \d+ of \d+ SYNCs .*logged twice\?"),
        (lambda lines: lines[: len(lines) // 4], "nothing was touched"),
        (
            lambda lines: [x.replace("183#37", "183#FF") for x in lines],
            r"bus\.log: on can0: node 3: statusword 0x..ff is no CiA 402 state",
        ),
    ],
    ids=["no sync", "empty", "other mapping", "long sync", "other rate", "doubled", "no contact", "no state"],
)
def test_a_log_that_cannot_be_replayed(lockstep_run, copy_of, change, message):
    with pytest.raises(UsageError, match=message):
        canprobe.replay(copy_of(lockstep_run.out, change))


def stepped(lines, *steps_us):
    """Lines whose clock is set by so many µs at the middle, at three quarters, …"""
    for number, line in enumerate(lines):
        parts = (2 * number >= len(lines), 4 * number >= 3 * len(lines))
        yield restamped(line, 10**15 + stamp_us(line) + sum(a * b for a, b in zip(steps_us, parts, strict=False)))


@pytest.fixture(scope="module")
def undisturbed(lockstep_run, replayed_log):
    """The replay and the traffic of the log as it is."""
    return replayed_log, canprobe.measure_traffic(lockstep_run.out / "bus.log", lockstep_run.plan, exact=False)


def test_a_clock_that_was_set_changes_no_estimate_and_no_load(lockstep_run, undisturbed, tmp_path):
    log, (expected, before), steps_us = tmp_path / "stepped.log", undisturbed, (-2_000_000, -7_000_000)
    lines = (lockstep_run.out / "bus.log").read_text().splitlines()
    log.write_text("\n".join(stepped(lines, *steps_us)) + "\n")
    bus = RecordedBus(log)
    first = next(n for n, line in enumerate(lines) if 2 * n >= len(lines)) + 1
    assert bus.steps[0].line == first and len(bus.steps) == len(steps_us)
    for step, us in zip(bus.steps, steps_us, strict=True):
        assert abs(step.step_ns / 1000 - us) < 2500  # to the SYNC period
    found = canprobe.replay(log, scene=lockstep_run.plan.scene)
    np.testing.assert_allclose(
        found.estimates["recursive"][-1].estimate.kappa, expected.estimates["recursive"][-1].estimate.kappa, rtol=1e-9
    )
    assert found.summary["cycle"] == expected.summary["cycle"]
    assert f"log        line {first}: the stamps of can0 step " in found.text()
    measured = canprobe.measure_traffic(log, lockstep_run.plan, exact=False)
    assert measured.load == pytest.approx(before.load, rel=1e-3)
    assert measured.as_planned and f"line {first}: the stamps of can0 step" in measured.text()


def test_a_clock_that_was_set_back_before_the_first_sync_changes_no_estimate(lockstep_run, undisturbed, tmp_path):
    log, step_us = tmp_path / "stepped.log", -5_000_000
    lines = (lockstep_run.out / "bus.log").read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if can_id_of(line) == "080") // 2
    log.write_text(
        "".join(f"{restamped(x, 10**15 + stamp_us(x) + step_us * (n >= at))}\n" for n, x in enumerate(lines))
    )
    bus = RecordedBus(log)
    (step,) = bus.steps
    assert step.line == at + 1 and step.step_ns == pytest.approx(step_us * 1000, abs=5e6)
    stamps = [line[0] for line in bus]
    assert stamps == sorted(stamps)
    found, (expected, _) = canprobe.replay(log, scene=lockstep_run.plan.scene), undisturbed
    assert found.summary["cycle"] == expected.summary["cycle"]
    assert f"log        line {at + 1}: the stamps of can0 step back" in found.text()


def test_one_stray_stamp_before_the_first_sync_is_no_step_of_the_clock(lockstep_run, tmp_path):
    log = tmp_path / "stray.log"
    lines = (lockstep_run.out / "bus.log").read_text().splitlines()
    lines[5] = restamped(lines[5], stamp_us(lines[5]) + 3_600_000_000)
    log.write_text("\n".join(lines) + "\n")
    assert RecordedBus(log).steps == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda us, n, before: us - 5_000_000 * (5000 <= n < 5020), r"log:50\d\d: the SYNC of can0 is .* to and fro"),
        (lambda us, n, before: us - before, "differences from line to line, no times"),
        (lambda us, n, before: 0, "all the same, as of candump without -t"),
    ],
    ids=["back and forth", "delta", "none"],
)
def test_stamps_that_cannot_be_mended_are_refused(lockstep_run, tmp_path, change, message):
    log = tmp_path / "odd.log"
    lines = (lockstep_run.out / "bus.log").read_text().splitlines()
    stamps = [100_000_000 + stamp_us(line) for line in lines]
    before = [stamps[0], *stamps]
    log.write_text("".join(f"{restamped(x, change(stamps[n], n, before[n]))}\n" for n, x in enumerate(lines)))
    with pytest.raises(UsageError, match=message):
        canprobe.replay(log, scene=lockstep_run.plan.scene)
    with pytest.raises(UsageError, match=message):
        canprobe.measure_traffic(log, lockstep_run.plan)


def test_frames_that_candump_lost_and_can_xl_are_reported(lockstep_run, undisturbed, tmp_path):
    log = tmp_path / "candump.log"
    lines = (lockstep_run.out / "bus.log").read_text().splitlines()
    lines[50:50] = [
        "DROPCOUNT: dropped 3 CAN frames on 'can0' socket (total drops 3)",
        restamped("() can0 45123#81:00:12345678#11223344", stamp_us(lines[50])),
    ]
    log.write_text("\n".join(lines) + "\n")
    plain = undisturbed[0].summary["cycle"]
    counts = canprobe.replay(log, scene=lockstep_run.plan.scene).summary["cycle"]
    assert counts["frames_lost_by_candump"] == 3 and counts["other_frames"] == plain["other_frames"] + 1
    measured = canprobe.measure_traffic(log, lockstep_run.plan, exact=False)
    assert "lost by candump: 3 frames" in measured.text() and "not in the plan: 1 CAN XL frames" in measured.text()
    assert not measured.as_planned
