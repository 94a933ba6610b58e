"""Where conformance runs: one node behind a port, in lockstep and on vcan0, and nothing but raw frames between.

The summary prints every point of `points.toml` with what became of its tests; any test in this suite that names a point
in its name counts for it.
"""

from __future__ import annotations

import re
import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from sdo_words import SdoWords

from canprobe.fieldbus.bus.clock import MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.real.socketcan import SocketCanPort
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.node.serve import serve
from canprobe.fieldbus.node.slave_node import SlaveNode

MS = 1_000_000
SLACK_MS = 5_000  # on vcan, for one answer; never waited for when all is well


class Heard(NamedTuple):
    can_id: int
    text: str
    t_ns: int


class Bench(SdoWords):
    """A client of one node: sends hex, and says what must come next. After a read all that was sent is served."""

    def __init__(
        self, node: SlaveNode, port: Port, power_on: Callable[[], None], end: Callable[[], None], real_time: bool
    ) -> None:
        self.node_id, self.name = node.node_id, node.name
        self.port, self.power_on, self.end = port, power_on, end
        self.real_time = real_time
        self._slack_ns = SLACK_MS * MS if real_time else 0
        self._heard: list[Heard] = []

    @property
    def now_ns(self) -> int:
        return self.port.clock.now_ns()

    def send(self, can_id: int, text: str = "") -> None:
        self.port.send_batch([(can_id, bytes.fromhex(text))])

    def _take(self) -> None:
        self._heard += [Heard(can_id, data.hex(), t_ns) for can_id, data, t_ns in self.port.drain()]

    def next(self, within_ms: float = 0) -> Heard:
        """The next frame on the bus."""
        until_ns = self.now_ns + round(within_ms * MS) + self._slack_ns
        self._take()
        while not self._heard and self.now_ns < until_ns:
            self.port.wait(until_ns)
            self._take()
        assert self._heard, f"{self.name}: nothing within {within_ms} ms"
        return self._heard.pop(0)

    def expect(self, *frames: tuple[int, str], within_ms: float = 0) -> None:
        """These come next and in this order."""
        assert [self.next(within_ms)[:2] for _ in frames] == list(frames)

    def silence(self, ms: float = 10) -> None:
        """Nothing comes."""
        until_ns = self.now_ns + round(ms * MS)
        while self.now_ns < until_ns:
            self.port.wait(until_ns)
            self._take()
            assert self._heard == []

    def ask(self, text: str) -> str:
        """One SDO request; the next frame must be its answer."""
        self.send(0x600 + self.node_id, text)
        heard = self.next()
        assert heard.can_id == 0x580 + self.node_id, heard
        return heard.text

    def set(self, *orders: tuple[int, int, int, int]) -> None:
        """Downloads that must be accepted."""
        for order in orders:
            assert self.write(*order) == 0, order

    def nmt(self, command: int) -> None:
        self.send(0, bytes((command, self.node_id)).hex())

    def state(self) -> int:
        """NMT state, by guarding; also where SDO is silent."""
        self.send(0x40000700 + self.node_id)
        heard = self.next()
        assert heard.can_id == 0x700 + self.node_id
        return int(heard.text, 16) & 0x7F

    def boot(self) -> Bench:
        self.power_on()
        self.expect((0x700 + self.node_id, "00"))
        return self


def _in_lockstep(node: SlaveNode, stack: ExitStack) -> Bench:
    bus = LockstepBus(VirtualClock(), "conformance")
    return Bench(node, bus.port(), lambda: bus.attach(node), lambda: bus.detach(node), False)


def _on_vcan(node: SlaveNode, stack: ExitStack) -> Bench:
    clock, ended, failures = MonotonicClock(), threading.Event(), []
    master, port = SocketCanPort("vcan0", clock), SocketCanPort("vcan0", clock)

    def run() -> None:
        try:
            serve([([node], port)], ended.is_set)
        except BaseException as error:
            failures.append(error)

    thread = threading.Thread(target=run, name=node.name)

    def end() -> None:
        ended.set()
        if thread.ident is not None:
            thread.join()
        for opened in (port, master):
            opened.close()
        assert failures == []

    stack.callback(end)
    return Bench(node, master, thread.start, end, True)


EACH_ON_VCAN = pytest.mark.slow(reason="each point on a real bus; the default has one of each service there")
ON_BOTH_BUSES = pytest.mark.parametrize(
    "connect", ["lockstep", pytest.param("vcan", marks=pytest.mark.vcan)], indirect=True
)
"""On vcan, too, where not everything is run."""


@pytest.fixture(params=["lockstep", pytest.param("vcan", marks=[pytest.mark.vcan, EACH_ON_VCAN])])
def connect(request: pytest.FixtureRequest) -> Iterator[Callable[[SlaveNode], Bench]]:
    """Put a node on a bus that carries no one else but the bench; it is not powered yet."""
    on_bus = {"lockstep": _in_lockstep, "vcan": _on_vcan}[request.param]
    with ExitStack() as stack:
        yield lambda node: on_bus(node, stack)


# ---------------------------------------------------------------------- the table at the end

_NAME = re.compile(
    r"::test_(?:cia301|cia305|cia402|sensor)(?:_[a-z]+)*?((?:_\d\d)+)(?![^_\[])[^\[]*(?:\[(lockstep|vcan)\b)?"
)
_HERE = "conformance"


def _results(reporter: Any) -> dict[int, dict[str, list[str]]]:
    """Point → column → outcomes."""
    found: dict[int, dict[str, list[str]]] = {}
    for outcome in ("passed", "failed", "skipped"):
        for report in reporter.stats.get(outcome, ()):
            if outcome == "passed" and report.when != "call":
                continue
            if match := _NAME.search(report.nodeid):
                column = match[2] if _HERE in report.nodeid and match[2] else "other tests"
                for number in match[1].strip("_").split("_"):
                    found.setdefault(int(number), {}).setdefault(column, []).append(outcome)
    return found


def _cell(outcomes: list[str]) -> str:
    if not outcomes:
        return "-"
    return next(word for word in ("failed", "passed", "skipped") if word in outcomes)


def pytest_terminal_summary(terminalreporter: Any) -> None:
    results = _results(terminalreporter)
    if not any({"lockstep", "vcan"} & columns.keys() for columns in results.values()):
        return
    terminalreporter.section("conformance of the emulated nodes")
    terminalreporter.line(f"{'no':>2}  {'clause':32} {'input and reaction':66} lockstep vcan    other tests")
    points = tomllib.loads(
        (Path(__file__).parents[1] / "fieldbus" / "conformance" / "points.toml").read_text(encoding="utf-8")
    )
    for number, (clause, what) in points.items():
        columns = results.get(int(number), {})
        others = columns.get("other tests", [])
        words = [f"{_cell(columns.get(name, [])):8}" for name in ("lockstep", "vcan")]
        last = f"{len(others)} {_cell(others)}" if others else "-"
        bad = any("failed" in outcomes for outcomes in columns.values())
        terminalreporter.line(f"{number:>2}  {clause:32} {what:66} {''.join(words)} {last}", red=bad)
