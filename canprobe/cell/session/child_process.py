"""A process of this package beside the master: its start with a scene, its last message, its removal."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import SAVED_AS
from canprobe.cell.session.folder import write_scene

_PR_SET_PDEATHSIG = 1


def with_our_imports() -> dict[str, str]:
    """Environment in which `python -P -m` imports the same modules as this process, whatever the working folder has."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path)}


def end_with_parent(parent: int, number: int = signal.SIGTERM) -> None:
    """Called in the child: get a signal when the parent is killed. Linux only, a second line of defence.

    Args:
        parent: process id of the parent; if it has ended already, this process gets the signal at once.
        number: number of the signal.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
        if os.getppid() != parent:
            os.kill(os.getpid(), number)


class ChildProcess:
    """A Python module that runs as a process with the scene of a plan.

    It runs in a separate session, so that Ctrl-C reaches only the master, which stops the drives before their process.

    Attributes:
        folder: temporary folder of the process, which `remove` removes.
    """

    def __init__(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="canprobe-"))
        self._errors: IO[bytes] | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def launch(
        self, plan: Plan, words: Sequence[str], *, stdin: int = subprocess.DEVNULL, stdout: int = subprocess.DEVNULL
    ) -> None:
        """Write the scene's files into the folder, as the plan has them, and start the process.

        Args:
            plan: plan with the scene.
            words: module to run, and its arguments.
            stdin, stdout: as for `subprocess.Popen`.
        """
        write_scene(plan, self.folder)
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by remove
        self._process = subprocess.Popen(  # no preexec_fn: fork would make the master's first cycles copy its pages
            [sys.executable, "-P", "-m", *words],
            env=with_our_imports(),
            stdin=stdin,
            stdout=stdout,
            stderr=self._errors,
            start_new_session=True,
        )

    @property
    def scene_file(self) -> Path:
        """Scene file of the process."""
        return self.folder / SAVED_AS

    @property
    def process(self) -> subprocess.Popen[bytes]:
        """The process, once it is started."""
        assert self._process is not None
        return self._process

    @property
    def pid(self) -> int:
        """Process id, once it is started."""
        return self.process.pid

    def last_words(self) -> str:
        """Last line that the process wrote to its standard error; empty without any."""
        if self._errors is None:
            return ""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("canprobe: ") if lines else ""

    def remove(self) -> None:
        """Remove the files of the process, which has ended. Twice is allowed."""
        shutil.rmtree(self.folder, ignore_errors=True)
        if self._errors is not None:
            self._errors.close()
