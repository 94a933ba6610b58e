"""The drive's finite state automaton, on the tables of `protocol.cia402`; what a state does is the drive's.

Source: CiA 402-2, "Finite state automaton".
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.protocol.cia402 import (
    AUTOMATIC_TRANSITIONS,
    INITIAL_STATE,
    TRANSITIONS,
    Command,
    DriveState,
    Event,
    command_of,
)

Entered = Callable[[DriveState, DriveState, int], None]


class DriveStates:
    """State, controlword edges, and the two transitions that need more than the table.

    Attributes:
        state: present state.
        command: the command that stands, or None.
        idle_word: the last controlword, if it did nothing and nothing has happened since; it need not be given again.
        resumable: whether a quick stop may be left for operation (605Ah = 5, 6).
    """

    def __init__(self, entered: Entered, resumable: Callable[[], bool]) -> None:
        """`entered(old, new, t_ns)` is called after every change of state."""
        self._entered, self.resumable = entered, resumable
        self.state = INITIAL_STATE
        self.command: Command | None = None
        self._previous = 0
        self.idle_word: int | None = None

    def reset(self, t_ns: int) -> None:
        """Power on: self-test passed at once."""
        self.state, self.command, self._previous = INITIAL_STATE, None, 0
        self.idle_word = None
        self.event(Event.INITIALISED, t_ns)

    def controlword(self, word: int, t_ns: int) -> None:
        """A controlword was received."""
        command = command_of(word, self._previous)
        repeated, self.command, self._previous = command is self.command, command, word
        goal = None if command is None else TRANSITIONS.get((self.state, command))
        resumes = self.state is DriveState.QUICK_STOP_ACTIVE and goal is DriveState.OPERATION_ENABLED
        if goal is None or (resumes and (repeated or not self.resumable())):
            self.idle_word = word
            return  # a drive that stopped by itself is not restarted by a controlword that merely repeats
        self._go(goal, t_ns)

    def pass_on(self, t_ns: int) -> None:
        """Transition 4 after 3, when the controlword that switched on also enables."""
        if self.state is DriveState.SWITCHED_ON and self.command is Command.ENABLE_OPERATION:
            self._go(DriveState.OPERATION_ENABLED, t_ns)

    def event(self, event: Event, t_ns: int) -> None:
        """Something in the drive changes the state."""
        goal = AUTOMATIC_TRANSITIONS.get((self.state, event))
        if goal is not None:
            self._go(goal, t_ns)

    def force(self, command: Command, t_ns: int) -> None:
        """The drive commands itself (abort connection, 6007h)."""
        goal = TRANSITIONS.get((self.state, command))
        if goal is not None:
            self._go(goal, t_ns)

    def _go(self, goal: DriveState, t_ns: int) -> None:
        old, self.state, self.idle_word = self.state, goal, None
        self._entered(old, goal, t_ns)
