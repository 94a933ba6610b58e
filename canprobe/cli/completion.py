"""Completion of command lines by the shell (extra `complete`): names of scenes, cells, buses and so on, and files.

The shell starts the command with `_ARGCOMPLETE` set, and argcomplete answers in its place.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Iterable, Sequence


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
        if action.dest in _NAMES and action.choices is None:
            action.completer = _NAMES[action.dest]  # type: ignore[attr-defined]
    argcomplete.autocomplete(parser)


def _actions(parser: argparse.ArgumentParser) -> Iterable[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for inner in action.choices.values():
                yield from _actions(inner)


class _Completer:
    """Names, and the files that could stand in their place."""

    def __init__(self, names: Callable[[], Iterable[str]], endings: Sequence[str] | None = None) -> None:
        self._names, self._endings = names, endings

    def __call__(self, prefix: str, **_: object) -> list[str]:
        from argcomplete.completers import FilesCompleter

        files = () if self._endings is None else FilesCompleter(self._endings)(prefix)
        return [*(name for name in self._names() if name.startswith(prefix)), *files]


def _packaged(kind: str) -> Callable[[], Iterable[str]]:
    def names() -> Iterable[str]:
        from canprobe.cell.scene.load import packaged_files
        from canprobe.cell.scene.plugins import plugins

        return [*packaged_files(f"{kind}s"), *(plugin.name for plugin in plugins(kind))]

    return names


def _buses() -> Iterable[str]:
    from canprobe.fieldbus.bus.real.adapters import interface_names

    return ("lockstep", "direct", "config", *interface_names())


def _bridges() -> Iterable[str]:
    from canprobe.cell.planning.bridges import BRIDGES

    return BRIDGES


def _studies() -> Iterable[str]:
    from canprobe.lab.studies.sweep import STUDIES

    return STUDIES


def _eds() -> Iterable[str]:
    from canprobe.fieldbus.eds.packaged import eds_names

    return eds_names()


_NAMES = {
    "scene": _Completer(_packaged("scene"), ("toml",)),
    "what": _Completer(_packaged("scene"), ("toml",)),
    "cell": _Completer(_packaged("cell"), ("toml",)),
    "bus": _Completer(_buses),
    "bridge": _Completer(_bridges),
    "eds": _Completer(_eds, ("eds", "dcf")),
    "name": _Completer(_studies),
}
