"""Interface of a bridge's module: its sink, and the context that it gets at its start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.model import BridgeSettings
from canprobe.lab.bridge.sample import Sample


@dataclass(frozen=True, slots=True)
class Context:
    """Plan and settings that a sink gets at its start.

    Attributes:
        plan: plan of the run.
        settings: settings of section `[bridge]`.
        out: folder of the run; None where no files are written.
        send: hands a request (see `canprobe.cell.tasks.requested.RequestedTask`) back to the cell.
    """

    plan: Plan
    settings: BridgeSettings
    out: Path | None
    send: Callable[[dict[str, object]], None]


class Sink(Protocol):
    """One tool at the other end. Its module has `open_sink(context) -> Sink`."""

    @property
    def where(self) -> str:
        """Place of the output, for people: a file, an address."""
        ...

    def start(self, epoch_ns: int) -> None:
        """Take the epoch: time 0 of the samples is `epoch_ns` after the Unix epoch, or 0 in virtual time."""
        ...

    def write(self, sample: Sample) -> None:
        """Take one sample."""
        ...

    def close(self, summary: str | None) -> None:
        """End the output at the end of the run.

        Args:
            summary: content of `summary.json`; None where the cell ended without one.
        """
        ...
