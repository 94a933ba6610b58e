"""The position of a carrier: what its encoder can have reached since it was heard last."""

import pytest

import canprobe
from canprobe.cell.master.carrier import make_carrier

MS = 1_000_000
TURNS_PER_S = 5.0 / 360.0
"""Speed of the packaged turntable."""


@pytest.fixture
def heard():
    """The receiver of the packaged turntable, heard once at rest, and its counts in a turn."""
    plan = canprobe.plan(canprobe.load_scene("turntable"))
    (pdo,) = plan.pdos_of(plan.setup.carrier.node_id, "tpdo")
    receiver, counts = make_carrier(plan), round(plan.setup.carrier.units * 6.283185307179586)
    period_ns = plan.sync.period_ns

    def hear(cycle, late_ns, turns):
        receiver.begin(cycle * period_ns, cycle * period_ns + late_ns)
        receiver.push(pdo.layout.raw_pack(round(counts * turns)), cycle * period_ns + late_ns + MS // 2)
        return receiver.lost

    assert hear(0, 0, 0.0) is None
    return hear, period_ns * 1e-9


def test_a_jump_that_the_speed_does_not_explain_is_not_believed(heard):
    hear, _ = heard
    assert "node 17: (carrier) reports a jump by 0.1" in str(hear(1, 0, 0.12 / 360.0))


def test_a_motion_up_to_a_sync_that_was_sent_late_is_believed(heard):
    hear, period_s = heard
    assert hear(1, 24 * MS, TURNS_PER_S * (24e-3 + period_s)) is None
    assert hear(2, 22 * MS, TURNS_PER_S * (24e-3 + 2 * period_s)) is None
