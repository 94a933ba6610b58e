"""A run without a bus: to the last bit that of a lockstep bus whose frames take no time, and what it leaves out."""

from dataclasses import replace

import pytest

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.session.session import Session
from canprobe.cell.session.up import up
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import NodeError, PlanError, UsageError


def on_both(scene):
    """The closed session of the scene's task without a bus, and on an untimed lockstep bus."""
    for bus in (replace(scene.bus, interface="direct"), replace(scene.bus, timed=False)):
        session = Session(replace(scene, bus=bus))
        with session:
            session.run(make_task(session.plan))
        yield session


def loaded(name, cell=None, duration_s=0.2, **sections):
    keys = {"task.duration_s": duration_s} | ({"cycle.rate_hz": 200.0} if cell is None else {"cell": cell})
    scene = canprobe.load_scene(name, keys)
    return replace(scene, **{key: replace(getattr(scene, key), **keys) for key, keys in sections.items()})


def assert_same(direct, lockstep):
    for ours, theirs in (
        (direct.cell.log.columns(), lockstep.cell.log.columns()),
        (direct.buses.truth, lockstep.buses.truth),
    ):
        assert ours.keys() == theirs.keys()
        assert [name for name in ours if ours[name].tobytes() != theirs[name].tobytes()] == []
    assert len(direct.buses.truth["t_s"]) == len(direct.cell.log) > 30
    assert direct.cell.notes.lines() == lockstep.cell.notes.lines() == []


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(
            loaded("press", task={"clearance_mm": 0.2}, arm={"grouped_rpdo": True}, sensor={"mode": "features"}),
            id="press",
        ),
        pytest.param(loaded("listen", sensor={"mode": "image", "rate_hz": 100.0}), id="listen"),
        pytest.param(loaded("free", "prbt"), id="free of another make"),
        pytest.param(loaded("press", "external", task={"clearance_mm": 0.2}), id="an external arm"),
        pytest.param(loaded("turntable", task={"clearance_mm": 0.2}, shape={"also": ()}), id="a scan on a turntable"),
    ],
)
def test_log_and_truth_are_those_of_an_untimed_lockstep_bus_to_the_last_bit(scene):
    assert_same(*on_both(scene))


def test_a_drive_that_fails_stops_the_cell_with_the_words_of_a_bus():
    words = []
    for interface in ("direct", "lockstep"):
        scene = loaded("free")
        session = Session(replace(scene, bus=replace(scene.bus, interface=interface, timed=False)))

        def fail(measurement, session=session):
            if measurement.cycle == 150:
                session.buses.world.nodes[2].application.inject_fault(0x7500)
            return Command()

        with pytest.raises(NodeError) as stopped, session:
            session.run(fail)
        words.append((str(stopped.value), session.cell.notes.lines()))
    assert words[0] == words[1]
    assert "node 3: EMCY 7500h" in words[0][0]


def test_a_run_says_what_is_left_out_with_the_bus(tmp_path):
    scene = loaded("listen", outputs={"figures": False})
    result = canprobe.run(scene, bus="direct", out=tmp_path)
    assert (result.summary["bus"], result.summary["bus_load"], result.summary["traffic"]) == ("direct", None, None)
    assert any(line.startswith("bus, ") for line in result.summary["left_out"])
    written = {path.name for path in tmp_path.iterdir()}
    assert written == {"summary.json", "log.npz", "tactile.npz", "scene.toml", "truth.npz"}
    assert set(result.plan.outputs) == written


def test_what_needs_a_bus_is_refused():
    with pytest.raises(PlanError, match="has no wire"):
        canprobe.plan(loaded("free", bus={"interface": "direct", "bit_error_rate": 1e-5}))
    with pytest.raises(UsageError, match="there are emulated nodes only: node 1 is marked emulated = false"):
        canprobe.run(loaded("free", bus={"interface": "direct"}, arm={"emulated": False}), files=False)
    with pytest.raises(UsageError, match="up: there is no bus"):
        up(loaded("free", bus={"interface": "direct"}))
