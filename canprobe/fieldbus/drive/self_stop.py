"""Reasons for which a drive stops by itself in operation enabled: a silent master, a motor that does not follow.

Source: CiA 402-2, objects 6065h and 6066h; CiA 301, error codes 8100h and 8250h.
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.fieldbus.drive.parameters import DriveParameters
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.emcy import RPDO_TIMEOUT_CODE, SYNC_LOST_CODE


class Supervision:
    """Counts missed SYNCs and targets between `start` and `stop`.

    Attributes:
        outside_ns: time since which the following error has been outside 6065h; None while it is inside.
        watching: whether SYNCs are counted: between `start` and `stop`, in a mode that needs SYNC.
    """

    def __init__(self, node: SlaveNode, parameters: DriveParameters, on_loss: Callable[[int, int], None]) -> None:
        """Make the supervision; `on_loss(code, t_ns)` is called when the master counts as lost."""
        self.watching = False
        self._node, self._parameters, self._on_loss = node, parameters, on_loss
        self._timer = node.core.timers.new(lambda due_ns: self._lose(SYNC_LOST_CODE, due_ns))
        self._misses = 0
        self._by_rpdo = False
        self.outside_ns: int | None = None

    def start(self, target: int | None, t_ns: int) -> None:
        """Start, as operation is enabled in a mode that needs SYNC and the object `target`, or neither (None)."""
        self._misses = 0
        self.outside_ns = None
        self._timer.cancel()
        self.watching = target is not None
        if target is not None:
            self._by_rpdo = self._node.pdos.receives(target)
            if patience_ns := self._parameters.patience_ns:
                self._timer.arm(t_ns + patience_ns)

    def stop(self) -> None:
        """Stop, as operation is no longer enabled."""
        self.watching = False
        self._timer.cancel()

    def sync(self, fresh: bool, t_ns: int) -> None:
        """Count a SYNC, with a target since the last one (fresh) or without."""
        if patience_ns := self._parameters.patience_ns:
            self._timer.arm(t_ns + patience_ns)
        if fresh or not self._by_rpdo:
            self._misses = 0
            return
        self._misses += 1
        if 0 < self._parameters.misses <= self._misses:
            self._lose(RPDO_TIMEOUT_CODE, t_ns)

    def _lose(self, code: int, t_ns: int) -> None:
        self._node.emcy.report(code)
        self._on_loss(code, t_ns)
