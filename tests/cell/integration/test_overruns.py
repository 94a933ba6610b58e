"""A cell that cannot keep its deadlines: counted, told, and the contact moves on with the time."""

from __future__ import annotations

import re
from itertools import product

import numpy as np
import pytest
from injected import Injected, altered
from wrapped import Wrapped

import canprobe
from canprobe.cell.master.controller import Command, Measurement
from canprobe.cell.results.summary import summarise
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cli.parser import PATIENT_SYNCS

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
            bus = self._session.buses.lockstep
            assert bus is not None
            bus.clock.sleep_until_ns(bus.clock.now_ns() + STALL_NS)
        return command


@pytest.fixture(scope="module")
def stalled() -> tuple[Session, Stalls]:
    scene = canprobe.load_scene("cylinder", {"task.duration_s": 1.5, "task.clearance_mm": 0.3})
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
    (told,) = session.cell.notes.lines()
    what = r"nodes 1-6, 16: EMCY 8100h, communication \(no SYNC in time\)"
    times = re.fullmatch(what + r", (\d+) times, first at [\d.]+ s, last at [\d.]+ s", told)
    assert times is not None and int(times[1]) == session.cell.supervisor.counts["emcy_communication"]
    assert overruns / 2 <= int(times[1]) / 7 <= overruns, "the inhibit time (1015h) lets a node send ten a second"
    assert session.buses.world is not None and not any(
        node.dictionary.number(0x1001) for node in session.buses.world.nodes
    )


def test_the_contact_keeps_its_speed_and_the_surface(stalled: tuple[Session, Stalls]) -> None:
    session, controller = stalled
    assert controller.task.record().scan_cycles is not None
    first, last = controller.task.record().scan_cycles
    contact = summarise(session, controller.record(), {}, None)["contact"]
    assert contact["contact_fraction"] == 1.0
    assert contact["force_max_n"] < 3.0
    t, points = session.buses.truth["t_s"], session.buses.truth["contact_point_m"]
    steady = slice(first + 60, last - 60)
    path = np.linalg.norm(np.diff(points[steady], axis=0), axis=1).sum()
    assert path / (t[steady][-1] - t[steady][0]) == pytest.approx(0.025, rel=0.02)


# Stalls up to the limit of `--patient`, each with TPDOs lost behind it: the force of the touch stays below its limit.

FIRST, SPACING = 450, 36
STALLS_MS = (15, 45, int((PATIENT_SYNCS - 1) * 2.5))
LOST, JOINTS = (0, 3), ((3,), (1, 2, 3, 4, 5, 6))
EPISODES = [
    (stall_ms, lost, joints)
    for stall_ms, lost, joints in product(STALLS_MS, LOST, JOINTS)
    if lost or joints == JOINTS[0]
]


class PatientScan(Injected):
    """A scan at 25 mm/s whose master is held up again and again, by turns before its SYNC and before its RPDOs."""

    def __init__(self) -> None:
        self.lost: tuple[int, ...] = ()
        changes = {"arm": {"missed_syncs": PATIENT_SYNCS}, "task": {"speed_mm_s": 25.0, "duration_s": 20.0}}
        super().__init__("cylinder", FIRST, lambda _: None, until=SPACING * len(EPISODES), **changes)

    def _run(self):
        for i, node in self.nodes.items():
            altered(node, 0x180 + i, lambda data, i=i: None if i in self.lost else data)
        super()._run()

    def _stall(self, measurement, late_sync):
        number, since = divmod(measurement.cycle - FIRST, SPACING)
        if since == 0 and 0 <= number < len(EPISODES) and number % 2 == late_sync:
            clock = self.session.buses.lockstep.clock
            clock.sleep_until_ns(clock.now_ns() + EPISODES[number][0] * 1_000_000)

    def command(self, measurement, command):
        self._stall(measurement, late_sync=0)
        return command

    def after(self, measurement):
        number, since = divmod(measurement.cycle - FIRST, SPACING)
        within = 0 <= number < len(EPISODES)
        self.lost = EPISODES[number][2] if within and since < EPISODES[number][1] else ()
        self._stall(measurement, late_sync=1)


def test_no_stall_with_lost_tpdos_ends_a_patient_scan_or_presses_harder_than_the_limit() -> None:
    """The true force between each stall and the next, not only the one that the array measured."""
    patient = PatientScan()
    assert patient.error is None
    assert patient.session.cell.cycle.statistics.overruns >= len(EPISODES)
    truth = patient.session.buses.truth
    starts = np.flatnonzero(np.diff(truth["t_s"]) > 9e-3)
    assert len(starts) == len(EPISODES)
    highest = [truth["force_n"][first : first + SPACING + 2].max() for first in starts]
    limit = patient.session.scene.limits.force_max_n
    assert [episode for episode, force in zip(EPISODES, highest, strict=True) if force >= limit] == []
