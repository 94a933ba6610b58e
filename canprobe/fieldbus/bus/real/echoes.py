"""Recognises our own frames on a bus that returns to a sender what it sent."""

from __future__ import annotations

from collections import deque

from canprobe.fieldbus.protocol.frames import Frame

_MAX_ECHO_DELAY_NS = 1_000_000_000


class Echoes:
    """Takes the first received frame that equals a sent one for its echo, once.

    A frame of another sender with the same identifier and data comes besides the echo, so one of the two is kept. An
    echo is expected for a second.
    """

    def __init__(self) -> None:
        self._waiting: dict[Frame, deque[int]] = {}

    def sent(self, frame: Frame, t_ns: int) -> None:
        """Note a frame that was sent."""
        self._waiting.setdefault(frame, deque()).append(t_ns)

    def is_one(self, frame: Frame, t_ns: int) -> bool:
        """Whether a received frame is the echo of a sent one, which then expects no other."""
        waiting = self._waiting.get(frame)
        while waiting and t_ns - waiting[0] > _MAX_ECHO_DELAY_NS:
            waiting.popleft()
        if not waiting:
            self._waiting.pop(frame, None)
            return False
        waiting.popleft()
        if not waiting:
            del self._waiting[frame]
        return True
