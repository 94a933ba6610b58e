"""Tools for other people's nodes and masters: examinations, a judge, faults on demand, and reports.

- `conform` examines a device of any maker, and leaves it as it was.
- `faults` is the registry of faults: what can go wrong with a node, its link, its drive, and how it is thrown.
- `emulated_bus` puts emulated nodes on a bus of a test, in virtual or in real time;
  `judged_bus` judges the master of a test on it.
- `judge` finds known faults of masters in the frames of a bus.
- `link` judges whether a bus, its nodes and the machine hold a cycle.
- `reports` are what examinations of nodes and masters report, for people and for CI servers.

The tools take nodes and ports; they never build them from a cell. Start reading at `faults`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.fieldbus.tools.conform import Examination as Examination
    from canprobe.fieldbus.tools.conform import ExaminationSettings as ExaminationSettings
    from canprobe.fieldbus.tools.faults import FaultyNode as FaultyNode
    from canprobe.fieldbus.tools.faults import inject as inject
    from canprobe.fieldbus.tools.judge import Judge as Judge
    from canprobe.fieldbus.tools.judge import read_record as read_record
    from canprobe.fieldbus.tools.reports import Report as Report
    from canprobe.fieldbus.tools.reports import closing_text as closing_text
    from canprobe.fieldbus.tools.reports import write_json as write_json
    from canprobe.fieldbus.tools.reports import write_junit as write_junit

__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "tools.conform": ("Examination", "ExaminationSettings"),
        "tools.faults": ("FaultyNode", "inject"),
        "tools.judge": ("Judge", "read_record"),
        "tools.reports": ("Report", "closing_text", "write_json", "write_junit"),
    },
)
