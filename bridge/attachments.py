"""What a recording is kept with: the scene as resolved, the EDS of every node, the bus as DBC, the summary."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Iterator
from pathlib import Path

from canprobe.eds import eds_path
from canprobe.planning.model import Plan
from canprobe.scene_writer import dump_scene

Attachment = tuple[str, str, bytes]
"""Name, media type, content."""
_DATABASE = "canprobe.bridge.database"


def attachments_of(plan: Plan, out: Path | None, summary: str | None) -> Iterator[Attachment]:
    """The files of a run that a recording carries.

    Args:
        plan: of the run.
        out: its folder, where a summary may lie already.
        summary: content of `summary.json`; None takes the one in the folder, if there is one.
    """
    yield "scene.toml", "application/toml", dump_scene(plan.scene).encode()
    for eds in dict.fromkeys(node.eds for node in plan.nodes):
        path = Path(eds) if Path(eds).is_file() else eds_path(eds)
        yield path.name, "text/plain", path.read_bytes()
    if (dbc := dbc_of(plan)) is not None:
        yield f"{plan.scene.name}.dbc", "text/plain", dbc.encode("cp1252")
    if summary is not None:
        yield "summary.json", "application/json", summary.encode()
    elif out is not None and (out / "summary.json").is_file():
        yield "summary.json", "application/json", (out / "summary.json").read_bytes()


def dbc_of(plan: Plan) -> str | None:
    """Every PDO of the plan as DBC; None where `cantools` is not installed."""
    if importlib.util.find_spec("cantools") is None or importlib.util.find_spec(_DATABASE) is None:
        return None
    text: str = importlib.import_module(_DATABASE).plan_database(plan).as_dbc_string()
    return text
