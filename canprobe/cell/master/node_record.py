"""A record of a cell that lasts from one use to the next: what is known of its drives, node by node, in a file."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from canprobe.errors import check_schema
from canprobe.fieldbus.bus.files import make_folder, write_text

SCHEMA = 1
"""Version of these records."""


class NodeRecord:
    """The record of a cell's drives, by node id, in a file.

    Args:
        path: path of a JSON file; None: nothing is kept.
        remedy: what to do where the file is of a newer canprobe, once it is removed.

    Raises:
        UsageError: the file is of a newer canprobe. One that cannot be read counts as none: all is done again.
    """

    def __init__(self, path: Path | None, remedy: str) -> None:
        self._path = path
        self._nodes: dict[str, dict[str, Any]] = {}
        if path is not None and path.is_file():
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                content = json.loads(path.read_text(encoding="utf-8"))
                nodes = dict(content["nodes"])
                check_schema(path, content.get("schema", 1), SCHEMA, f"remove it, and {remedy}")
                self._nodes = nodes

    def entry(self, node_id: int) -> dict[str, Any]:
        """The entry of a node; empty where nothing is known."""
        found = self._nodes.get(str(node_id))
        return found if isinstance(found, dict) else {}

    def put(self, node_id: int, entry: dict[str, Any] | None) -> None:
        """Write the entry of a node; None removes it.

        Raises:
            ResultsError: the file cannot be written.
        """
        self._nodes.pop(str(node_id), None)
        if entry is not None:
            self._nodes[str(node_id)] = entry
        if self._path is not None:
            make_folder(self._path.parent)
            write_text(self._path, json.dumps({"schema": SCHEMA, "nodes": self._nodes}, indent=1) + "\n")
