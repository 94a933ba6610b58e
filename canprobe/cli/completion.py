"""Completion of command lines by the shell (extra `complete`): names of scenes, cells, buses and so on, and files.

The shell starts the command with `_ARGCOMPLETE` set, and argcomplete answers in its place.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial

_SCENES = ("scene", ("toml",))
_COMPLETED: dict[str, tuple[str, tuple[str, ...]]] = {
    **{"scene": _SCENES, "what": _SCENES, "cell": ("cell", ("toml",)), "eds": ("eds", ("eds", "dcf"))},
    **{"bus": ("bus", ()), "bridge": ("bridge", ()), "name": ("study", ())},
}
"""Kind of the names of an argument, and the endings of the files that could stand in their place."""


def complete(parser_of: Callable[[Sequence[str]], argparse.ArgumentParser], commands: Sequence[str]) -> None:
    """Answer the shell and end the process, where argcomplete is installed.

    Args:
        parser_of: returns the parser for arguments.
        commands: names of all commands.
    """
    try:
        import argcomplete
    except ImportError:
        return
    typed = os.environ.get("COMP_LINE", "").split(" ")[1:-1]
    parser = parser_of([word for word in typed if word in commands][:1])
    for action in _actions(parser):
        if action.dest in _COMPLETED and action.choices is None:
            action.completer = partial(_completed, *_COMPLETED[action.dest])  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser)


def _actions(parser: argparse.ArgumentParser) -> Iterable[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                yield from _actions(inner)


def _completed(kind: str, endings: Sequence[str], prefix: str, **_: object) -> list[str]:
    """Names of a kind, and the files that could stand in their place."""
    from argcomplete.completers import FilesCompleter

    files = FilesCompleter(endings)(prefix) if endings else ()
    return [*(name for name in _names(kind) if name.startswith(prefix)), *files]


def _names(kind: str) -> Iterable[str]:
    """All names of a kind; what knows them is imported for that kind only."""
    match kind:
        case "bus":
            from canprobe.fieldbus.bus.real.adapters import interface_names

            return ("lockstep", "direct", "config", *interface_names())
        case "bridge":
            from canprobe.cell.planning.bridges import BRIDGES

            return BRIDGES
        case "study":
            from canprobe.lab.studies.sweep import STUDIES

            return STUDIES
        case "eds":
            from canprobe.fieldbus.eds.packaged import eds_names

            return eds_names()
        case _:
            from canprobe.cell.scene.load import packaged_files
            from canprobe.cell.scene.plugins import plugins

            return [*packaged_files(f"{kind}s"), *(plugin.name for plugin in plugins(kind))]
