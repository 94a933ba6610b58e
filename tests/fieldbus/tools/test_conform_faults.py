"""Each kind of fault, thrown at a drive under examination, fails the points that its row of the registry names."""

from __future__ import annotations

import pytest
from examined import NODE_ID, eds_device, failed

from canprobe.errors import NodeError
from canprobe.fieldbus.tools.conform import ExaminationSettings
from canprobe.fieldbus.tools.faults import BUS_FAULTS, Fault, FaultyNode
from canprobe.fieldbus.tools.reports import Verdict

LONG = pytest.mark.slow(reason="most transfers end by their time-outs; as long as all other kinds")


@pytest.mark.parametrize("name", [pytest.param(name, marks=[LONG] * (name == "sdo-size")) for name in BUS_FAULTS])
def test_a_kind_of_fault_fails_the_points_of_its_row(name):
    kind = BUS_FAULTS[name]
    device = eds_device(wrap=lambda node: FaultyNode(node, [Fault(kind, NODE_ID, seed=1)]))
    if kind.points == {"unanswered"}:
        with pytest.raises(NodeError, match="it cannot be examined: no answer"):
            device.run()
        return
    report = device.run(ExaminationSettings(motion=True))
    if kind.points == {"most"}:
        counts = report.counts()
        assert counts[Verdict.FAIL] + counts[Verdict.ERROR] > 10 * counts[Verdict.PASS]
    else:
        assert {title.split()[1] for title in failed(report)} == kind.points, failed(report)
