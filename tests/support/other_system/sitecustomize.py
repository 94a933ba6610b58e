"""A Python that has what Python has on Windows, and nothing of POSIX: modules, functions and signals are hidden.

    PYTHONPATH=tests/support/other_system canprobe run cylinder --bus direct

The imitation shows what is imported or called without being asked for, on a machine where it can be tested. It does not
show how Windows schedules, sleeps or locks; that only a Windows does. Python imports a `sitecustomize` as it starts, so
that child processes are on that system, too. pytest and the standard library stay on this one.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import signal
import socket
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

MODULES = ("fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "readline", "curses")
NAMES: tuple[tuple[Any, tuple[str, ...]], ...] = (
    (os, ("sched_getaffinity", "sched_setaffinity", "sched_getscheduler", "sched_setscheduler", "sched_param")),
    (os, ("SCHED_FIFO", "setpriority", "getpriority", "nice", "getuid", "geteuid", "killpg", "setsid")),
    (os, ("pread", "mkfifo", "getloadavg", "openpty", "O_CLOEXEC", "O_NONBLOCK", "register_at_fork", "fork")),
    (signal, ("SIGHUP", "SIGKILL", "SIGQUIT", "SIGSTOP", "SIGCONT", "SIGUSR1", "SIGUSR2", "SIGPIPE")),
    (signal, ("pthread_sigmask", "SIG_BLOCK", "SIG_SETMASK", "sigwait")),
    (socket, ("AF_UNIX", "AF_CAN", "CAN_RAW", "PF_CAN", "SO_PEERCRED")),
)
STANDARD = (
    *("asyncio", "concurrent.futures.process", "ctypes.util", "http.server", "logging", "multiprocessing.pool"),
    *("multiprocessing.popen_spawn_posix", "platform", "shutil", "subprocess", "uuid"),
)
"""Modules of the standard library that have other ways on Windows: they keep those of this machine."""
TESTS = ("_pytest.compat", "_pytest.tmpdir", "execnet", "platformdirs", "trimesh", "matplotlib.pyplot")


def hide() -> None:
    """Hide all of it from what is imported after this."""
    for name in (*STANDARD, *TESTS) if "PYTEST_VERSION" in os.environ or "pytest" in sys.orig_argv else STANDARD:
        importlib.import_module(name)
    for name in MODULES:
        sys.modules[name] = None  # type: ignore[assignment]  # an import of it fails
    for module, names in NAMES:
        seen = types.ModuleType(module.__name__)
        rest = vars(sys.modules[module.__name__])
        seen.__dict__.update({name: value for name, value in rest.items() if name not in names})
        sys.modules[module.__name__] = seen
    sys.modules["msvcrt"] = _locks()
    sys.modules["platform"].system = lambda: "Windows"  # type: ignore[attr-defined]
    is_there = Path.exists
    Path.exists = lambda self, **more: self.parts[1:2] != ("proc",) and is_there(self, **more)  # type: ignore[assignment]
    there: Any = sys.modules["signal"]
    there.SIGBREAK = there.CTRL_BREAK_EVENT = signal.SIGWINCH
    subprocess.CREATE_NEW_PROCESS_GROUP = 0  # type: ignore[attr-defined]
    open_library = ctypes.CDLL.__init__

    def named(self: Any, name: str | None, *rest: Any, **more: Any) -> None:
        if name is None:
            raise TypeError("bad argument type for built-in operation")  # as Windows says it
        open_library(self, name, *rest, **more)

    ctypes.CDLL.__init__ = named  # type: ignore[method-assign]


def _locks() -> types.ModuleType:
    """The module that locks files there."""
    module = types.ModuleType("msvcrt")
    held: set[tuple[int, int]] = set()

    def locking(fd: int, mode: int, _: int) -> None:
        stat = os.fstat(fd)
        place = (stat.st_dev, stat.st_ino)
        if mode == 0:
            held.discard(place)
        elif place in held:
            raise PermissionError(13, "Permission denied")
        else:
            held.add(place)

    module.LK_NBLCK, module.LK_UNLCK, module.locking = 2, 0, locking  # type: ignore[attr-defined]
    return module


hide()
