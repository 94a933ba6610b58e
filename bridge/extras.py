"""Packages of optional extras: imported where they are used, with the pip line where they are missing."""

from __future__ import annotations

import importlib
from typing import Any

from canprobe.errors import UsageError


def need(module: str, extra: str, purpose: str) -> Any:
    """Import a package that belongs to an extra.

    Args:
        module: its import name.
        extra: of canprobe's.
        purpose: what it is needed for, for the message.

    Raises:
        UsageError: it is not installed; with the line that installs it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"{purpose} needs {module}: pip install 'canprobe[{extra}]'") from error
