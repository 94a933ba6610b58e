"""The faults that a drive has found: reported, shown in 603Fh, and forgotten at a fault reset.

Source: CiA 402-2, object 603Fh; CiA 301, "Emergency object".
"""

from __future__ import annotations

from collections.abc import Callable

from canprobe.emulator.node import SlaveNode
from canprobe.protocol.emcy import FOLLOWING_ERROR


class DriveFaults:
    """Codes of the faults that are there.

    Attributes:
        following_error: whether one of them is, for statusword bit 13.
    """

    def __init__(self, node: SlaveNode, detected: Callable[[int], None]) -> None:
        """`detected(t_ns)` starts the fault reaction."""
        self._node, self._detected = node, detected
        self._codes: list[int] = []
        self._injected: list[int] = []
        self._timer = node.core.timers.new(self._find_injected)
        self.following_error = False

    def reset(self) -> None:
        """Power on."""
        self._injected.clear()
        self.forget()

    def find(self, code: int, t_ns: int) -> None:
        """A fault is there."""
        self._codes.append(code)
        self.following_error = self.following_error or code == FOLLOWING_ERROR
        self._node.dictionary.put(0x603F, 0, code)
        self._node.emcy.report(code)
        self._detected(t_ns)

    def inject(self, code: int) -> None:
        """Find a fault at the next `advance`."""
        self._injected.append(code)
        self._timer.arm(self._node.core.now_ns)

    def forget(self) -> None:
        """Fault reset: all are gone."""
        for code in self._codes:
            self._node.emcy.clear(code)
        self._codes.clear()
        self.following_error = False
        self._node.dictionary.put(0x603F, 0, 0)

    def _find_injected(self, due_ns: int) -> None:
        codes, self._injected = self._injected, []
        for code in codes:
            self.find(code, due_ns)
