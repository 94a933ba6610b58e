"""`bus.transmit_queue = "fifo"`: the plan's response times hold for nodes that send their oldest frame first."""

from __future__ import annotations

from scenes import change, refused
from undrawn import undrawn_run

import canprobe
from canprobe.cell.planning import traffic
from canprobe.cell.planning.report import plan_dict, plan_text
from canprobe.cell.scene.load import load_scene

HEARTBEAT, SYNC, FULL = 65, 65, 135


def fifo(name, **sections):
    return change(load_scene(name), **{**sections, "bus": {"transmit_queue": "fifo", **sections.get("bus", {})}})


def test_sync_behind_the_masters_heartbeat_by_hand():
    """77Fh is the last to win the bus: before it go the frame on the wire, nine tactile PDOs, a heartbeat;
    only then comes SYNC, which waits for one frame at most in a priority queue."""
    assert canprobe.plan(load_scene("listen")).traffic.sync_response_ns == (HEARTBEAT + SYNC) * 1000
    plan = canprobe.plan(fifo("listen"))
    on_the_wire = HEARTBEAT  # nothing is below 77Fh: the longest frame that was queued before it, of its own node
    assert plan.traffic.sync_response_ns == (on_the_wire + 9 * FULL + HEARTBEAT + HEARTBEAT + SYNC) * 1000
    assert 'bus.transmit_queue = "fifo"' in plan_text(plan)
    assert plan_dict(plan)["bus"]["transmit_queue"] == "fifo"


def test_what_shares_a_queue_shares_its_worst_case():
    plan = canprobe.plan(fifo("free", cycle={"rate_hz": 125.0}))
    commands = {pdo.response_ns for pdo in plan.pdos if pdo.direction == "rpdo"}
    assert len(commands) == 1, "all in the master's queue, behind the same heartbeat"
    priority = canprobe.plan(change(load_scene("free"), cycle={"rate_hz": 125.0}))
    for queued, first in zip(plan.pdos, priority.pdos, strict=True):
        assert queued.response_ns > first.response_ns
    assert plan.traffic.load == priority.traffic.load


def test_the_default_cell_does_not_fit_and_says_what_would():
    error = refused(fifo("press"))
    assert "every node's oldest frame first: worst-case response time of SYNC is without bound" in error.problems[0]
    assert error.ways_out[0].startswith("controllers that send their most urgent frame first")


def test_no_frame_of_a_run_is_later_than_planned(tmp_path):
    result = undrawn_run(fifo("free", cycle={"rate_hz": 125.0}), out=tmp_path, duration_s=0.3)
    measured = canprobe.measure_traffic(tmp_path, result.plan)
    assert measured.as_planned
    behind_sync = [one for one in measured.classes if one.slowest is not None]
    assert behind_sync and all(one.late == 0 and 0.0 < one.slowest < 1.0 for one in behind_sync)


def test_a_bound_that_is_not_found_is_none(monkeypatch):
    """Should SYNC and feedback push each other on without end, there is no bound rather than the last guess."""
    monkeypatch.setattr(traffic, "MAX_ROUNDS", 1)
    assert any("without bound" in problem for problem in refused(load_scene("free")).problems)
