"""Each kind of fault, thrown at a node of a cell in motion, trips the conditions of its row and no others."""

from __future__ import annotations

import pytest
from injected import HOLD_CYCLE, Injected
from judged import rules_raised

from canprobe.cell.emulated.array_faults import CELL_FAULTS
from canprobe.cell.master.conditions import BY_KEY

PASSING = ("reboot", "freeze", "bus-off")
"""Kinds that do something at their end, too."""
CROWDING = ("babble", "burst")
"""Kinds that fill the bus: half as many cycles leave it room for them."""
OUTSIDE = ("no-boot-up", "mode-refused", "homing-lost", *(name for name in CELL_FAULTS if name.startswith("sdo-")))
"""Kinds that no cycle shows: they are thrown in one run."""


def test_the_registry_has_every_kind_once_and_names_conditions_that_there_are():
    assert len(CELL_FAULTS) == 51
    assert {key for kind in CELL_FAULTS.values() for key in kind.conditions} <= set(BY_KEY)
    assert all(kind.what and kind.clause and kind.reaction for kind in CELL_FAULTS.values())


@pytest.mark.parametrize("names", [OUTSIDE, *((name,) for name in CELL_FAULTS if name not in OUTSIDE)], ids=" ".join)
def test_a_kind_trips_the_conditions_that_it_declares(names):
    kind = CELL_FAULTS[names[0]]
    assert all(CELL_FAULTS[name].conditions == kind.conditions for name in names)
    rate_hz = 400.0 if names[0] in CROWDING else 200.0
    scene, node_id, at, until = ("free", 3, round(0.2 * rate_hz), round(0.275 * rate_hz))
    if kind.needs == "array":
        scene, node_id, at, until = ("press", 16, HOLD_CYCLE - 40, 55)  # as soon as the force is there

    def throw(run):
        for name in names:
            run.inject(f"node {node_id}: {name} seed=1" + (" for 35 ms" if name in PASSING else ""))

    run = Injected(scene, at, throw, until=until, cycle={"rate_hz": rate_hz})
    run.assert_drives_off()
    assert set(run.session.cell.supervisor.first) == kind.conditions
    begin_ns = run.injected_ns - run.session.record.origin_ns
    end_ns = begin_ns + 300_000_000  # the second after it, in which a lost drive is waited for, is as all others
    frames = [frame for frame in run.frames if frame[2] <= end_ns]
    assert rules_raised(run.session.plan, frames, charges_ns=[(begin_ns, end_ns)]) == {}
