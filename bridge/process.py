"""The cell's side of a bridge: an observer that hands observations to another process and never waits for it.

A crash, a hang or a full queue of that process costs samples, which are counted, and nothing else.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
from collections import deque
from pathlib import Path
from typing import Any

from canprobe.cell.master.observers import Observation
from canprobe.cell.planning.model import Plan
from canprobe.cell.session.child_process import ChildProcess
from canprobe.cell.tasks.requested import Request
from canprobe.errors import ResultsError, UsageError
from canprobe.fieldbus.bus.clock import elapsed_ns, epoch_now_ns
from canprobe.lab.bridge.pipe import Feed, pack_observation

READY_TIMEOUT_S = 60.0
END_TIMEOUT_S = 30.0
"""Longest time for the records in the queue, s, on a slow machine too; an interrupt ends it early."""
CLOSE_TIMEOUT_S = 1.0
"""Longest time for the process to end after its bridge is done, s: a viewer may have stopped reading."""
KILL_TIMEOUT_S = 2.0
LATENCY_S = 0.02
"""Time whose samples one system call sends, s."""
OBSERVATION, END = b"o", b"e"
"""First byte of a record, which names its kind."""


class BridgeProcess(ChildProcess):
    """One bridge in its process.

    Args:
        name: name of the bridge.
        plan: plan of the run.
        out: folder of the run; None where no files are written.
        virtual: whether the run is in virtual time: its feed waits for room, and its time begins at 0.

    Attributes:
        requests: requests of the other tool, oldest first.
    """

    def __init__(self, name: str, plan: Plan, out: Path | None, *, virtual: bool) -> None:
        super().__init__()
        self.name = name
        self.requests: deque[Request] = deque(maxlen=100)
        self._virtual = virtual
        self._takes_requests = name == "ros2" and bool(plan.scene.bridge and plan.scene.bridge.ros2_commands)
        self._epoch: bytes | None = None
        self._told: dict[str, Any] = {}  # what the process's lines say, the newest of each kind
        self._ends_by_ns: int | None = None
        self._text = b""
        self._poll_in = self._batch = max(1, round(LATENCY_S * plan.scene.cycle.rate_hz))
        reader, writer = os.pipe()
        words = [name, str(self.scene_file), *([] if out is None else [str(out.resolve())])]
        self.launch(plan, ["canprobe.lab.bridge.worker", *words], stdin=reader, stdout=subprocess.PIPE)
        os.close(reader)
        assert self.process.stdout is not None
        self._back = self.process.stdout.fileno()
        os.set_blocking(self._back, False)
        self._feed = Feed(writer, batch=self._batch, lossless=virtual)

    def await_ready(self) -> str:
        """Wait until the bridge reports its address, and return it.

        Raises:
            UsageError: when it could not start; with its message.
            ResultsError: when it could not write its file.
        """
        deadline = elapsed_ns() + round(READY_TIMEOUT_S * 1e9)
        while "ready" not in self._told and "error" not in self._told:
            left = _left_s(deadline)
            if left <= 0:
                self._told["error"] = f"not ready after {READY_TIMEOUT_S:g} s"
            elif not self._listen(left):
                self._told["error"] = self.last_words() or "ended before it began"
        if "ready" not in self._told:
            kind = ResultsError if self._told.get("unwritten") else UsageError
            raise kind(f"bridge {self.name}: {self._told['error']}")
        return str(self._told["ready"])

    def observe(self, observation: Observation) -> None:
        """Hand one observation over, or drop it; where commands are allowed, look for one from time to time."""
        if self._epoch is None:
            epoch = 0 if self._virtual else epoch_now_ns() - observation.t_ns
            self._epoch = epoch.to_bytes(8, "little")
        feed = self._feed
        feed.put(OBSERVATION + self._epoch + pack_observation(observation, feed.dropped))
        if self._takes_requests and not feed.broken:
            self._poll_in -= 1
            if self._poll_in <= 0:
                self._poll_in = self._batch
                self._listen(0.0)

    def _listen(self, timeout_s: float) -> bool:
        """Take the lines that came back; False at their end."""
        readable, _, _ = select.select([self._back], [], [], timeout_s)
        if not readable:
            return True
        data = b""
        with contextlib.suppress(BlockingIOError):
            data = os.read(self._back, 1 << 16)
        *lines, self._text = (self._text + data).split(b"\n")
        for line in lines:
            self._take(json.loads(line))
        return bool(data)

    def _take(self, document: dict[str, Any]) -> None:
        self._told |= document
        if "done" in document:
            self._ends_by_ns = elapsed_ns() + round(CLOSE_TIMEOUT_S * 1e9)
        if "request" in document and self._takes_requests:
            try:
                self.requests.append(Request(**document["request"]))
            except (UsageError, TypeError) as error:  # it is not carried out, and the cell goes on
                self._told["error"] = f"refused: {error}"

    # the end

    def status(self) -> dict[str, Any]:
        """Entry of the summary: samples handed over and dropped, the place of the output, and an error."""
        feed, told = self._feed, self._told
        dropped = feed.taken - told["done"] if "done" in told else feed.dropped
        return {"samples": feed.taken, "dropped": dropped, "where": told.get("ready"), "error": told.get("error")}

    def end(self, summary: str | None) -> dict[str, Any]:
        """Hand over the last samples and the summary, and wait for the process, within bounds.

        Args:
            summary: content of `summary.json`, or None.

        Returns:
            `status`, with all losses until the end.
        """
        deadline = elapsed_ns() + round(END_TIMEOUT_S * 1e9)
        try:
            self._feed.flush(_left_s(deadline))
            taken, dropped = self._feed.taken, self._feed.dropped
            self._feed.put(END + (summary or "").encode())
            self._feed.flush(_left_s(deadline))
            self._feed.taken, self._feed.dropped = taken, max(dropped, self._feed.dropped - 1)
            self._feed.close()
            self._wait(deadline)
        finally:
            self.kill()
        return self.status()

    def _wait(self, deadline_ns: int) -> None:
        """Wait until the process has ended, or its time is up."""
        while (left := _left_s(min(deadline_ns, self._ends_by_ns or deadline_ns))) > 0:
            if not self._listen(left):
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self.process.wait(max(left, 0.1))
                break
        if "done" not in self._told and "error" not in self._told:
            code = self.process.poll()
            self._told["error"] = self.last_words() or (
                f"did not end within {END_TIMEOUT_S:g} s" if code is None else f"ended with status {code}"
            )

    def kill(self) -> None:
        """Kill the process and remove its files. Twice is allowed."""
        self._feed.close()
        if self.process.poll() is None:
            self.process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(KILL_TIMEOUT_S)
        if self.process.stdout is not None:
            self.process.stdout.close()
        self.remove()


def _left_s(deadline_ns: int) -> float:
    return max((deadline_ns - elapsed_ns()) * 1e-9, 0.0)
