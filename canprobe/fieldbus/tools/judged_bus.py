"""The master of a test, judged by the log of the test's bus."""

from __future__ import annotations

from canprobe.fieldbus.tools.emulated_bus import EmulatedBus
from canprobe.fieldbus.tools.judge import Judge, read_record
from canprobe.fieldbus.tools.reports import Report, ReportRow, Verdict


class JudgedBus:
    """Judges the master on the bus of a test: rules on what it sent to the nodes that came from EDS files.

    Args:
        bus: the bus.
        bitrate: bit rate, bit/s.
    """

    def __init__(self, bus: EmulatedBus, bitrate: int) -> None:
        self._bus, self._bitrate = bus, bitrate
        self._allowed: set[str] = set()

    def allow(self, *rules: int) -> None:
        """Let findings of these rules pass; `canprobe judge --list` has the numbers."""
        self._allowed |= {f"{rule:02}" for rule in rules}

    def report(self) -> Report:
        """What is to be said of the master until now; faults that were thrown excuse what follows them."""
        self._bus.flush()
        frames = read_record(self._bus.log, self._bus.channel)
        charges_ns = [(span.begin_ns, span.end_ns) for span in self._bus.faulty.spans(self._bus.start_ns)]
        judge = Judge(self._bus.descriptions, bitrate=self._bitrate, charges_ns=charges_ns).hear(frames)
        return judge.report("the master", {"bit rate": f"{self._bitrate} bit/s"}, log=str(self._bus.log))

    def findings(self) -> list[ReportRow]:
        """Rules that found something and are not allowed."""
        rows = self.report().rows
        return [row for row in rows if row.verdict is Verdict.FAIL and row.name[:2] not in self._allowed]
