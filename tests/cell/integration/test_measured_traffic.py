"""Measured = planned: a lockstep run's log counts what its plan lists, in time, and nothing else."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext

import pytest
from undrawn import undrawn, undrawn_run

import canprobe
from canprobe.cell.emulated.world import make_world
from canprobe.cell.recorded.recording import read_recording
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cli import main
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus


@pytest.fixture(scope="module")
def press(tmp_path_factory):
    folder = tmp_path_factory.mktemp("press")
    scene = canprobe.load_scene("press", {"task.clearance_mm": 0.3})
    return undrawn_run(scene, out=folder, duration_s=0.1), folder


def test_a_touch_is_as_planned_to_the_frame(press):
    result, folder = press
    measured = canprobe.measure_traffic(folder, result.plan)
    assert measured.as_planned and measured.exact
    assert measured.unlisted == {} and measured.missing == ()
    for one in measured.classes:
        if one.planned_frames is not None:
            assert one.frames == pytest.approx(one.planned_frames, rel=0.02), one.kind
            assert one.bits <= one.planned_bits
        assert one.late == 0, one.kind
        assert one.slowest is None or 0.3 < one.slowest <= 1.0
    assert measured.load < measured.planned_worst


def test_the_summary_says_the_same(press):
    result, folder = press
    measured = canprobe.measure_traffic(folder / "bus.log", result.plan).as_dict()
    summary = result.summary["traffic"]["can0"]
    assert summary["as_planned"] is True and summary["stuff_bits_counted"] is False
    for kind, one in summary["classes"].items():
        assert one["frames"] == measured["classes"][kind]["frames"]
        assert one["late"] == 0
    assert summary["load"] < measured["load"] < summary["planned_worst"]


def test_plan_measured_on_the_command_line(press, capsys):
    _, folder = press
    assert main(["plan", "press", "--measured", str(folder)]) == 0
    captured = capsys.readouterr()
    assert "drive TPDO" in captured.out and not captured.err
    assert main(["plan", "press", "--measured", str(folder / "bus.log"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["can0"]["as_planned"] is True
    assert main(["plan", "free", "--measured", str(folder)]) == 3
    captured = capsys.readouterr()
    assert "not in the plan: 511h" in captured.out
    assert captured.err == f"canprobe: {folder} is a run of scene press, compared with the plan of free\n"


def test_logs_that_cannot_be_measured(press, tmp_path):
    result, folder = press
    with pytest.raises(UsageError, match="channel can1; name one that has it: can0"):
        canprobe.measure_traffic(folder, result.plan, channel="can1")
    empty = tmp_path / "empty.log"
    empty.write_text("(0000000000.000000) can0 181#00\n")
    with pytest.raises(UsageError, match="no SYNC"):
        canprobe.measure_traffic(empty, result.plan)
    two = tmp_path / "two.log"
    two.write_text("(0000000000.000000) vcan1 080#01\n(0000000000.000000) vcan2 080#01\n")
    with pytest.raises(UsageError, match="vcan1, vcan2"):
        canprobe.measure_traffic(two, result.plan)


def test_a_sync_that_is_too_long_is_unlisted(press, tmp_path):
    result, folder = press
    text, log = (folder / "bus.log").read_text(), tmp_path / "long.log"
    log.write_text(re.sub(r" 080#(..)$", r" 080#\g<1>00", text, count=1, flags=re.MULTILINE))
    once = canprobe.measure_traffic(log, result.plan)
    assert once.unlisted == {0x080: 1} and not once.as_planned
    assert "  1 frames 080h of 2 bytes, which CiA 301 does not know" in once.text()
    log.write_text(re.sub(r" 080#(..)$", " 080#", text, flags=re.MULTILINE))
    assert canprobe.measure_traffic(log, result.plan).unlisted == {}, "a SYNC without a counter"


def test_a_bus_with_errors_carries_every_frame_and_the_run_says_so(tmp_path):
    """One bit in 10 000 fails: about one frame in 90 is sent again. The log has the error frames, as candump has."""
    scene = canprobe.load_scene("free", {"bus.bit_error_rate": 1e-4, "task.duration_s": 0.3})
    with canprobe.open_cell(undrawn(scene), out=tmp_path) as cell:
        result = cell.run(make_task(cell.plan))
    bus = cell.session.buses.lockstep
    assert bus.error_frames / bus.frames == pytest.approx(110 * 1e-4, rel=0.3)
    assert cell.cell.drives.missed == 0
    assert all(one["as_planned"] for one in result.summary["traffic"]["can0"]["classes"].values())
    measured = canprobe.measure_traffic(tmp_path, cell.plan)
    assert measured.error_frames == result.summary["traffic"]["can0"]["error_frames"] == bus.error_frames > 0
    assert not measured.as_planned and f"error frames: {measured.error_frames}" in measured.text()
    assert (tmp_path / "bus.log").read_text().count(" 20000088#") == measured.error_frames
    assert read_recording(tmp_path / "bus.log", cell.plan).error_frames == measured.error_frames
    (warning,) = result.summary["warnings"]
    assert warning.startswith("bus.bit_error_rate = 0.0001: ") and f"  warning    {warning}" in result.text()
    noted = re.search(r"noted      bus error frames: (\d+), the first in cycle \d+\n", result.text())
    assert noted is not None and 0 < int(noted[1]) <= bus.error_frames  # those of bring-up are none of a cycle's


ERRORS = 0x20000002, 0x200000A8, 0x20000088
"""A lost arbitration, which is no error, and two errors."""


@pytest.fixture
def run_on_real_bus(monkeypatch):
    """A run of `free` on can0 as a cell opens a real one, in virtual time, with errors in the first cycle."""
    keys = {"arm.emulated": False, "task.duration_s": 0.1, "outputs.figures": False, "bus.interface": "socketcan"}
    scene = canprobe.load_scene("free", keys)
    bus, reports = LockstepBus(VirtualClock()), []
    for node in make_world(canprobe.plan(scene), scene.drives).nodes:
        bus.attach(node)

    def open_port(*_, **options):
        reports.append(options["reports"])
        return bus.port()

    monkeypatch.setattr("canprobe.fieldbus.bus.real.opening.open_port", open_port)
    monkeypatch.setattr("canprobe.cell.session.buses.MonotonicClock", lambda: bus.clock)
    monkeypatch.setattr("canprobe.cell.session.buses.check_links", lambda *_: None)
    monkeypatch.setattr("canprobe.cell.session.session.garbage_collection_paused", lambda **_: nullcontext())
    monkeypatch.setattr("canprobe.cell.session.session.rehearse", lambda _: None)

    def run(errors, **options):
        left = list(errors)

        def progress(done_s, _):
            while left:
                reports[0].error_frame(left.pop(0), bytes(8), round(done_s * 1e9))

        return canprobe.run(scene, progress=progress, **options)

    return run


def test_error_frames_of_a_real_bus_are_in_the_log_and_beside_the_plan(run_on_real_bus, tmp_path):
    result = run_on_real_bus(ERRORS, out=tmp_path)
    traffic = result.summary["traffic"]["can0"]
    assert (traffic["error_frames"], traffic["as_planned"]) == (2, False)
    assert all(one["as_planned"] for one in traffic["classes"].values())
    logged = [line.split()[2] for line in (tmp_path / "bus.log").read_text().splitlines() if " 2000" in line]
    assert logged == [f"{can_id:08X}#{'00' * 8}" for can_id in ERRORS]
    assert read_recording(tmp_path / "bus.log", result.plan).error_frames == 2


@pytest.mark.parametrize(("errors", "found"), [(ERRORS, (False, 2)), ((), (None, 0))])
def test_without_a_log_the_errors_of_a_real_bus_are_counted_all_the_same(run_on_real_bus, errors, found):
    traffic = run_on_real_bus(errors, files=False).summary["traffic"]
    assert traffic == {"can0": dict(zip(("as_planned", "error_frames"), found, strict=True))}
