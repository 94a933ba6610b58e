"""A process of this package beside the master, and that of the emulated nodes: start, wait, end on every way out."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.npz import read_npz
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import SAVED_AS
from canprobe.cell.session.folder import write_scene
from canprobe.errors import BusError, NodeError, UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port, nothing
from canprobe.fieldbus.bus.system import system
from canprobe.fieldbus.protocol.frames import HEARTBEAT_BASE


def with_our_imports() -> dict[str, str]:
    """Environment in which `python -P -m` imports the same modules as this process, whatever the working folder has."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(os.path.abspath(path) for path in sys.path)}


ERRORS = "errors.txt"
"""File of the standard error of a process, in its folder."""


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
        self._errors = (self.folder / ERRORS).open("w+b")  # closed by remove
        self._process = subprocess.Popen(  # no preexec_fn: fork would make the master's first cycles copy its pages
            [sys.executable, "-P", "-m", *words],
            env=with_our_imports(),
            stdin=stdin,
            stdout=stdout,
            stderr=self._errors,
            **system.OWN_SESSION,
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

    def last_words(self) -> str:
        """Last line that the process wrote to its standard error; empty without any."""
        if self._errors is None:
            return ""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("canprobe: ") if lines else ""

    def remove(self) -> None:
        """Remove the files of the process, which has ended. Twice is allowed."""
        if self._errors is not None:
            self._errors.close()
        shutil.rmtree(self.folder, ignore_errors=True)


REPORT_EVERY_S = 10.0
END_TIMEOUT_S = 10.0
SERVING_WORD = "serving "
"""Beginning of the line that the process writes when it serves."""
TRUTH_SHARE = 0.2
"""Longest time of the nodes at their end to compute the truth, as a share of the time that they ran."""


class EmulatorChild(ChildProcess):
    """``canprobe emulate`` as a child process.

    Args:
        plan: plan of the nodes.
        out: folder for ``truth.npz``; None uses a temporary one.
        channels: the buses of its nodes.
        truth: whether to record the true values, which grow with time.
        origin_ns: time that is 0 in ``truth.npz``, on the clock that all processes of a machine share.

    Attributes:
        unwritten: why ``truth.npz`` could not be written; None where it could.
    """

    def __init__(
        self, plan: Plan, out: Path | None, channels: Sequence[str], *, truth: bool = True, origin_ns: int = 0
    ) -> None:
        super().__init__()
        self._plan = plan
        self._scene = plan.scene
        self._channels = channels
        self._wants_truth = truth
        self._origin_ns = origin_ns
        self._truth = (out or self.folder) / "truth.npz"
        self.unwritten: str | None = None
        self._clock = MonotonicClock()
        self._started_ns = self._clock.now_ns()

    def start(self) -> None:
        """Start the process."""
        bus, nodes = self._scene.bus, self._scene.emulated_node_ids
        words = [
            *("canprobe", "emulate", str(self.scene_file), "--bus", bus.interface, "--bitrate", str(bus.bitrate)),
            *(word for channel in self._channels for word in ("--channel", f"{channel}={channel}")),
            *("--parent", str(os.getpid())),
        ]
        if nodes:
            words += ["--nodes", ",".join(str(n) for n in nodes)]
        if self._wants_truth:
            words += ["--truth", str(self._truth), "--origin", str(self._origin_ns)]
        self.launch(self._plan, words)

    def await_boot_ups(
        self,
        port: Port,
        say: Callable[[str], None] = lambda _: None,
        hear: Callable[[int, bytes, int], object] = nothing,
    ) -> None:
        """Wait until it serves, and for the boot-up of each of its nodes, as long as the scene allows.

        Args:
            port: port on the nodes' buses.
            say: called every 10 s with how long it has taken.
            hear: gets each frame meanwhile: another master may begin, or a node report an error.

        Raises:
            BusError: when the process ended; with its last message.
            NodeError: when a node did not boot in time.
        """
        waiting = set(self._scene.emulated_node_ids)
        clock = port.clock
        start = clock.now_ns()
        deadline = start + round(self._scene.bring_up.emulated_s * 1e9)
        report = start + round(REPORT_EVERY_S * 1e9)
        while waiting or not self._serves():
            now = clock.now_ns()
            self.raise_ended()
            if now >= deadline:
                allowed = f"within {self._scene.bring_up.emulated_s:g} s, and its process still runs"
                why = f"the emulated node did not boot {allowed}: a busier machine needs a larger [bring_up] emulated_s"
                raise NodeError(min(waiting, default=0), why)
            if now >= report:
                say(f"the emulated nodes are still starting, after {(now - start) * 1e-9:.0f} s")
                report += round(REPORT_EVERY_S * 1e9)
            port.wait(min(deadline, now + 50_000_000))
            for can_id, data, t_ns in port.drain():
                hear(can_id, data, t_ns)
                if data == b"\0":
                    waiting.discard(can_id - HEARTBEAT_BASE)

    def raise_ended(self) -> None:
        """Raise the error with which the process ended; nothing where it runs.

        Raises:
            BusError: it ended.
        """
        if self.process.poll() is not None:
            raise BusError(self.last_words() or f"the emulated nodes ended with status {self.process.returncode}")

    def _serves(self) -> bool:
        """Whether an array of raw frames is served: it sends no boot-up, and the process says so."""
        if self._scene.sensor is None or self._scene.array_is_node or not self._scene.sensor.emulated:
            return True
        return SERVING_WORD.encode() in (self.folder / ERRORS).read_bytes()  # leaves the child's place in it

    def end(self) -> Mapping[str, NDArray[np.float64]]:
        """Stop the process, by stronger signals where it does not end; the plant's truth where it left any."""
        if self._process is not None:
            patience_s = END_TIMEOUT_S + TRUTH_SHARE * (self._clock.now_ns() - self._started_ns) * 1e-9
            for number in system.END_SIGNALS:
                system.end_process(self._process, number)
                with contextlib.suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
                    self._process.wait(patience_s)
                    break
        truth: Mapping[str, NDArray[np.float64]] = {}
        with contextlib.suppress(UsageError):  # none was written, or it was cut off by a full disk
            truth = read_npz(self._truth)
        words = self.last_words()
        self.unwritten = words if words.startswith(str(self._truth)) else None
        self.remove()
        return truth
