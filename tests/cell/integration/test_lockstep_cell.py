"""The whole cell on the lockstep bus: bring-up, run, and every way out leaves the drives disabled."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from undrawn import undrawn_run

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.npz import read_npz
from canprobe.cell.planning.measured import expected_messages
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.errors import NodeError, UsageError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.protocol.frames import SYNC_ID, NmtState

SHORT = {"free": 1.0, "listen": 0.5, "press": 0.5}


QUICK = {"task.clearance_mm": 0.05, "cycle.rate_hz": 200.0}
"""Keys with which `press` soon touches."""


def session_of(name, duration_s=1.0):
    return Session(canprobe.load_scene(name, {"task.duration_s": duration_s} | (QUICK if name == "press" else {})))


def assert_safe(session):
    """Every node is pre-operational and every drive without power."""
    for slave in session.buses.world.nodes:
        assert slave.state is NmtState.PRE_OPERATIONAL, slave.name
        if slave.node_id <= 6:
            assert state_of(slave.dictionary.number(0x6041)) not in POWERED_STATES, slave.name


@pytest.mark.parametrize("name", SHORT)
def test_a_scene_runs_as_planned_to_its_end_and_leaves_the_cell_safe(name, tmp_path):
    keys = {"task.duration_s": SHORT[name], "outputs.figures": name == "listen"}
    cell = canprobe.open_cell(name, keys | (QUICK if name == "press" else {}), out=tmp_path)
    with cell:
        result = cell.run(make_task(cell.plan))
    assert cell.session.cell.notes.lines() == []
    assert cell.session.cell.cycle.statistics.overruns == 0
    assert_safe(cell.session)
    seen = {can_id for _, _, can_id, _ in read_candump(tmp_path / "bus.log")}
    assert seen <= {can_id for bus in result.plan.buses for can_id in expected_messages(result.plan, bus)}
    assert {pdo.cob_id for pdo in result.plan.pdos} <= seen
    assert {path.name for path in tmp_path.iterdir()} == set(result.plan.outputs)
    if name == "press":
        contact = result.summary["contact"]
        assert contact["contact_fraction"] == 1.0
        assert contact["force_rms_error_n"] < 0.2
        assert contact["force_max_n"] < 3.0
        assert result.summary["shape"]["method"] is None


def test_same_seed_same_log_other_seed_other_log(tmp_path):
    scene = canprobe.load_scene("press", QUICK)
    logs = []
    for i, seed in enumerate((3, 3, 4)):
        undrawn_run(scene, out=tmp_path / str(i), seed=seed, duration_s=0.1)
        logs.append((tmp_path / str(i) / "bus.log").read_bytes())
    assert logs[0] == logs[1]
    assert logs[0] != logs[2]
    assert logs[0].startswith(b"(0000000000.000056) can0 701#00")


def test_a_controller_behind_an_error_keeps_the_period_and_the_log_has_every_cycle(tmp_path):
    scene = canprobe.load_scene("free", {"bus.timed": False, "outputs.figures": False})

    def fails(measurement):
        raise ArithmeticError("a bug")

    with canprobe.open_cell(scene, out=tmp_path) as cell:
        with pytest.raises(ArithmeticError):
            cell.run(fails)
        cell.run(lambda _: Command(done=True))
        times = cell.session.cell.log.arrays()["t_s"]
    syncs = [t_ns for t_ns, _, can_id, _ in read_candump(tmp_path / "bus.log") if can_id == SYNC_ID]
    assert np.diff(syncs).min() == 2_500_000
    assert np.diff(times).min() > 0.0
    assert len(read_npz(tmp_path / "log.npz")["t_s"]) == len(syncs)


def test_a_node_of_another_make_is_named():
    session = session_of("free")
    nodes = list(session.plan.nodes)
    nodes[4] = replace(nodes[4], identity=replace(nodes[4].identity, product_code=0x999))
    session.plan = replace(session.plan, nodes=tuple(nodes))
    with pytest.raises(NodeError, match=r"node 5: .*product code expected 0x999, got 0x260"), session:
        pass


def test_what_is_no_controller_is_told_before_a_drive_is_enabled():
    session = session_of("free")
    with pytest.raises(UsageError, match=r"measurement or a canprobe\.Controller, got 3"), session:
        session.run(3)
    assert len(session.cell.log) == 0
    assert_safe(session)


def test_a_controller_cannot_write_the_cells_own_columns():
    session = session_of("free")
    with pytest.raises(UsageError, match="expected other columns than the cell's, got t_s"), session:
        session.run(lambda _: Command(columns={"t_s": 0.0}))
    assert_safe(session)


def test_the_log_has_what_was_commanded_whatever_becomes_of_the_controllers_arrays():
    """A controller that writes each target into the same array, and one that writes into the measurement."""
    session = session_of("free")
    target, twice, sent = np.zeros(6), np.zeros(2), []

    def step(measurement):
        target[:] = measurement.q + 1e-4 * np.sin(measurement.cycle)
        twice[:] = measurement.cycle
        sent.append(target.copy())
        with pytest.raises(ValueError, match="read-only"):
            measurement.q[0] = 1.0
        return Command(q_target=target, columns={"twice": twice}, done=len(sent) == 30)

    with session:
        session.run(step)
        log = session.cell.log.arrays()
    rows = np.isfinite(log["twice"][:, 0])
    assert np.array_equal(log["q_target_rad"][rows], sent)
    assert np.ptp(log["twice"][rows][:, 0]) == 29


def test_the_result_of_a_run_can_come_from_another_process():
    """As `multiprocessing` sends it, which is how many seeds are run side by side."""
    result = canprobe.run(canprobe.load_scene("press", QUICK), files=False, duration_s=0.1)
    other = pickle.loads(pickle.dumps(result))
    assert other.summary == result.summary and other.plan.scene == result.plan.scene
    assert other.plan.pdos == result.plan.pdos
    assert np.array_equal(other.log["force_n"], result.log["force_n"], equal_nan=True)
