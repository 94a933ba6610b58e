"""The NMT state machine of a slave as a table.

    power on / reset → INITIALISING → (boot-up) PRE_OPERATIONAL ⇄ OPERATIONAL ⇄ STOPPED ⇄ PRE_OPERATIONAL

Source: CiA 301, "NMT state machine" and "NMT node control".
"""

from __future__ import annotations

from canprobe.protocol.frames import NmtCommand, NmtState

_ALIVE = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED)
_GOALS = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    NmtCommand.RESET_NODE: NmtState.INITIALISING,
    NmtCommand.RESET_COMMUNICATION: NmtState.INITIALISING,
}

NMT_TRANSITIONS: dict[tuple[NmtState, NmtCommand], NmtState] = {
    (state, command): goal for state in _ALIVE for command, goal in _GOALS.items()
}
"""Every command works in every state but INITIALISING, where none does."""
