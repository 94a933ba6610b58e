"""A bridge's process that crashes, stands still or never begins: the cell runs on, and ends in time."""

from __future__ import annotations

import os
import signal

import pytest

import canprobe
from canprobe.cell.master.observers import Observation
from canprobe.cell.master.options import RunOptions
from canprobe.cell.scene.load import dump_scene, parse_scene
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.requested import Request
from canprobe.errors import ResultsError
from canprobe.lab.bridge import process as process_module


@pytest.fixture
def plan():
    return canprobe.plan(canprobe.load_scene("free", {"task.duration_s": 0.1}))


@pytest.fixture
def bridge(plan, tmp_path, bridge_of):
    one = bridge_of("mcap", plan, tmp_path, virtual=False)
    one.await_ready()
    return one


def pid_of(bridge):
    return bridge._process.pid


def run_cell(plan, *observers):
    from canprobe.cell.tasks.from_plan import make_task

    session = Session(plan.scene, RunOptions(observers=observers))
    with session:
        session.run(make_task(plan))
    return session


def test_a_crash_in_the_middle_of_a_run_costs_samples_only(plan, bridge):
    seen = []

    def crash(observation):
        seen.append(observation)
        if len(seen) == 50:
            os.kill(pid_of(bridge), signal.SIGKILL)
            os.waitpid(pid_of(bridge), 0)

    session = run_cell(plan, crash, bridge)
    status = bridge.end("{}")
    assert session.cell.notes.lines() == [] and session.observers.faults == []
    assert status["samples"] == len(seen) and status["dropped"] >= len(seen) - 50 - bridge._batch
    assert "ended with status" in status["error"]


@pytest.mark.parametrize(("commands", "taken"), [("true", 1), ("false", 0)])
def test_what_comes_back_is_a_command_only_if_it_is_one_and_where_commands_are_allowed(commands, taken, bridge_of):
    scene = parse_scene(dump_scene(canprobe.load_scene("free")) + f"[bridge]\nros2_commands = {commands}\n")
    bridge = bridge_of("ros2", canprobe.plan(scene))
    bridge._back, back = os.pipe()
    asked = ['{"kind": "start", "value": 0}', '{"value": null}', '{"kind": ["stop"]}', "7", '{"kind": "stop"}']
    os.write(back, "".join(f'{{"request": {one}}}\n' for one in asked).encode())
    assert bridge._listen(0.0)
    assert list(bridge.requests) == [Request("stop")] * taken
    os.close(bridge._back)
    os.close(back)


def test_one_that_stands_still_is_left_behind(plan, bridge, monkeypatch):
    """The queue fills, samples are dropped and counted, and the end comes when it was said to come."""
    monkeypatch.setattr(process_module, "END_TIMEOUT_S", 0.1)
    os.kill(pid_of(bridge), signal.SIGSTOP)
    frames = [(0x181, bytes(8), i) for i in range(2000)]
    for i in range(200):  # 12 MB
        bridge.observe(Observation(i, None, None, frames))
    assert bridge.status()["dropped"] > 50
    status = bridge.end("{}")
    assert (status["samples"], status["error"]) == (200, "did not end within 0.1 s")
    assert bridge._process.returncode == -signal.SIGKILL


def test_ctrl_c_on_the_terminal_does_not_reach_it(bridge):
    assert os.getpgid(pid_of(bridge)) != os.getpgid(0)
    os.kill(pid_of(bridge), signal.SIGINT)
    bridge.observe(Observation(0, None, None, [(0x80, b"", 0)]))
    status = bridge.end("{}")
    assert status["error"] is None and (status["samples"], status["dropped"]) == (1, 0)


def test_a_cell_that_vanishes_leaves_a_whole_file(bridge, tmp_path):
    """The writing end closes without a word, as when the master is killed."""
    bridge.observe(Observation(0, None, None, [(0x80, b"", 0)]))
    bridge._feed.flush()
    bridge._feed.close()
    bridge._wait(1 << 62)
    assert (tmp_path / "run.mcap").exists() and bridge.status()["error"] is None


def test_one_that_cannot_begin_stops_the_run_before_anything_is_sent(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    with pytest.raises(ResultsError, match=r"bridge mcap: .*(Not a directory|File exists)"):
        canprobe.run(canprobe.load_scene("free"), out=blocked / "run", bridge=("mcap",), duration_s=0.1)
