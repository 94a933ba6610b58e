"""`canprobe vcan` for real: each test boots a user-mode Linux guest, or uses the machine's own vcan if it has one."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from patience import patience_s

from canprobe.fieldbus.bus.real.socketcan import has_socketcan
from canprobe.fieldbus.vcan.child import supervise
from canprobe.fieldbus.vcan.guest import PROGRAM, GuestError, GuestJob, missing_packages

CANPROBE = (sys.executable, "-c", "import sys; from canprobe.cli import main; sys.exit(main())")
ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow(reason="boots a virtual machine for each test")
needs_guest = pytest.mark.skipif(
    bool(missing_packages()), reason=f"no {PROGRAM}; type: apt-get install -y {' '.join(missing_packages())}"
)
needs_vcan = pytest.mark.skipif(
    bool(missing_packages()) and not has_socketcan(), reason="no vcan; type: canprobe vcan --install -- true"
)


def start(folder: Path, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*CANPROBE, "vcan", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


@needs_vcan
def test_streams_are_byte_exact_and_surroundings_are_the_same(tmp_path: Path) -> None:
    folder = tmp_path / "with space and 'quote'"
    folder.mkdir()
    (folder / "out").write_bytes(bytes(range(256)) * 5000 + b"\r\n" + b"x" * 1_000_000)
    (folder / "err").write_bytes(os.urandom(100_000))
    script = (
        'cat out; cat err >&2; pwd > where; printf "%s" "$ODD" > odd; printf "%s|" "$@" > words; sleep 99 & exit 42'
    )
    words = ["-c", "a b", "*", "$HOME", "'", '"', "\\", "", "ä\n", "--"]
    odd = "line\nbreak 'quote' $x \udcff"
    process = start(folder, "--", "sh", "-c", script, "sh", *words, ODD=odd)
    out, err = process.communicate()
    assert process.returncode == 42
    assert out == (folder / "out").read_bytes()
    assert err == (folder / "err").read_bytes()
    assert (folder / "where").read_text() == f"{folder}\n"
    assert (folder / "odd").read_bytes() == os.fsencode(odd)
    assert (folder / "words").read_text() == "".join(f"{word}|" for word in words)


@needs_vcan
def test_without_a_command_a_shell_takes_the_lines_of_standard_input(tmp_path: Path) -> None:
    done = subprocess.run(
        [*CANPROBE, "vcan"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "SHELL": "/bin/sh"},
        input=b"pwd; cat /sys/class/net/vcan0/type; tty; exit 5\n",
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stdout.decode(), done.stderr) == (5, f"{tmp_path}\n280\nnot a tty\n", b"")


@needs_vcan
def test_the_shell_has_the_terminal(tmp_path: Path) -> None:
    """Echo, job control and Ctrl-C are those of a terminal; ours is as before afterwards."""
    ours, theirs = pty.openpty()
    subprocess.run(["stty", "rows", "20", "cols", "77"], stdin=theirs, check=True)
    before = termios.tcgetattr(theirs)
    process = subprocess.Popen(
        [*CANPROBE, "vcan"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT), "SHELL": "/bin/sh", "PS1": "ready> "},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    for answer, typed in (
        (b"ready> ", b"stty size; cat\n"),
        (b"20 77", b"over\n"),
        (b"over\r\nover\r\n", b"\x03"),
        (b"ready> ", b"exit 6\n"),
    ):
        shown = b""
        while answer not in shown:
            shown += os.read(ours, 1000)
        os.write(ours, typed)
    assert process.wait() == 6
    assert termios.tcgetattr(theirs) == before
    os.close(theirs)
    os.close(ours)


@needs_vcan
def test_a_signal_reaches_a_python_command_as_an_interrupt(tmp_path: Path) -> None:
    script = """if True:
        import time, socket
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).bind(("vcan0",))
        try:
            print("ready", flush=True)
            time.sleep(600)
        except KeyboardInterrupt:
            print("interrupted")
            raise SystemExit(6)"""
    process = start(tmp_path, "--", os.path.realpath(sys.executable), "-c", script)
    assert process.stdout is not None
    assert process.stdout.read(6) == b"ready\n"
    process.send_signal(signal.SIGINT)
    assert process.communicate() == (b"interrupted\n", b"")
    assert process.returncode == 6


@needs_vcan
def test_time_out_ends_command_and_guest(tmp_path: Path) -> None:
    process = start(tmp_path, "--timeout", "0.5", "--", "sh", "-c", "echo $$; sleep 600")
    _, err = process.communicate()
    assert process.returncode == 124
    assert b"canprobe: vcan: the command was stopped after 0.5 s" in err


@needs_guest
@pytest.mark.skipif(
    os.geteuid() != 0 or len(os.sched_getaffinity(0)) < 2, reason="--realtime needs root and two processors"
)
def test_a_process_that_only_computes_does_not_hold_the_guest_up(tmp_path: Path) -> None:
    """With --realtime too, where the kernel of the guest must go before the guest's own processes."""
    script = f"{sys.executable} -c 'while True: pass' & sleep 1; kill $!; exit 7"
    process = start(tmp_path, "--realtime", "--timeout", "60", "--", "sh", "-c", script)
    assert (process.communicate()[1], process.returncode) == (b"", 7)


@pytest.mark.skipif(has_socketcan(), reason="this kernel has SocketCAN: the command would not run in a guest")
@needs_guest
def test_a_killed_command_is_told_what_kills_there(tmp_path: Path) -> None:
    process = start(tmp_path, "--", "sh", "-c", "kill -KILL $$")
    _, error = process.communicate(timeout=patience_s(60))
    assert process.returncode == 128 + signal.SIGKILL
    few = int(Path("/proc/sys/vm/max_map_count").read_text()) < 1 << 20
    assert (b"sysctl vm.max_map_count=1048576" in error) == few


@needs_guest
def test_a_guest_that_panics_is_told_from_a_command_that_fails(tmp_path: Path) -> None:
    with (
        GuestJob(["sh", "-c", "echo c > /proc/sysrq-trigger; sleep 600"], os.environ) as job,
        pytest.raises(GuestError, match="the guest ended before the command did: Kernel panic - not syncing") as caught,
    ):
        supervise(job, [], None)
    assert caught.value.started


@needs_guest
def test_leaving_early_ends_the_guest_and_removes_its_files() -> None:
    with GuestJob(["sleep", "600"], os.environ) as job:
        assert job.poll() is None
        folder, process = job._job, job._process
        assert folder.is_dir()
    assert process.returncode is not None
    assert not folder.exists()


@needs_guest
def test_a_folder_that_the_guest_cannot_see_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/dev")
    with pytest.raises(GuestError, match="the working folder /dev does not exist in the guest"):
        GuestJob(["true"], os.environ)
