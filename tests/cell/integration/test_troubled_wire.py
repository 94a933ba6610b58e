"""A cell on a wire that fails: a babbling idiot, and a drive whose controller goes bus off."""

from __future__ import annotations

import pytest
from wire_faults import Babbler

import canprobe
from canprobe.cell.master.options import RunOptions
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.protocol.frame_bits import exact_bits


def last_statuswords(folder):
    last = {can_id: data for _, _, can_id, data in read_candump(folder / "bus.log")}
    return [state_of(int.from_bytes(last[0x180 + n][:2], "little")) for n in range(1, 7)]


def test_a_babbling_idiot_stops_the_cell_and_the_drives_end_without_power(tmp_path):
    """For 150 ms an identifier below SYNC's fills the bus: nobody hears a SYNC, and both sides stop by themselves."""
    session = Session(canprobe.load_scene("free", {"task.duration_s": 2.0}), RunOptions(tmp_path))
    shout = (0x001, bytes(8))
    with pytest.raises(CanprobeError), session:
        bus = session.buses.lockstep
        begin = bus.clock.now_ns() + 400_000_000
        bus.attach(Babbler(shout, exact_bits(*shout) * 1000, first_ns=begin, last_ns=begin + 150_000_000))
        session.run(make_task(session.plan))
    assert not set(last_statuswords(tmp_path)) & set(POWERED_STATES)
    frames = [(t, can_id) for t, _, can_id, _ in read_candump(tmp_path / "bus.log")]
    inside = {can_id for t, can_id in frames if begin + 10**6 < t < begin + 149 * 10**6}
    assert inside == {0x001}
    measured = canprobe.measure_traffic(tmp_path, session.plan)
    assert set(measured.unlisted) == {0x001} and not measured.as_planned
