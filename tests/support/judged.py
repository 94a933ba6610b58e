"""What the judge of masters says of ours."""

from __future__ import annotations

from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.tools.judge import BusFrame, Judge


def rules_raised(plan, frames, *, charges_ns=()):
    """Rules that the master of a plan raises, and what was found; frames are (can_id, data, t_ns)."""
    nodes = {node.node_id: Description(load_eds(node.eds, node.node_id)) for node in plan.nodes}
    ordered = (BusFrame(t_ns, can_id, data) for can_id, data, t_ns in frames)
    judge = Judge(nodes, served=True, charges_ns=charges_ns).hear(ordered)
    assert sum(case.looked > 0 for case in judge.cases.values()) > 5, "there was something to judge"
    return {number: case.findings[0].what for number, case in judge.cases.items() if case.count}
