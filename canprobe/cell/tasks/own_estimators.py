"""Estimators of users in the loop: those that are given, and those that other packages offer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from canprobe.cell.scene.plugins import Plugin
from canprobe.errors import CanprobeError, UsageError
from canprobe.mechanics.touch import ContactSample, SurfaceEstimate
from canprobe.mechanics.touch.estimate.gate import Dropped


class OwnEstimator(Protocol):
    """Methods that an estimator of your own needs."""

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""

    def estimate(self) -> SurfaceEstimate | None:
        """The shape at the last contact; None before there is an answer."""


class RenewedEstimator:
    """A user's estimator in the loop: a new one is made after each loss of contact; dropped samples are not counted.

    Args:
        make: function that makes the estimator.
    """

    def __init__(self, make: Callable[[], OwnEstimator]) -> None:
        self._make = make
        self.dropped = Dropped()
        self.reset()

    def reset(self) -> None:
        """Make a new one."""
        inner = self._make()
        self.add, self.estimate = inner.add, inner.estimate


class OfferedEstimator:
    """An estimator of another package, whose errors name it.

    Args:
        plugin: the entry point of a function that takes the settings by name and returns the estimator.
        settings: keyword arguments of that function, those of `make_estimator`.

    Raises:
        SceneError: the package cannot be imported.
        UsageError: the estimator cannot be made.
    """

    def __init__(self, plugin: Plugin, settings: dict[str, Any]) -> None:
        make = plugin.load()
        self._plugin = plugin

        def methods() -> tuple[Callable[[ContactSample], None], Callable[[], SurfaceEstimate | None]]:
            inner = make(**settings)
            return inner.add, inner.estimate

        self._add, self._estimate = self._guarded(methods)

    def add(self, sample: ContactSample) -> None:
        """Take one contact."""
        self._guarded(lambda: self._add(sample))

    def estimate(self) -> SurfaceEstimate | None:
        """The shape at the last contact; None before there is an answer."""
        answer = self._guarded(self._estimate)
        if answer is not None and not isinstance(answer, SurfaceEstimate):
            raise UsageError(f"{self._plugin}: expected a SurfaceEstimate or None from estimate(), got {answer!r:.60}")
        return answer

    def _guarded(self, act: Callable[[], Any]) -> Any:
        try:
            return act()
        except CanprobeError:
            raise
        except Exception as error:  # whatever a foreign package raises; the cell stops for it
            raise UsageError(f"{self._plugin}: {type(error).__name__}: {error}") from error
