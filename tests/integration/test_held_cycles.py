"""A scan in which the cell held for some cycles: the controller had no say in them, and the results are whole."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.emulator.faults import Fault, FaultKind
from canprobe.emulator.faulty_node import FaultyNode
from canprobe.session import Session


@pytest.fixture
def mute_for_a_while(monkeypatch):
    """Node 5 says nothing for four cycles in mid-scan."""
    make, run = Session.__init__, Session.run

    def made(session, *arguments, **more):
        make(session, *arguments, **more)
        session.joins = lambda node: join(session, node)

    def join(session, participant):
        if getattr(participant, "node_id", None) == 5:
            session.fifth = participant = FaultyNode(participant, (), ())
        return participant

    def watched(session, controller, progress=lambda _: None):
        def watch(measurement):
            if measurement.cycle == 1000:
                session.fifth.add(Fault(FaultKind.MUTE, 5, session.lockstep.clock.now_ns(), 9_000_000))
            progress(measurement)

        run(session, controller, watch)

    monkeypatch.setattr(Session, "__init__", made)
    monkeypatch.setattr(Session, "run", watched)


def test_a_scan_with_held_cycles_is_summed_up_and_saved(mute_for_a_while, tmp_path):
    scene = canprobe.load_scene("cylinder")
    scene = replace(scene, task=replace(scene.task, clearance_mm=0.8))
    result = canprobe.run(scene, out=tmp_path, duration_s=2.0)
    assert any("hold" in fault for fault in result.summary["faults"])
    force = result.log["force_n"]
    assert np.isnan(force[1000:1010]).any(), "cycles without a word of the controller"
    assert 0.0 < result.summary["contact"]["force_measured_rms_error_n"] < 0.2, "of the cycles that have one"
    saved = json.loads((tmp_path / "summary.json").read_text(), parse_constant=pytest.fail)
    assert saved == json.loads(json.dumps(result.summary))
    with np.load(tmp_path / "log.npz") as log:
        assert len(log["t_s"]) == result.summary["cycle"]["cycles"]
