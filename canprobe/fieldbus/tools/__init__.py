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

from canprobe.fieldbus import door

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

_MODULES = {
    "Examination": "tools.conform",
    "ExaminationSettings": "tools.conform",
    "FaultyNode": "tools.faults",
    "Judge": "tools.judge",
    "Report": "tools.reports",
    "closing_text": "tools.reports",
    "inject": "tools.faults",
    "read_record": "tools.judge",
    "write_json": "tools.reports",
    "write_junit": "tools.reports",
}
__all__ = [*_MODULES]  # noqa: PLE0604 - they are strings
__getattr__, __dir__ = door(__name__, _MODULES)
