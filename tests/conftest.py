"""Plumbing of the whole suite: tests marked `vcan` run on a real SocketCAN interface, in a guest machine if need be.

Where this kernel has a vcan0, they simply run. Elsewhere one `canprobe vcan -- python -m pytest ...` runs all of them,
and each one's outcome there, with its duration and failure text, becomes its outcome here. Where no vcan can be had
they are skipped, and the summary says what to type. Folders of tests are shared between the processors (`sharing`):
the vcan tests, one after the other, are the share of one worker, which waits for the guest on a processor of its own.

What takes long is `slow`, with its reason: `python -m pytest` leaves it out, `-m ''` runs it, too, and `--collect-only
-q -n0 -m slow` lists it. A test that keeps time without a vcan0 is `realtime`. No verdict hangs on a busy machine:
`standstill` judges what keeps time, and `patience` stretches the time-outs.

    CANPROBE_NO_SKIPS=1   a test that is skipped has failed, unless its reason is one of `ALLOWED_SKIPS`
    CANPROBE_INSTALL=1    install the Debian packages that tests use and that are missing, with sudo (`system_packages`)
"""

from __future__ import annotations

import gc
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before numpy: workers share the processors, and matrices are small

import hypothesis
import patience
import progress
import pytest
import sharing
import standstill
import system_packages
from hangup import hangup_heard  # noqa: F401
from plugin_arguments import PLUGINS

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.real.socketcan import check_interface

pytest_plugins = ["pytester", *PLUGINS]

hypothesis.settings.register_profile(
    "canprobe",
    deadline=None,  # no test asserts time
    print_blob=True,
    derandomize="CI" in os.environ,  # the search for new examples is for the desk; a change is judged by the same ones
)
hypothesis.settings.load_profile("canprobe")

ALLOWED_SKIPS = (
    "Skipping benchmark",  # benchmarks are run by themselves: --benchmark-only
    "this kernel has SocketCAN",  # then nothing shows what is said without it, and no command runs in a guest
    "vcan0 carries CAN FD",  # then nothing shows what is said of an interface without it
    "SCHED_FIFO is not permitted",  # a right, which no installation gives
    "a network of its own is not permitted",  # the same
    "ur-rtde has no wheel for this Python",
    "damiao-motor is not at hand",  # it asks for a web server, so it is no package of the tests
    "CANopenNode's source is not at hand",  # without a network; CANOPEN_NODE names clones
)
"""Why a test may be skipped, by the beginning of its reason, where everything that can be installed is installed."""
gc.disable()  # until all tests are collected: what is made meanwhile stays
gc.set_threshold(50_000)  # at Python's 700 a tenth of the suite's time is spent looking for garbage
for _hook in sys.meta_path:  # the package is a plugin of pytest, too, whose asserts would be rewritten: there are few
    if hasattr(_hook, "_must_rewrite"):
        _hook._must_rewrite -= {name for name in _hook._must_rewrite if name.partition(".")[0] == "canprobe"}
_NO_SKIPS = os.environ.get("CANPROBE_NO_SKIPS") == "1"
_CHANNEL = "vcan0"
_INNER = patience.GUEST_FOLDER
_NO_VCAN = 125
_NOT_RUN = "not run for want of a vcan"
_CANPROBE = (sys.executable, "-c", "import sys; from canprobe.cli import main; sys.exit(main())")


@pytest.fixture
def vcan0() -> str:
    """The name of a real SocketCAN interface that is up; the test fails without one."""
    _require_interface()
    return _CHANNEL


def pytest_configure(config: pytest.Config) -> None:
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as a shell starts what runs in the background
        signal.signal(signal.SIGINT, signal.default_int_handler)  # or no child would hear the interrupt of its test
    if folder := os.environ.get(_INNER):
        config.pluginmanager.register(InnerRun(config, Path(folder)))
        return
    if os.environ.get("CANPROBE_INSTALL") == "1" and not sharing.is_worker(config):
        system_packages.install_missing()
    if not _has_interface():
        config.pluginmanager.register(OuterRun(config))


def pytest_sessionstart(session: pytest.Session) -> None:
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if reporter is not None and not sharing.is_worker(session.config):
        session.config.pluginmanager.register(progress.Progress(reporter, lambda: sharing.all_tests(session.config)))


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    return 0 if _INNER in os.environ else sharing.count_workers(config)


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> sharing.ByFile:
    gc.enable()  # workers collect the tests, not this session
    return sharing.ByFile(config, log)


def pytest_configure_node(node: Any) -> None:
    sharing.tell_worker(node.config, node.workerinput)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The vcan tests first and one after the other: no cell on vcan0 meets another test's frames."""
    sharing.longest_first(config, items)
    items.sort(key=lambda item: not _is_vcan(item))
    sharing.list_vcan_tests(config, [item.nodeid for item in items if _is_vcan(item)])
    if forgot := [item.nodeid for item in items if (mark := item.get_closest_marker("slow")) and not _reason(mark)]:
        raise pytest.UsageError(f"a slow test says why: @pytest.mark.slow(reason=...): {', '.join(forgot)}")


def pytest_collection_finish(session: pytest.Session) -> None:
    gc.enable()
    gc.freeze()  # modules and tests stay: no collection need look at them again
    sharing.list_tests(session.config, [item.nodeid for item in session.items])
    if session.config.option.collectonly:
        slow = [(item.nodeid.partition("::")[0], _reason(mark)) for item in session.items
                if (mark := item.get_closest_marker("slow"))]  # fmt: skip
        for (file, reason), count in sorted(Counter(slow).items()):
            print(f"slow: {file}: {count}: {reason}")


def _reason(mark: pytest.Mark) -> str:
    return str(mark.kwargs.get("reason", ""))


@pytest.hookimpl(tryfirst=True, optionalhook=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> bool:
    return patience.set_timer(item, settings)


def pytest_runtest_setup(item: pytest.Item) -> None:
    if _is_vcan(item):
        _require_interface()


def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool | None:
    """Run a test that keeps time with an idle loop beside it; anything else gives way to those."""
    if not _is_vcan(item):
        sharing.give_way(item.config)
        if item.get_closest_marker("realtime") is None:
            return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in standstill.run_protocol(item, nextitem):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_makereport() -> Iterator[Any]:
    return _allowed((yield))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_make_collect_report() -> Iterator[Any]:
    return _allowed((yield))


def _allowed(report: Any) -> Any:
    """The report, of a failure where the test was skipped and may not be."""
    if _NO_SKIPS and report.skipped and not hasattr(report, "wasxfail"):
        reason = str(report.longrepr[2]).removeprefix("Skipped: ")
        if not reason.startswith(ALLOWED_SKIPS):
            report.outcome = "failed"
            report.longrepr = f"skipped, and this is not among ALLOWED_SKIPS of tests/conftest.py: {reason}"
    return report


def pytest_terminal_summary(terminalreporter: Any) -> None:
    for told in standstill.tell(terminalreporter.stats):
        terminalreporter.write_line(told, yellow=True)
    skipped = terminalreporter.stats.get("skipped", ())
    reasons = [dict(getattr(report, "user_properties", ())).get(_NOT_RUN) for report in skipped]  # a file has none
    if why := [reason for reason in reasons if reason is not None]:
        terminalreporter.section("vcan", sep="!", red=True, bold=True)
        terminalreporter.line(f"{len(why)} tests were NOT RUN for want of a vcan. {why[-1]}", red=True)


def _is_vcan(item: pytest.Item) -> bool:
    return item.get_closest_marker("vcan") is not None


def _has_interface() -> bool:
    try:
        check_interface(_CHANNEL)
    except InterfaceError:
        return False
    return True


def _require_interface() -> None:
    try:
        check_interface(_CHANNEL)
    except InterfaceError as error:
        pytest.fail(f"a vcan test needs a real {_CHANNEL}: {error}", pytrace=False)


class InnerRun:
    """The session where the vcan is: run only the tests asked for, and write each report down as it comes."""

    def __init__(self, config: pytest.Config, folder: Path) -> None:
        self._config = config
        self._wanted = set(json.loads((folder / "items.json").read_text()))
        self._reports = (folder / "reports.jsonl").open("a", encoding="utf-8")

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = [item for item in items if item.nodeid in self._wanted]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._reports.write(json.dumps(data, default=str) + "\n")
        self._reports.flush()

    def pytest_unconfigure(self) -> None:
        self._reports.close()


class OuterRun:
    """The session without a vcan: start the inner one for the first vcan test, and report what that one found."""

    def __init__(self, config: pytest.Config) -> None:
        self._config = config
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._reports: dict[str, list[pytest.TestReport]] = {}
        self._lines: Iterator[str] = iter(())

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> bool | None:
        if not _is_vcan(item):
            return None
        if self._process is None:
            self._start(filter(_is_vcan, item.session.items))
        item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
        for report in self._wait_for(item):
            item.ihook.pytest_runtest_logreport(report=report)
        item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
        return True

    @pytest.hookimpl(tryfirst=True, optionalhook=True)
    def pytest_timeout_set_timer(self, item: pytest.Item) -> bool | None:
        """No timer for a vcan test here: the one where the vcan is ends it, and here it would end the session."""
        return _is_vcan(item) or None

    def pytest_unconfigure(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(20)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        if self._folder is not None:
            self._folder.cleanup()

    def _start(self, items: Iterable[pytest.Item]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="canprobe-tests-", ignore_cleanup_errors=True)
        folder = Path(self._folder.name)
        nodeids = [item.nodeid for item in items]
        (folder / "items.json").write_text(json.dumps(nodeids))
        (folder / "reports.jsonl").touch()
        files = dict.fromkeys(nodeid.partition("::")[0] for nodeid in nodeids)
        options = [
            *("-n0", "-m", "vcan", f"--rootdir={self._config.rootpath}", f"--tb={self._config.option.tbstyle}"),
            f"--basetemp={folder / 'tmp'}",  # a guest's root refuses a folder of pytest's that a user has made
        ]
        end_with_us = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []  # however we end
        with (folder / "output").open("wb") as output:
            self._process = subprocess.Popen(
                [*end_with_us, *_CANPROBE, "vcan", "--", sys.executable, "-m", "pytest", *options, *files],
                cwd=self._config.rootpath,
                env={**os.environ, _INNER: str(folder)},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        self._lines = self._follow(folder / "reports.jsonl", self._process)

    def _follow(self, path: Path, process: subprocess.Popen[bytes]) -> Iterator[str]:
        """Yield the lines of a file that grows until the process has ended, which hears of the machine's load."""
        with path.open(encoding="utf-8") as file:
            rest = ""
            while True:
                ended = process.poll() is not None
                rest += file.read()
                while "\n" in rest:
                    line, _, rest = rest.partition("\n")
                    yield line
                if ended:
                    return
                patience.tell_guest(path.parent)
                time.sleep(0.05)

    def _wait_for(self, item: pytest.Item) -> list[pytest.TestReport]:
        """Return the item's reports from the inner session; whatever is missing there is a failure here."""
        mine = self._reports.setdefault(item.nodeid, [])
        for line in self._lines:
            report = self._read(line)
            self._reports.setdefault(report.nodeid, []).append(report)
            if report.nodeid == item.nodeid and report.when == "teardown":
                break
        if mine and mine[-1].when == "teardown":
            return mine
        return [*mine, self._missing(item)]

    def _read(self, line: str) -> pytest.TestReport:
        report = self._config.hook.pytest_report_from_serializable(config=self._config, data=json.loads(line))
        if isinstance(report.longrepr, list):  # a skip's (file, line, reason), which JSON keeps as a list
            report.longrepr = tuple(report.longrepr)
        return report

    def _missing(self, item: pytest.Item) -> pytest.TestReport:
        assert self._process is not None and self._folder is not None
        status = self._process.wait()
        output = (Path(self._folder.name) / "output").read_text(errors="replace")
        if status == _NO_VCAN and not _NO_SKIPS:
            why = output.strip().rpartition("\n")[2]
            path, line, _ = item.location
            report = _report(item, "skipped", (path, (line or 0) + 1, f"Skipped: {why}"))
            report.user_properties = [(_NOT_RUN, why)]
            return report
        tail = "\n".join(output.splitlines()[-40:])
        return _report(item, "failed", f"not reported where the vcan is; that session ended with {status}:\n{tail}")


def _report(item: pytest.Item, outcome: Any, longrepr: Any) -> pytest.TestReport:
    keywords = dict.fromkeys(item.keywords, 1)
    return pytest.TestReport(item.nodeid, item.location, keywords, outcome, longrepr, "setup")
