"""Run a command where a real vcan0 exists: here if there is one or one can be made, else in a guest.

In this order: a vcan0 that is up; one in a network namespace of its own; one made by root and removed afterwards; a
user-mode Linux guest (`canprobe.fieldbus.vcan.guest`). Where a vcan0 is made, a vcan1 is made beside it. The variable
CANPROBE_VCAN shows the command which way was taken: `here`, `namespace`, `link` or `guest`.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.real.link import missing_ip, sudo
from canprobe.fieldbus.bus.real.socketcan import check_interface, has_socketcan
from canprobe.fieldbus.vcan.child import POLL_PERIOD_S, Job, LocalJob, caught_signals, supervise
from canprobe.fieldbus.vcan.guest import GuestError, GuestJob, missing_packages

CHANNEL, SECOND_CHANNEL = "vcan0", "vcan1"
NO_VCAN_STATUS = 125
GUEST_LOST_STATUS = 123
WAY_VARIABLE = "CANPROBE_VCAN"

_MAPPINGS = Path("/proc/sys/vm/max_map_count")
_MIN_MAPPINGS = 1 << 20  # of 4 KiB: more than the guest's memory

_LINK_COMMAND, _SECOND_LINK_COMMAND = (
    f"ip link add dev {name} type vcan && ip link set {name} up" for name in (CHANNEL, SECOND_CHANNEL)
)
_NAMESPACE_COMMAND = f'ip link set lo up; {_LINK_COMMAND} && {_SECOND_LINK_COMMAND} && exec "$@"'


def run_with_vcan(
    command: Sequence[str], *, timeout_s: float | None = None, install: bool = False, realtime: bool = False
) -> int:
    """Run `command` on a machine that has a vcan0, with the same working folder and environment, without stdin.

    Args:
        command: program and arguments; none for the user's shell, which has standard input.
        timeout_s: time that the command may run; the boot of a guest does not count.
        install: whether to install the Debian package of the guest if needed, and iproute2 where `ip` is missing.
        realtime: whether to steady the timing of the guest; see `GuestJob`.

    Returns:
        The command's exit status (128 + n after signal n); 124 after the time-out; 125 if there is no way to a vcan;
        123 if the guest ended before the command. Messages go to stderr.
    """
    shell = not command
    if shell:
        command = [os.environ.get("SHELL") or "/bin/sh"]
    with caught_signals(keyboard=not (shell and has_socketcan())) as signals:
        if has_socketcan():
            with _local_way() as way:
                if way is not None:
                    job = LocalJob([*way[1], *command], {**os.environ, WAY_VARIABLE: way[0]}, shell)
                    return _supervise(job, signals, timeout_s)
        if (status := _check_guest(install)) != 0:
            return status
        try:
            with GuestJob(command, {**os.environ, WAY_VARIABLE: "guest"}, realtime, shell) as guest:
                return _supervise_guest(guest, signals, timeout_s)
        except GuestError as error:
            _say(str(error))
            return GUEST_LOST_STATUS if error.started else NO_VCAN_STATUS


def _check_guest(install: bool) -> int:
    """Check what a guest needs: return 0 where it can be started; else 125, after a message with the line to type."""
    missing = missing_packages()
    if install and missing_ip() is not None:
        missing.append("iproute2")  # for commands in the guest
    if missing:
        line = f"{sudo()}apt-get install -y {' '.join(missing)}"
        if not install:
            return _no_vcan(
                f"this kernel has no vcan, and what the guest that would needs is missing; on Debian type:  {line}"
                f"  elsewhere take a kernel with vcan ({sudo()}modprobe vcan; Ubuntu has it in the package"
                " linux-modules-extra-$(uname -r)), or --bus udp_multicast --channel ff11::ca --patient"
            )
        if not _install(line):
            return _no_vcan(f"this failed:  {line}")
    return 0


def _supervise_guest(job: GuestJob, signals: list[int], timeout_s: float | None) -> int:
    """Wait for the boot, which may be interrupted but does not count as running time, then for the command."""
    while job.poll() is None and not job.started:
        if signals:
            job.kill()
            return 128 + signals[0]
        time.sleep(POLL_PERIOD_S)
    status = _supervise(job, signals, timeout_s)
    if status == 128 + signal.SIGKILL:
        _report_killed()
    job.halt()
    return status


@contextlib.contextmanager
def _local_way() -> Iterator[tuple[str, list[str]] | None]:
    """Yield (name of the way, prefix of the command) of the first way that works on this kernel, or None."""
    namespace = ["unshare", "--net" if os.geteuid() == 0 else "-rn", "--", "sh", "-c", _NAMESPACE_COMMAND, "sh"]
    if _has_vcan():
        yield "here", []
    elif shutil.which("unshare") and _succeeds([*namespace, "true"]):
        yield "namespace", namespace
    elif os.geteuid() == 0 and _succeeds(["sh", "-c", _LINK_COMMAND]):
        made = [CHANNEL, SECOND_CHANNEL] if _succeeds(["sh", "-c", _SECOND_LINK_COMMAND]) else [CHANNEL]
        try:
            yield "link", []
        finally:
            for name in made:
                _succeeds(["ip", "link", "delete", name])
    else:
        yield None


def _has_vcan() -> bool:
    with contextlib.suppress(InterfaceError):
        check_interface(CHANNEL)
        return True
    return False


def _succeeds(command: Sequence[str]) -> bool:
    try:
        return subprocess.run(command, capture_output=True, stdin=subprocess.DEVNULL, check=False).returncode == 0
    except OSError:
        return False


def _install(line: str) -> bool:
    """Run the apt line, after an update if it fails at first; its output goes to stderr."""
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    update = line.partition("install")[0] + "update"
    for attempt in (line, f"{update} && {line}"):
        _say(attempt)
        done = subprocess.run(
            ["/bin/sh", "-c", attempt], stdin=subprocess.DEVNULL, stdout=2, env=environment, check=False
        )
        if done.returncode == 0:
            return not missing_packages()
    return False


def _supervise(job: Job, signals: list[int], timeout_s: float | None) -> int:
    """The exit status of a command that runs; that the time was up is said."""
    status, timed_out = supervise(job, signals, timeout_s)
    if timed_out:
        _say(f"the command was stopped after {timeout_s:g} s")
    return status


def _report_killed() -> None:
    """Report a command that its kernel killed because it could not map another page: the guest maps them one by one."""
    try:
        mappings = int(_MAPPINGS.read_text())
    except (OSError, ValueError):
        return
    if mappings < _MIN_MAPPINGS:
        _say(
            f"the command was killed; a process that holds more than about {mappings // 256} MiB is, as "
            f"vm.max_map_count is {mappings} on this machine; type:  {sudo()}"
            f"sysctl vm.max_map_count={_MIN_MAPPINGS}"
        )


def _no_vcan(why: str) -> int:
    _say(why)
    return NO_VCAN_STATUS


def _say(text: str) -> None:
    print(f"canprobe: vcan: {text}", file=sys.stderr, flush=True)
