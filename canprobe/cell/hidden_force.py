"""How long the force has been more than what the array tells."""

from __future__ import annotations


class HiddenForce:
    """Times an unbroken run of samples whose force is only a lower bound.

    Attributes:
        hidden_s: how long the run is, s; 0 outside one.
    """

    __slots__ = ("_since_ns", "hidden_s")

    def __init__(self) -> None:
        self.hidden_s = 0.0
        self._since_ns: int | None = None

    def add(self, hidden: bool, t_ns: int) -> None:
        """Take one sample.

        Args:
            hidden: its force is only a lower bound, and nothing else tells the true one.
            t_ns: when it was taken.
        """
        if not hidden:
            self._since_ns, self.hidden_s = None, 0.0
        elif self._since_ns is None:
            self._since_ns = t_ns
        else:
            self.hidden_s = (t_ns - self._since_ns) * 1e-9
