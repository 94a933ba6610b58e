"""A plan as files of other tools, by format."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from canprobe.planning import Plan


def export_plan(plan: Plan, folder: Path, formats: Iterable[str]) -> list[Path]:
    """Write a plan in each format.

    Args:
        plan: what to write.
        folder: made where it is not there.
        formats: `dcf`, `dbc`, `kcd`, `bus.yml`.

    Returns:
        The files.

    Raises:
        UsageError: an extra is missing.
        ResultsError: a file cannot be written.
        OSError: the folder cannot be made.
    """
    folder.mkdir(parents=True, exist_ok=True)
    return [path for form in dict.fromkeys(formats) for path in _export(plan, folder, form)]


def _export(plan: Plan, folder: Path, form: str) -> list[Path]:
    if form == "dcf":
        from canprobe.bridge.dcf import write_dcfs

        return write_dcfs(plan, folder)
    if form == "bus.yml":
        from canprobe.bridge.bus_yml import write_bus_yml

        return write_bus_yml(plan, folder)
    from canprobe.bridge.database import write_database

    return [write_database(plan, folder, form)]
