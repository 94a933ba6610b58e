"""Running a command here: status, output, signals, time-out; and what is said when no vcan can be had."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from canprobe.cli import main
from canprobe.fieldbus.vcan import launch as vcan
from canprobe.fieldbus.vcan.child import LocalJob, caught_signals, supervise
from canprobe.fieldbus.vcan.guest import GuestError, memory_folder


class Scripted:
    """A job that ends at a given poll or when told, and remembers what it was told."""

    def __init__(self, polls: int | None = None, dies_of: int | None = None) -> None:
        self.polls, self.dies_of, self.told, self.status = polls, dies_of, [], None  # type: ignore[var-annotated]

    def poll(self) -> int | None:
        if self.polls is not None and self.status is None:
            self.polls -= 1
            self.status = 5 if self.polls < 0 else None
        return self.status

    def send_signal(self, number: int) -> None:
        self.told.append(number)
        if number == self.dies_of:
            self.status = 128 + number

    def kill(self) -> None:
        self.told.append("kill")


def test_status_signals_and_the_third_one_kills() -> None:
    assert supervise(Scripted(polls=2), [], None) == (5, False)
    job = Scripted(dies_of=signal.SIGTERM)
    assert supervise(job, [signal.SIGINT, signal.SIGTERM], None) == (143, False)
    assert job.told == [signal.SIGINT, signal.SIGTERM]
    job = Scripted()
    assert supervise(job, [signal.SIGINT, signal.SIGINT, signal.SIGINT], None) == (130, False)
    assert job.told == [signal.SIGINT, signal.SIGINT, "kill"]


def test_time_out_terminates_then_kills(monkeypatch: pytest.MonkeyPatch) -> None:
    job = Scripted(dies_of=signal.SIGTERM)
    assert supervise(job, [], 0.0) == (124, True)
    assert job.told == [signal.SIGTERM]
    monkeypatch.setattr("canprobe.fieldbus.vcan.child._GRACE_S", 0.0)
    job = Scripted()
    assert supervise(job, [], 0.0) == (124, True)
    assert job.told == [signal.SIGTERM, "kill"]


@pytest.mark.parametrize(
    ("script", "status"), [("exit 7", 7), ("kill -9 $$", 137), ("exec nosuchprogram", 127), ("sleep 1000 & exit 0", 0)]
)
def test_local_status(script: str, status: int) -> None:
    assert supervise(LocalJob(["sh", "-c", script], os.environ), [], None) == (status, False)


def test_a_signal_to_us_reaches_the_command_and_leaves_us_alive() -> None:
    with caught_signals() as signals:
        job = LocalJob(
            ["sh", "-c", f"trap 'exit 9' INT; kill -INT {os.getpid()}; while :; do sleep 0.01; done"], os.environ
        )
        assert supervise(job, signals, None) == (9, False)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine that has a vcan0, as far as `canprobe vcan` can see."""

    @contextlib.contextmanager
    def way() -> Iterator[tuple[str, list[str]]]:
        yield "here", []

    monkeypatch.setattr(vcan, "has_socketcan", lambda: True)
    monkeypatch.setattr(vcan, "_local_way", way)


@pytest.mark.usefixtures("here")
def test_the_command_line_passes_words_streams_and_status(capfd: pytest.CaptureFixture[str]) -> None:
    script = 'printf "%s|" "$@" "$CANPROBE_VCAN"; echo err >&2; exit 3'
    assert main(["vcan", "--timeout", "600", "--", "sh", "-c", script, "sh", "--json", "a b", "--", "-x", ""]) == 3
    assert capfd.readouterr() == ("--json|a b|--|-x||here|", "err\n")


@pytest.mark.usefixtures("here")
def test_the_command_line_time_out_and_wrong_use(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["vcan", "--timeout", "0.05", "--", "sleep", "1000"]) == 124
    assert "canprobe: vcan: the command was stopped after 0.05 s" in capfd.readouterr().err
    assert main(["vcan", "--timeout", "-1", "--", "true"]) == 2


def test_without_a_command_a_shell_takes_the_lines_of_standard_input() -> None:
    """In a process of its own, whose standard input is a pipe; the keyboard's signals are the shell's."""
    script = """if True:
        import contextlib, sys
        from canprobe.cli import main
        from canprobe.fieldbus.vcan import launch
        launch.has_socketcan = lambda: True
        launch._local_way = lambda: contextlib.nullcontext(("here", []))
        sys.exit(main(["vcan"]))"""
    lines = "for n in 1 2 3; do kill -INT $PPID; done; echo $CANPROBE_VCAN; exit 5\n"
    environment = {**os.environ, "SHELL": "/bin/sh"}
    done = subprocess.run(
        [sys.executable, "-c", script], input=lines, capture_output=True, text=True, env=environment, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (5, "here\n", "")


@pytest.fixture
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine without SocketCAN and without the guest."""
    monkeypatch.setattr(vcan, "has_socketcan", lambda: False)
    monkeypatch.setattr(vcan, "missing_packages", lambda: ["user-mode-linux"])


def test_the_guests_memory_is_where_it_can_be_written_or_it_says_why_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken, small, barred, good = (tmp_path / name for name in ("taken", "small", "barred", "good"))
    taken.write_bytes(b"")
    for folder in (small, barred, good):
        folder.mkdir()

    def statvfs(folder: str) -> SimpleNamespace:
        free, flags = (300 if folder == str(small) else 800), (os.ST_NOEXEC if folder == str(barred) else 0)
        return SimpleNamespace(f_bavail=free, f_frsize=1 << 20, f_flag=flags)

    monkeypatch.setattr("canprobe.fieldbus.vcan.guest.os.statvfs", statvfs)
    bad = [str(tmp_path / "absent"), str(taken), str(small), str(barred)]
    assert memory_folder([*bad, str(good)]) == (str(good), 800 << 20)
    with pytest.raises(GuestError) as caught:
        memory_folder(bad)
    absent, file, full, noexec, advice = str(caught.value).removeprefix("no folder for the guest's memory: ").split(";")
    assert absent.endswith("absent cannot be written (No such file or directory)")
    assert file.endswith("taken cannot be written (Not a directory)")
    assert full.endswith("small has 300 MiB free, of 512") and noexec.endswith("barred is mounted noexec")
    assert "set TMPDIR to a folder that can be written" in advice and not caught.value.started


@pytest.mark.usefixtures("nowhere")
def test_no_vcan_is_125_with_the_line_to_type(capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["vcan", "--", "true"]) == 125
    out, err = capfd.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "on Debian type:" in err and "apt-get install -y user-mode-linux" in err
    assert "modprobe vcan" in err and "--bus udp_multicast --channel ff11::ca --patient" in err


@pytest.mark.usefixtures("nowhere")
def test_install_runs_that_line_updates_once_and_gives_up_clearly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    apt = tmp_path / "apt-get"
    apt.write_text(f'#!/bin/sh\necho "$@" >> {tmp_path}/calls\necho from apt\n[ "$1" = update ]\n')
    apt.chmod(0o755)
    (tmp_path / "sudo").symlink_to("/usr/bin/env")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["vcan", "--install", "--", "true"]) == 125
    install = "install -y user-mode-linux iproute2"  # this PATH has no `ip`
    assert (tmp_path / "calls").read_text().splitlines() == [install, "update", install]
    out, err = capfd.readouterr()
    assert (out, err.count("from apt")) == ("", 3)
    assert f"this failed:  {'' if os.geteuid() == 0 else 'sudo '}apt-get {install}" in err
