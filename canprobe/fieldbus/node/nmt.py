"""The NMT state machine of a slave as a table.

    power on / reset → INITIALISING → (boot-up) PRE_OPERATIONAL ⇄ OPERATIONAL ⇄ STOPPED ⇄ PRE_OPERATIONAL

Every command works in every state but INITIALISING, in which no command works.
Source: CiA 301, "NMT state machine" and "NMT node control".
"""

from __future__ import annotations

from canprobe.fieldbus.protocol.frames import NmtCommand, NmtState

NMT_GOALS = {
    NmtCommand.START: NmtState.OPERATIONAL,
    NmtCommand.STOP: NmtState.STOPPED,
    NmtCommand.PRE_OPERATIONAL: NmtState.PRE_OPERATIONAL,
    NmtCommand.RESET_NODE: NmtState.INITIALISING,
    NmtCommand.RESET_COMMUNICATION: NmtState.INITIALISING,
}
