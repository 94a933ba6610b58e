"""How vcan tests get from this session to the one in the guest and back, with a stand-in for the guest."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parents[1] / "conftest.py"
SUPPORT = CONFTEST.parent / "support"
WORKERS = ("-n", "2", "--dist", "loadfile")
TWO_WORKERS = pytest.mark.slow(reason="the same with two workers, which the suite itself has")
ALLOWED = pytest.mark.slow(reason="another session of pytest, for skips that are allowed")

ADDED = """
_has_interface = lambda: False
_require_interface = lambda: None
_CANPROBE = (sys.executable, {stand_in!r})
system_packages.install_missing = lambda: print("what is missing is installed")
standstill.CALM_S = 0.1
"""

STAND_IN = """
import os, subprocess, sys
kind = os.environ["STAND_IN"]
if kind == "none":
    print("canprobe: vcan: type:  apt-get install -y something")
    sys.exit(125)
print("arguments", sys.argv[1:])
with open("started", "a") as file:
    print(sys.argv, file=file)
sys.exit(subprocess.call(sys.argv[sys.argv.index("--") + 1 :], env={**os.environ, "INSIDE": "1"}))
"""

TESTS = """
import os
import pytest

pytestmark = pytest.mark.vcan

@pytest.mark.parametrize("n", [1, 2])
def test_inside(vcan0, n, tmp_path):
    assert (vcan0, os.environ["INSIDE"]) == ("vcan0", "1")
    assert tmp_path.is_relative_to(os.environ["CANPROBE_TEST_VCAN_FOLDER"]), "not one that another user may own"

def test_bad(vcan0):
    print("said before")
    assert vcan0 == "vcan1"

def test_skipped():
    pytest.skip("for its own reason")

@pytest.mark.xfail
def test_expected():
    assert False

@pytest.fixture
def broken():
    raise RuntimeError("broken fixture")

def test_error(broken):
    pass

def test_exits():
    if os.environ["STAND_IN"] == "dies":
        os._exit(3)

def test_after():
    pass
"""

HANGS = """
import threading
import pytest

pytestmark = pytest.mark.vcan

@pytest.mark.timeout(0.2)
def test_hangs(vcan0):
    threading.Event().wait()

def test_goes_on(vcan0):
    pass
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    stand_in = tmp_path / "stand_in.py"
    stand_in.write_text(STAND_IN)
    (tmp_path / "conftest.py").write_text(CONFTEST.read_text() + ADDED.format(stand_in=str(stand_in)))
    (tmp_path / "test_it.py").write_text(TESTS)
    more = "import pytest\n\n@pytest.mark.vcan\ndef test_more(vcan0):\n    assert vcan0\n"
    (tmp_path / "test_more.py").write_text(more)
    (tmp_path / "test_native.py").write_text("import os\ndef test_outside():\n    assert 'INSIDE' not in os.environ\n")
    ini = f"[pytest]\nmarkers =\n    vcan: stand-in\naddopts = -p no:cacheprovider\npythonpath = {SUPPORT}\n"
    (tmp_path / "pytest.ini").write_text(ini)
    return tmp_path


def run(project: Path, *arguments: str, **environment: str) -> tuple[int, str]:
    root = str(CONFTEST.parents[1])
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("CANPROBE_", "CI", "PYTEST_"))}
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-rA", *arguments],
        cwd=project,
        env={**clean, "PYTHONPATH": root, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def counts(output: str) -> dict[str, int]:
    last = output.strip().splitlines()[-1]
    return {word.rstrip("s"): int(number) for number, word in re.findall(r"(\d+) ([a-z]+)", last)}


@pytest.mark.parametrize("workers", [(), pytest.param(WORKERS, marks=TWO_WORKERS)], ids=["one session", "workers"])
def test_outcomes_and_texts_come_back(project: Path, workers: tuple[str, ...]) -> None:
    """One that hangs fails by the timer where the vcan is, and the next goes on."""
    (project / "test_hangs.py").write_text(HANGS)
    status, output = run(project, *workers, STAND_IN="runs", CANPROBE_INSTALL="1")
    assert status == 1
    assert counts(output) == {"passed": 7, "failed": 2, "skipped": 1, "xfailed": 1, "error": 1}
    assert output.count("what is missing is installed") == 1, "CANPROBE_INSTALL=1 installs, once"
    assert (project / "started").read_text().count("'pytest'") == 1, "one guest for all files"
    for text in ("assert 'vcan0' == 'vcan1'", "said before", "for its own reason", "RuntimeError: broken fixture"):
        assert text in output
    assert "threading.Event().wait()" in output and "Timeout (>0.2s)" in output


def test_selection_goes_in(project: Path) -> None:
    status, output = run(project, "test_it.py::test_inside[2]", "test_it.py::test_after", STAND_IN="runs")
    assert (status, counts(output)) == (0, {"passed": 2})


def test_what_the_inner_session_never_reported_is_an_error(project: Path) -> None:
    status, output = run(project, "-k", "inside or exits or after", STAND_IN="dies")
    assert (status, counts(output)) == (1, {"passed": 2, "error": 2, "deselected": 6})
    assert "not reported where the vcan is; that session ended with 3" in output


@pytest.mark.parametrize(
    ("required", "expected", "workers"),
    [("", {"passed": 1, "skipped": 9}, ()), pytest.param("1", {"passed": 1, "error": 9}, WORKERS, marks=TWO_WORKERS)],
    ids=["one session", "workers"],
)
def test_without_a_vcan_they_are_skipped_loudly_or_fail(
    project: Path, required: str, expected: dict[str, int], workers: tuple[str, ...]
) -> None:
    status, output = run(project, *workers, STAND_IN="none", CANPROBE_NO_SKIPS=required)
    assert (status, counts(output)) == (1 if required else 0, expected)
    assert "apt-get install -y something" in output
    assert ("9 tests were NOT RUN" in output) == (not required)


SKIPPED = """
import pytest

@pytest.mark.skipif(True, reason="no chromium here")
def test_marked():
    pass

@pytest.fixture
def tool():
    pytest.skip("no tshark here")

def test_told_by_a_fixture(tool):
    pass

@pytest.mark.parametrize("reason", ["vcan0 carries CAN FD here", "this kernel has SocketCAN"])
def test_allowed(reason):
    pytest.skip(reason)

@pytest.mark.xfail
def test_expected():
    assert False
"""


@pytest.mark.parametrize(
    ("strict", "workers", "status", "expected"),
    [
        pytest.param("", (), 0, {"passed": 1, "skipped": 6, "xfailed": 1}, marks=ALLOWED),
        (
            "1",
            ("--continue-on-collection-errors",),
            1,
            {"passed": 1, "skipped": 2, "xfailed": 1, "failed": 1, "error": 3},
        ),
        pytest.param(
            *("1", WORKERS, 1, {"passed": 1, "skipped": 2, "xfailed": 1, "failed": 1, "error": 3}), marks=TWO_WORKERS
        ),
    ],
    ids=["allowed", "one session", "workers"],
)
def test_a_skip_whose_reason_is_not_listed_is_a_failure_where_all_is_installed(
    project: Path, strict: str, workers: tuple[str, ...], status: int, expected: dict[str, int]
) -> None:
    """By a mark, by a fixture, of a whole file, and by a test where the vcan is."""
    (project / "test_skipped.py").write_text(SKIPPED)
    (project / "test_file.py").write_text("import pytest\npytest.importorskip('no_such_package')\n")
    words = ("test_it.py::test_skipped", "test_skipped.py", "test_file.py", "test_native.py")
    ended, output = run(project, *words, *workers, STAND_IN="runs", CANPROBE_NO_SKIPS=strict)
    assert (ended, counts(output)) == (status, expected), output
    for reason in ("no chromium here", "no tshark here", "could not import 'no_such_package'", "for its own reason"):
        assert (f"not among ALLOWED_SKIPS of tests/conftest.py: {reason}" in output) == bool(strict)


STANDSTILL = """
import ctypes

import pytest

pytestmark = pytest.mark.vcan
tries = []

def stand_still():
    ctypes.PyDLL(None).usleep(400_000)  # no other thread runs meanwhile: PyDLL keeps the interpreter's lock

@pytest.fixture(scope="module")
def shared():
    tries.append("set up")

def test_in_which_the_machine_stood_still(vcan0, shared):
    if len(tries) == 1:
        stand_still()
        pytest.fail("a time-out")
    assert tries == ["set up"] * 2, "made anew"

def test_that_fails_by_itself(vcan0, shared):
    tries.append("failed")
    print("tries:", *tries)
    assert False

def test_that_fails_at_every_standstill(vcan0, shared):
    stand_still()
    pytest.fail("a time-out")
"""


@pytest.mark.parametrize(
    ("ci", "expected"),
    [
        ({}, {"passed": 1, "failed": 1, "skipped": 1}),
        pytest.param({"CI": "1"}, {"passed": 1, "failed": 2}, marks=pytest.mark.slow(reason="as CI judges it")),
    ],
)
def test_a_failure_in_a_standstill_is_tried_once_more_and_told(
    project: Path, ci: dict[str, str], expected: dict[str, int]
) -> None:
    """Where the machine stands still again nothing is known: a failure in CI, and not judged elsewhere."""
    (project / "test_still.py").write_text(STANDSTILL)
    status, output = run(project, "test_still.py", STAND_IN="runs", **ci)
    assert (status, counts(output)) == (1, expected)
    assert ("standstill: in real time, and not judged: the machine stood still for " in output) == (not ci)
    assert len(re.findall(r"stood_still: repeated after a standstill of the machine of \d+\.\d\d s", output)) == 1
    assert "tries: set up set up failed\n" in output, "once only"
    assert output.count("::test_that_fails_at_every_standstill: repeated") == 1
    assert "by_itself: repeated" not in output
