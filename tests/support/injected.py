"""A run in lockstep in which something is done to the cell at one cycle, and what came of it."""

from __future__ import annotations

from dataclasses import replace

from wrapped import Wrapped

import canprobe
from canprobe.cell.master.conditions import BY_KEY
from canprobe.cell.master.controller import Command, Controller
from canprobe.cell.master.options import RunOptions
from canprobe.cell.master.supervision import limits_of
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_task
from canprobe.cell.tasks.task import Phase
from canprobe.errors import CanprobeError
from canprobe.fieldbus.bus.port import ControllerState
from canprobe.fieldbus.protocol.cia402 import POWERED_STATES, state_of
from canprobe.fieldbus.tools.faults import Fault
from canprobe.fieldbus.tools.faults.fault import Effect

FREE_CYCLE = 80
"""A cycle in which the arm of `free` moves."""
HOLD_CYCLE = 200
"""A cycle in which `press`, with 200 cycles a second, holds its force."""
SCAN_CYCLE = 440
"""A cycle in which `cylinder`, `plane` and `turntable` scan."""
_SCAN = {"task.clearance_mm": 0.3}
_QUICK = {
    "press": {"cycle.rate_hz": 200.0, "task.clearance_mm": 0.05},
    **dict.fromkeys(("cylinder", "plane", "turntable"), _SCAN),
}


class Injected:
    """A run in which something happens at one cycle; what came of it, and when."""

    def __init__(self, name, at, action, *, until=400, own=False, **changes):
        scene = canprobe.load_scene(name, {"task.duration_s": 3.0} | _QUICK.get(name, {}))
        scene = replace(scene, **{k: replace(getattr(scene, k), **v) for k, v in changes.items()})
        self.frames = []
        self.session = Session(scene, RunOptions(say=self._say, observers=(self._hear,)))
        self.limits = limits_of(self.session.plan)
        self.faulty = self.session.buses.world.make_faulty()
        self.nodes = {node.node_id: node for node in self.faulty.nodes}
        self.task = make_task(self.session.plan)
        self.at, self.action, self.until, self.own = at, action, at + until, own
        self.injected_ns = self.answered_ns = self.error = None
        self.held = 0
        self._run()

    def _say(self, text):
        if text.startswith("lift off"):
            self.answered_ns = self.now()

    def _hear(self, observation):
        self.frames += observation.frames

    def now(self):
        return self.session.buses.lockstep.clock.now_ns()

    def inject(self, text):
        self.faulty.inject(text, self.now())

    def step(self, measurement):
        if measurement.cycle == self.at:
            self.injected_ns = self.now()
            self.action(self)
        if measurement.cycle > self.until:
            return Command(done=True)
        command = Command() if self.own else self.task.step(measurement)
        if self.answered_ns is None and getattr(self.task, "phase", 0) == Phase.RETREAT and self.injected_ns:
            self.answered_ns = self.now()
        return self.command(measurement, command)

    def command(self, measurement, command):
        return command

    def _run(self):
        with self.session:
            try:
                self.session.run(self._controller(), progress=self._progress)
            except (CanprobeError, KeyboardInterrupt, ZeroDivisionError) as error:
                self.error = error
                if self.answered_ns is None:
                    self.answered_ns = self.now()

    def _controller(self):
        controller = Wrapped(Controller() if self.own else self.task)
        controller.step = self.step
        return controller

    def _progress(self, measurement):
        supervisor = self.session.cell.supervisor
        self.held += supervisor.seen.controller_state is ControllerState.PASSIVE
        self.after(measurement)

    def after(self, measurement):
        pass

    def assert_within(self, key):
        """The reaction came after the fault and within the time of the table."""
        limit = BY_KEY[key].within(self.limits)
        assert 0 <= self.answered_ns - self.injected_ns <= limit
        return self

    def assert_counted(self, key):
        """The condition was counted within its time, and the run went on to its end."""
        supervisor = self.session.cell.supervisor
        assert self.error is None
        assert supervisor.counts[key] > 0
        waited = (supervisor.first[key] - self.at) * self.limits.period_ns
        assert 0 <= waited <= BY_KEY[key].within(self.limits)
        return self

    def assert_drives_off(self, but=()):
        for node_id in range(1, 7):
            if node_id not in but:
                word = self.nodes[node_id].node.dictionary.number(0x6041)
                assert state_of(word) not in POWERED_STATES


def send(run, frame):
    """A frame from somebody who is no node of the cell."""
    run.session.buses.lockstep.port().send_batch([frame])


def altered(node, can_id, change):
    """Let a node send an identifier with other data; with None it does not send it."""

    class Altered(Effect):
        name = "altered"

        def frame(self, frame, t_ns):
            if frame[0] != can_id:
                return None
            data = change(frame[1])
            return () if data is None else ((can_id, data),)

    fault = Fault(Altered, node.node_id)
    node.add(fault)
    return fault
