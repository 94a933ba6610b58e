"""The result of a study: a table with its facts and findings, and a picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Say = Callable[[str], None]
Row = dict[str, Any]
"""A row of a table, by the keys of its columns."""
CHANNEL = "vcan0"
"""The interface of studies in real time."""
CHI2_95_OF_3 = 7.815
FROBENIUS = np.array([1.0, 2.0, 1.0])
"""Weights of (K11², K12², K22²) in ‖K‖²."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a study's table.

    Attributes:
        key: key of the rows, and heading in the CSV; it ends in the unit.
        heading: heading in the printed table.
        form: format of a value, as for `format`.
    """

    key: str
    heading: str
    form: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class StudyResult:
    """The result of a study.

    Attributes:
        name: name of the study.
        columns: columns of the table.
        rows: one row for each case; None where a value does not apply.
        findings: sentences with figures.
        facts: machine, versions and settings of the measurement.
        draw: function that writes the picture to a path; it needs matplotlib.
        more: further tables of the study, each with its findings, files and picture.
    """

    name: str
    columns: Sequence[Column]
    rows: Sequence[Row]
    findings: Sequence[str]
    facts: Mapping[str, Any]
    draw: Callable[[Path], None]
    more: Sequence[StudyResult] = ()
