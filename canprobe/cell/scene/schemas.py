"""The packaged JSON Schemas of scene, cell and array files: how a file names the schema beside it for editors."""

from __future__ import annotations

from importlib import resources

KINDS = ("scene", "cell", "array")


def schema_text(kind: str) -> str:
    """The schema of a "scene", "cell" or "array" file, as JSON text."""
    return (resources.files("canprobe") / "schemas" / f"{kind}.json").read_text(encoding="utf-8")


def schema_name(kind: str) -> str:
    """Name of the file of a schema that stands beside the files that it describes."""
    return f"{kind}.schema.json"


def schema_line(kind: str) -> str:
    """The first lines of a TOML file with its schema beside it; editors want the blank line."""
    return f"#:schema ./{schema_name(kind)}\n\n"
