"""A plan as files of other tools, by format: device configuration files, ros2_canopen's `bus.yml`, CAN databases."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from canprobe.cell.planning.model import Plan
from canprobe.fieldbus.bus.files import make_folder
from canprobe.lab.bridge.bus_yml import write_bus_yml
from canprobe.lab.bridge.database import write_database
from canprobe.lab.bridge.dcf import write_dcfs


def export_plan(plan: Plan, folder: Path, formats: Iterable[str]) -> list[Path]:
    """Write a plan in each format.

    Args:
        plan: plan to write.
        folder: folder of the files; made where it is missing.
        formats: names of formats: `dcf`, `dbc`, `kcd`, `bus.yml`.

    Returns:
        The files.

    Raises:
        UsageError: when an extra is missing.
        ResultsError: when the folder or a file cannot be written.
    """
    make_folder(folder)
    files = []
    for form in dict.fromkeys(formats):
        if form == "dcf":
            files += write_dcfs(plan, folder)
        elif form == "bus.yml":
            files += write_bus_yml(plan, folder)
        else:
            files.append(write_database(plan, folder, form))
    return files
