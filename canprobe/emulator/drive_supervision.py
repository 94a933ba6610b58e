"""What makes a drive stop by itself in operation enabled: a silent master, and a motor that does not follow.

Source: CiA 402-2, objects 6065h and 6066h; CiA 301, error codes 8100h and 8250h.
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.emulator.drive_parameters import DriveParameters
from canprobe.emulator.node import SlaveNode
from canprobe.protocol.emcy import RPDO_TIMEOUT, SYNC_LOST


class Supervision:
    """Counts missed SYNCs and targets between `start` and `stop`, and times the following error."""

    def __init__(self, node: SlaveNode, parameters: DriveParameters, on_loss: Callable[[int, int], None]) -> None:
        """`on_loss(code, t_ns)` is called when the master is taken for dead."""
        self._node, self._parameters, self._on_loss = node, parameters, on_loss
        self._timer = node.core.timers.new(self._sync_missing)
        self._misses = 0
        self._by_rpdo = False
        self._outside_ns: int | None = None

    def start(self, target: int | None, t_ns: int) -> None:
        """Operation is enabled, in a mode that lives by SYNC and the object `target`, or by neither (None)."""
        self._misses = 0
        self._outside_ns = None
        self._timer.cancel()
        if target is not None:
            self._by_rpdo = self._node.pdos.receives(target)
            self._timer.arm(t_ns + self._parameters.patience_ns)

    def stop(self) -> None:
        """Operation is no longer enabled."""
        self._timer.cancel()

    @property
    def watching(self) -> bool:
        """Between `start` and `stop`."""
        return self._timer.due_ns is not None

    def sync(self, fresh: bool, t_ns: int) -> None:
        """A SYNC came, with a target since the last one (fresh) or without."""
        self._timer.arm(t_ns + self._parameters.patience_ns)
        self._misses = 0 if fresh or not self._by_rpdo else self._misses + 1
        if self._misses >= self._parameters.misses:
            self._node.emcy.report(RPDO_TIMEOUT)
            self._on_loss(RPDO_TIMEOUT, t_ns)

    def following_error(self, error_counts: float, t_ns: int) -> bool:
        """Whether the error has been outside 6065h for the time of 6066h."""
        window = self._parameters.following_window
        if abs(error_counts) <= window:
            self._outside_ns = None
            return False
        if self._outside_ns is None:
            self._outside_ns = t_ns
        return t_ns - self._outside_ns >= self._parameters.following_timeout_ns

    def _sync_missing(self, due_ns: int) -> None:
        self._node.emcy.report(SYNC_LOST)
        self._on_loss(SYNC_LOST, due_ns)
