"""A cell that cannot keep its deadlines: counted, told, and the contact moves on with the time."""

from __future__ import annotations

import re

import numpy as np
import pytest
from wrapped import Wrapped

import canprobe
from canprobe.cell.controller import Command, Measurement
from canprobe.results.summary import summarise
from canprobe.session.session import Session
from canprobe.tasks.from_plan import make_task

STALL_NS = 8_000_000
EVERY = 40


class Stalls(Wrapped):
    """A controller that now and then takes longer than three cycles, in virtual time."""

    def __init__(self, session: Session, every: int) -> None:
        super().__init__(make_task(session.plan))
        self._session, self._every = session, every

    def step(self, measurement: Measurement) -> Command:
        command = self.task.step(measurement)
        if measurement.cycle % self._every == self._every - 1:
            bus = self._session.lockstep
            assert bus is not None
            bus.clock.sleep_until_ns(bus.clock.now_ns() + STALL_NS)
        return command


@pytest.fixture(scope="module")
def stalled() -> tuple[Session, Stalls]:
    scene = canprobe.load_scene("cylinder", {"task.duration_s": 2.0})
    session = Session(scene)
    controller = Stalls(session, EVERY)
    with session:
        session.run(controller)
    return session, controller


def test_overruns_are_counted_and_the_rate_is_the_true_one(stalled: tuple[Session, Stalls]) -> None:
    session, controller = stalled
    cycle = summarise(session, controller.record(), {}, None)["cycle"]
    assert cycle["overruns"] == pytest.approx(cycle["cycles"] / EVERY, rel=0.15)  # none while bringing up and stopping
    lost = 2 * cycle["overruns"]  # the stall swallows the rest of its own period and two more
    assert cycle["rate_hz"] == pytest.approx(400.0 * cycle["cycles"] / (cycle["cycles"] + lost), rel=0.01)
    assert cycle["missed_pdos"] == 0


def test_the_nodes_say_that_sync_was_late_and_it_is_told_in_one_line(stalled: tuple[Session, Stalls]) -> None:
    """1.5 periods (1006h) after a SYNC its absence is an EMCY 8100h; the next SYNC ends that error (1001h)."""
    session, controller = stalled
    overruns = summarise(session, controller.record(), {}, None)["cycle"]["overruns"]
    (told,) = session.cell.faults
    times = re.fullmatch(
        r"nodes 1-6, 16: EMCY 8100h, communication, (\d+) times, first at [\d.]+ s, last at [\d.]+ s", told
    )
    assert times is not None and int(times[1]) == session.cell.supervisor.counts["emcy_communication"]
    assert overruns / 2 <= int(times[1]) / 7 <= overruns, "the inhibit time (1015h) lets a node send ten a second"
    assert session.world is not None and not any(node.dictionary.number(0x1001) for node in session.world.nodes)


def test_the_contact_keeps_its_speed_and_the_surface(stalled: tuple[Session, Stalls]) -> None:
    session, controller = stalled
    assert controller.task.scan_cycles is not None
    first, last = controller.task.scan_cycles
    contact = summarise(session, controller.record(), {}, None)["contact"]
    assert contact["contact_fraction"] == 1.0
    assert contact["force_max_n"] < 3.0
    t, points = session.truth["t_s"], session.truth["contact_point"]
    steady = slice(first + 60, last - 60)
    path = np.linalg.norm(np.diff(points[steady], axis=0), axis=1).sum()
    assert path / (t[steady][-1] - t[steady][0]) == pytest.approx(0.025, rel=0.02)
