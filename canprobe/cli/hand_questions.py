"""What a person at the console is asked, and has allowed: nothing moves before a yes, and a stop takes that back."""

from __future__ import annotations

from collections.abc import Callable

from canprobe.errors import UsageError


class Questions:
    """The question that waits, and what the answers until now allow.

    Args:
        left_alone: what the arm does when its drives are disabled, which is said before.
        show: called with each question, and with what else a person is told.
        resume: called where the arm may move again after a stop.

    Attributes:
        asked: the question that waits for an answer, and what is done after a yes; None without one.
        stopped: why the cell was stopped; None where it was not.
        enables: whether the drives are to be enabled.
    """

    def __init__(self, left_alone: str, show: Callable[[str], None], resume: Callable[[], None]) -> None:
        self.left_alone, self.show, self._resume = left_alone, show, resume
        self.asked: tuple[str, Callable[[], None]] | None = None
        self.stopped: str | None = None
        self.enables = self._allowed = False

    def ask(self, question: str, action: Callable[[], None]) -> None:
        """Ask, in the place of a question that waits."""
        self.asked = question, action
        self.show(f"{question} [yes, no]")

    def enable(self) -> None:
        """Have the drives enabled soon; a person is asked before, once in a session.

        Raises:
            UsageError: the cell was stopped.
        """
        self.refuse_stopped()
        if not self._allowed:
            question = "nothing has moved in this session yet: is the arm free to move?"
            self.ask(f"{self.left_alone}\n{question}", self._allow)
        else:
            self.enables = True

    def stop(self, why: str) -> None:
        """Take back what was allowed, and the question that waits."""
        self.stopped, self.asked = why, None
        self._allowed = self.enables = False

    def refuse_stopped(self) -> None:
        """Raises `UsageError` where the cell was stopped."""
        if self.stopped is not None:
            raise UsageError("the cell was stopped; type `reset`")

    def reset(self) -> None:
        """Ask whether the arm may move again after a stop."""
        if self.stopped is None:
            raise UsageError("nothing was stopped")
        question = "may the arm move again? faults are reset"
        self.ask(f"stopped: {self.stopped}\n{self.left_alone}\n{question}", self._go_on)

    def _allow(self) -> None:
        self._allowed = self.enables = True

    def _go_on(self) -> None:
        self.stopped = None
        self._resume()
        self._allow()
