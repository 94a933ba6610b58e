"""What a study is: a table with its facts and findings, and a picture. `canprobe study` runs and writes them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.studies.sweep import Sweep

Say = Callable[[str], None]
Row = Mapping[str, Any]

STUDIES: Mapping[str, str] = MappingProxyType(
    {
        "estimators": "error of the shape estimators against their run time, with the Cramér–Rao bound",
        "bound": "how near to the Cramér–Rao bound the estimators come, over surfaces, sizes, paths and noise",
        "region": "a pilot of `bound`: how far out the bound means something, by what limits it",
        "pipeline": "whether the online estimator's 95 % regions hold with the whole sensor pipeline on",
        "workprec": "error of the dynamic plant against its run time, and of the whole cell against what it computes",
        "stability": "where the force loop settles, predicted and carried out, and how every other touch ends",
        "realtime": "how well the cycle keeps time on a real vcan0, against plain canopen-python; needs that interface",
        "soak": "an hour on a real vcan0: memory, clocks and counters; needs that interface",
        "faults": "what the cell does about thousands of random faults of its nodes and their links",
        "bridges": "what each bridge to another tool adds to a cycle at 400 Hz, what it drops, and its size on disk",
    }
)
"""Name → what it shows. The module of that name in this package has `run(*, quick, sweep) -> StudyResult`."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a study's table.

    Attributes:
        key: of the rows, and the heading in the CSV; ends in the unit.
        heading: in the printed table.
        form: how a value is printed, as for `format`.
    """

    key: str
    heading: str
    form: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """What a study found.

    Attributes:
        name: of the study.
        columns: of the table.
        rows: one a case; None where a value does not apply.
        findings: plain sentences with figures, right or wrong ones.
        facts: what it was measured with.
        draw: writes the picture to a path; needs matplotlib.
        more: further tables of the study, each with findings, files and a picture of its own.
    """

    name: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    findings: Sequence[str]
    facts: Mapping[str, Any]
    draw: Callable[[Path], None]
    more: Sequence[StudyResult] = ()


def run_study(name: str, *, quick: bool, sweep: Sweep, vcan: bool = False) -> StudyResult:
    """Run a study.

    Args:
        name: one of `STUDIES`.
        quick: fewer repeats and cases.
        sweep: computes its cells.
        vcan: its form with processes on a real vcan0, which `faults` has.

    Raises:
        UsageError: for an unknown name.
    """
    if name not in STUDIES:
        raise UsageError(f"study: expected one of {', '.join(STUDIES)}, got {name!r}")
    module = importlib.import_module(f"canprobe.studies.{name}_vcan" if vcan else f"canprobe.studies.{name}")
    result: StudyResult = module.run(quick=quick, sweep=sweep)
    return result
