"""Sweeps: in order, on any executor, one BLAS thread a process, kept, resumed after whatever ended them."""

from __future__ import annotations

import importlib
import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from patience import patience_s
from waiting import wait_until

from canprobe.errors import StudyError
from canprobe.fieldbus.bus.real.processor import BLAS_THREADS
from canprobe.lab.studies import cell_store as sweep_store
from canprobe.lab.studies import sweep
from canprobe.lab.studies.cell_store import CellStore, as_json, cell_key, model_digest
from canprobe.lab.studies.sweep import Sweep, open_sweep, process_pool

DEMO = '''
"""A study of six cells; what happens in the fourth is set by the environment. Every measurement leaves a line."""
import os, signal, sys
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from canprobe.lab.studies.result import StudyResult
HERE = Path(__file__).parent

@dataclass(frozen=True)
class Case:
    x: int

def measure(case):
    with (HERE / "log").open("a") as log:
        log.write(f"{case.x} {os.getpid()}\\n")
    if case.x == 3:
        fate = os.environ.get("FATE")
        if fate == "raise":
            raise ValueError("three is too many")
        if fate == "die":
            os._exit(1)
        if fate:
            while len((HERE / "out/cells.jsonl").read_text().splitlines()) < 3:
                pass  # for the first three to be kept, or they may rightly be computed again
            os.kill(os.getppid(), getattr(signal, fate))
            signal.pause()
    np.ones((400, 400)) @ np.ones((400, 400))
    return {"square": case.x**2, "threads": len(os.listdir("/proc/self/task")), "deaf": deaf(), "pair": (case.x, np.pi)}

def deaf():
    return signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ())

def run(*, quick, sweep):
    rows = sweep.map(measure, [Case(x) for x in range(6)], model=("lab/studies/sweep.py",))
    return StudyResult("demo", rows, ["done"], {}, lambda path: path.write_bytes(b""), ("square",))

if __name__ == "__main__":
    from types import MappingProxyType
    from canprobe.cli import main
    from canprobe.lab.studies import sweep
    sys.modules["canprobe.lab.studies.demo"] = __import__("demo")
    sweep.STUDIES = MappingProxyType({"demo": "a demonstration"})
    sys.exit(main(["study", "demo", "--out", str(HERE / "out"), "--workers", "1", "--json", *sys.argv[1:]]))
'''


@pytest.fixture
def demo(tmp_path, monkeypatch):
    """The module above, importable here and in every process that is started from here."""
    (tmp_path / "demo.py").write_text(DEMO)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "demo", None)
    del sys.modules["demo"]
    import demo

    yield demo
    sys.modules.pop("demo", None)


def run_demo(folder, fate="", *more):
    """Run the study in a process of its own."""
    path = os.pathsep.join([str(folder), os.path.dirname(os.path.dirname(sweep_store.PACKAGE / "x"))])
    return subprocess.run(
        [sys.executable, str(folder / "demo.py"), *more], env={**os.environ, "FATE": fate, "PYTHONPATH": path},
        capture_output=True, text=True, check=False, timeout=patience_s(60),
    )  # fmt: skip


def measured(folder):
    """The cells measured so far, and by whom."""
    return [tuple(map(int, line.split())) for line in (folder / "log").read_text().splitlines()]


def gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def here(store, said=None):
    """A sweep on threads of this process."""
    return Sweep(lambda: ThreadPoolExecutor(2), store, say=(said if said is not None else []).append)


def test_cells_run_in_processes_of_one_thread_and_are_found_again(demo, tmp_path):
    cells = [demo.Case(x) for x in (2, 0, 1, 2)]
    said, progress = [], []
    before = {name: os.environ.get(name) for name in BLAS_THREADS}
    with open_sweep(tmp_path / "a", say=said.append, progress=lambda *at: progress.append(at), workers=2) as opened:
        answers = opened.map(demo.measure, cells, model=("mechanics/touch",))
        assert [a["square"] for a in answers] == [4, 0, 1, 4]
        assert all(a["threads"] == 1 and a["deaf"] for a in answers)
        assert answers[0]["pair"] == [2, np.pi]  # as JSON gives it, also when it was not read from a file
        assert progress == [(1, 3), (2, 3), (3, 3)]
        assert not any(pid == os.getpid() for _, pid in measured(tmp_path))
    assert {name: os.environ.get(name) for name in BLAS_THREADS} == before
    with open_sweep(tmp_path / "a", say=said.append) as opened:
        assert opened.map(demo.measure, cells, model=("mechanics/touch",)) == answers
        assert "3 of 3 cells are kept" in said[-1]
        assert len(measured(tmp_path)) == 3
    with open_sweep(tmp_path / "a", say=said.append, fresh=True) as opened:
        opened.map(demo.measure, cells[:1], model=("mechanics/touch",))
        assert len(measured(tmp_path)) == 4


def test_any_executor_will_do_and_a_failed_cell_is_named(demo, tmp_path, monkeypatch):
    monkeypatch.setenv("FATE", "raise")
    store = CellStore(tmp_path / "a")
    with pytest.raises(StudyError, match=r'cell \{"x": 3\}: ValueError: three is too many \(demo.py:\d+\)'):
        here(store).map(demo.measure, [demo.Case(x) for x in (0, 1, 3)])
    monkeypatch.setenv("FATE", "")
    again = here(store)
    assert [a["square"] for a in again.map(demo.measure, [demo.Case(x) for x in (0, 1, 3)])] == [0, 1, 9]
    assert [x for x, _ in measured(tmp_path)].count(3) == 2
    store.close()


def test_times_are_taken_one_by_one_and_belong_to_a_machine(demo, tmp_path, monkeypatch):
    store = CellStore(tmp_path / "a")
    here(store).time(demo.measure, [demo.Case(x) for x in (5, 4)])
    assert [x for x, _ in measured(tmp_path)] == [5, 4]
    assert len({pid for _, pid in measured(tmp_path)}) == 1
    other = here(store)
    other.map(demo.measure, [demo.Case(5)])
    other.time(demo.measure, [demo.Case(5)])
    assert len(measured(tmp_path)) == 3
    monkeypatch.setattr("platform.node", lambda: "elsewhere")
    other.time(demo.measure, [demo.Case(5)])
    assert len(measured(tmp_path)) == 4
    store.close()


@pytest.mark.parametrize("study", [*sweep.STUDIES, *(module for module, _ in sweep.FORMS.values())])
def test_the_code_that_a_study_names_is_there(study):
    model_digest(getattr(importlib.import_module(f"canprobe.lab.studies.{study}"), "MODEL", ()))


def test_answers_of_other_code_are_not_taken(monkeypatch, tmp_path):
    (tmp_path / "touch").mkdir()
    (tmp_path / "touch/a.py").write_text("x = 1")
    (tmp_path / "b.py").write_text("y = 1")
    monkeypatch.setattr(sweep_store, "PACKAGE", tmp_path)
    first, both = model_digest.__wrapped__(("touch",)), model_digest.__wrapped__()
    (tmp_path / "b.py").write_text("y = 2")
    assert model_digest.__wrapped__(("touch",)) == first
    assert model_digest.__wrapped__() != both
    (tmp_path / "touch/a.py").write_text("x = 2")
    assert model_digest.__wrapped__(("touch",)) != first
    with pytest.raises(StudyError, match="expected a file or folder of the package, got 'touhc'"):
        model_digest.__wrapped__(("touhc",))
    assert cell_key("m:f", [1], "a") != cell_key("m:f", [1], "b") != cell_key("m:g", [1], "b")


def test_a_worker_with_other_code_is_told(demo, tmp_path, monkeypatch):
    digests = iter(("here", "there"))
    monkeypatch.setattr(sweep, "model_digest", lambda parts: next(digests))
    store = CellStore(tmp_path / "a")
    with pytest.raises(StudyError, match="has another canprobe or numpy"):
        here(store).map(demo.measure, [demo.Case(1)])
    store.close()


@pytest.mark.parametrize(
    "damage", [lambda b: b[:-20], lambda b: b.replace(b'"answer": 1', b'"answer": 7'), lambda b: b + b"\xff\0"]
)
def test_a_damaged_file_is_noticed_and_the_rest_kept(tmp_path, damage):
    store = CellStore(tmp_path)
    for i in range(3):
        store.put(f"key{i}", {"cell": i}, as_json(i))
    store.close()
    store.path.write_bytes(damage(store.path.read_bytes()))
    store = CellStore(tmp_path)
    assert store.damaged == 1
    wrong = [i for i in range(3) if store.answers.get(f"key{i}") != str(i)]
    assert all(store.answers.get(f"key{i}") is None for i in wrong) and len(wrong) <= 1
    said = []
    here(store, said)
    assert "1 damaged lines left out" in said[0]
    for i in wrong:
        store.put(f"key{i}", {"cell": i}, as_json(i))
    store.close()
    store = CellStore(tmp_path)
    assert [store.answers.get(f"key{i}") for i in range(3)] == ["0", "1", "2"]
    store.close()


def test_only_one_study_writes_into_a_folder(tmp_path):
    store = CellStore(tmp_path)
    with pytest.raises(StudyError, match="another study is writing here"):
        CellStore(tmp_path)
    store.close()
    CellStore(tmp_path).close()


@pytest.mark.parametrize(("fate", "status"), [("SIGKILL", -9), ("SIGINT", 130)])
def test_an_ended_sweep_goes_on_where_it_was(demo, tmp_path, fate, status):
    ended = run_demo(tmp_path, fate)
    assert ended.returncode == status, ended.stderr
    assert [x for x, _ in measured(tmp_path)] == [0, 1, 2, 3]
    if status > 0:
        assert "interrupted; finished cells are kept" in ended.stderr
        assert "Traceback" not in ended.stderr
        assert all(gone(pid) for _, pid in measured(tmp_path))  # the workers ended with it
    again = run_demo(tmp_path)
    assert again.returncode == 0, again.stderr
    assert "3 of 6 cells are kept" in again.stderr
    assert [x for x, _ in measured(tmp_path)[4:]] == [3, 4, 5]
    assert [row["square"] for row in json.loads(again.stdout)["rows"]] == [0, 1, 4, 9, 16, 25]


def test_a_dead_worker_is_told(demo, tmp_path):
    ended = run_demo(tmp_path, "die")
    assert ended.returncode == 3
    assert "canprobe: a worker was killed" in ended.stderr
    assert "3 of 6 cells are kept" in run_demo(tmp_path).stderr


def hear_nothing(deaf):
    """What a run makes of SIGTERM: a wish to stop it, after which its worker goes on; makes a file once it is deaf."""
    signal.signal(signal.SIGTERM, lambda *_: None)
    deaf.touch()
    while True:
        signal.pause()


def test_workers_that_do_not_hear_are_ended_too(demo, tmp_path):
    with pytest.raises(KeyError), process_pool(1) as pool:
        pid = pool.submit(os.getpid).result()
        # one runs and up to two are handed over, as the pool's queue takes one more than it has workers
        deaf = [pool.submit(hear_nothing, tmp_path / "deaf") for _ in range(4)]
        wait_until((tmp_path / "deaf").exists, lambda: not deaf[0].done(), deaf[0].exception)
        raise KeyError
    assert gone(pid)
    assert deaf[-1].cancelled()


def test_a_killed_process_leaves_no_worker(tmp_path):
    """Not even one that ignores SIGTERM, as those of a study in the background of a script may."""
    (tmp_path / "script.py").write_text(
        "import os, signal\n"
        "from canprobe.lab.studies.sweep import process_pool\n"
        "if __name__ == '__main__':\n"
        "    with process_pool(1) as pool:\n"
        "        pool.submit(signal.signal, signal.SIGTERM, signal.SIG_IGN).result()\n"
        "        pool.submit(signal.pause)\n"
        "        print('under way', flush=True)\n"
        "        signal.pause()\n"
    )
    process = subprocess.Popen([sys.executable, tmp_path / "script.py"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout.readline() == b"under way\n"
    process.kill()
    process.communicate(timeout=patience_s(60))  # a worker that is left would hold the streams open


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_child_whose_parent_is_gone_before_it_asks_ends_at_once(number):
    command = f"from canprobe.fieldbus.bus.system import system; system.end_with_parent(1 << 22, {int(number)})"
    assert subprocess.run([sys.executable, "-c", command], check=False, timeout=patience_s(60)).returncode == -number
