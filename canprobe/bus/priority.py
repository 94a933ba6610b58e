"""The processor's favour, where it can be had."""

from __future__ import annotations

import contextlib
import os

FAVOURED = -15
"""Nice value asked for."""


def ask_for_processor() -> bool:
    """Ask to be scheduled before ordinary processes; True where that was permitted.

    Emulated nodes stand for devices of their own, which answer SYNC whatever the master is busy with. On one processor
    that takes a favour, else both sides wait for each other.
    """
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, 0, FAVOURED)
        return True
    return False
