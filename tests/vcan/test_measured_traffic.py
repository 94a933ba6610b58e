"""Measured = planned on a real SocketCAN interface: the master's own log, and what a listener on the bus has heard."""

from __future__ import annotations

import socket
import struct
from typing import Any

import pytest

import canprobe
from canprobe.fieldbus.bus.candump import CandumpWriter
from canprobe.fieldbus.bus.port import ERR_FLAG

pytestmark = pytest.mark.vcan
SECONDS = 4
ERROR_FRAMES = (0x20000002, 0x20000088, 0x200000A8)  # a lost arbitration, a protocol error, no acknowledgement


@pytest.mark.slow(reason="four seconds of a cell on a real bus; in lockstep: tests/cell/integration")
def test_a_run_counts_what_its_plan_lists(bench: Any) -> None:
    """At 100 Hz. Cycles that the machine could not keep are counted by the run itself and allowed for."""
    scene = bench.scene("press")
    command = bench.start(
        "run", scene, "--bus", "socketcan", "--channel", "vcan0", "--duration", SECONDS, "--out", "results", "--json"
    )
    heard = []
    bench.bus.until_booted(1, 2, 3, 4, 5, 6, 16, by=command)
    bench.bus.until_enabled(6, by=command, cycles=1)
    with socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as controller:
        controller.bind(("vcan0",))
        for can_id in ERROR_FRAMES:
            controller.send(struct.pack("=IB3x8s", can_id, 8, b""))
    while command.running:
        heard += bench.bus.hear()
    command.end(0)
    heard += bench.bus.hear()
    results = bench.results("results")
    with CandumpWriter(bench.folder / "heard.log", "vcan0") as writer:
        for frame in heard:
            writer.write(*frame)
    plan = canprobe.plan(canprobe.load_scene(scene))
    for log in ("results", "heard.log"):
        measured = canprobe.measure_traffic(bench.folder / log, plan, channel="vcan0")
        assert measured.unlisted == {}, log
        assert measured.missing == (), log
        classes = {one.kind: one for one in measured.classes}
        assert measured.load <= measured.planned_worst
        lost = results.summary["cycle"]["overruns"] + results.summary["cycle"]["missed_pdos"]
        for kind in ("SYNC", "drive TPDO", "drive RPDO", "tactile PDO", "heartbeat"):
            one = classes[kind]
            assert one.planned_frames is not None and one.planned_bits is not None
            allowed = max(0.02 * one.planned_frames, one.messages) + lost * one.messages
            assert one.frames == pytest.approx(one.planned_frames, abs=allowed), (log, kind)
            assert one.bits <= one.planned_bits, (log, kind)
    traffic = results.summary["traffic"]["vcan0"]
    assert traffic["unlisted"] == []
    assert (traffic["error_frames"], traffic["as_planned"]) == (2, False)
    assert [can_id for _, _, can_id, _ in results.frames if can_id & ERR_FLAG] == list(ERROR_FRAMES)
    assert any(fault.startswith("bus error frames: 2,") for fault in results.summary["faults"])
