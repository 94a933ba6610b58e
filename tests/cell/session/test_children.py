"""The emulated nodes' process as seen by its master, in virtual time: how long it is waited for, and what is told."""

from __future__ import annotations

import signal
from dataclasses import replace
from types import SimpleNamespace

import pytest

import canprobe
from canprobe.cell.master.cell import Cell
from canprobe.cell.session.child_process import END_TIMEOUT_S, EmulatorChild
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.bus.clock import MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant


class Nodes(Participant):
    """The nodes of the process: they say nothing until they boot, all but ``silent``; `beside` comes before that."""

    next_deadline_ns = None

    def __init__(self, boots_ns, silent=None, beside=()):
        self.next_deadline_ns = boots_ns
        self._frames = [*beside, *((0x700 + node_id, b"\0") for node_id in range(1, 7) if node_id != silent)]

    def advance(self, t_ns):
        self.next_deadline_ns = None
        return self._frames


def bus_of(nodes):
    bus = LockstepBus(VirtualClock())
    bus.attach(nodes)
    return bus


def await_boot_ups(port, folder, status=None, hear=nothing):
    """What is told while the process of `free`'s nodes is waited for, at most 60 s."""
    scene = canprobe.load_scene("free")
    scene = replace(scene, bring_up=replace(scene.bring_up, emulated_s=60.0))
    child = EmulatorChild(canprobe.plan(scene), folder, "lockstep")
    child._process = SimpleNamespace(poll=lambda: status, returncode=status)
    child._errors = (folder / "stderr").open("w+b")
    child._errors.write(b"a warning\ncanprobe: vcan0: no such interface\n")
    told = []
    try:
        child.await_boot_ups(port, told.append, hear)
    finally:
        child._process = None
        child.end()
    return told


def test_a_machine_that_is_slow_is_waited_for_and_it_is_told(tmp_path):
    assert await_boot_ups(bus_of(Nodes(43_000_000_000)).port(), tmp_path) == [
        f"the emulated nodes are still starting, after {n} s" for n in (10, 20, 30, 40)
    ]


def test_a_node_that_does_not_boot_in_time_is_named_with_the_way_out(tmp_path):
    told = r"node 4: the emulated node did not boot within 60 s, and its process still runs: .* \[bring_up\] emulated_s"
    with pytest.raises(NodeError, match=told):
        await_boot_ups(bus_of(Nodes(1_000_000_000, silent=4)).port(), tmp_path)


@pytest.mark.realtime
def test_in_the_background_of_a_script_it_ends_at_once_too(tmp_path):
    """A shell without job control starts there with SIGINT ignored, and the nodes' process inherits it."""
    free = canprobe.load_scene("free")
    plan = canprobe.plan(replace(free, bus=replace(free.bus, interface="virtual")))
    child = EmulatorChild(plan, tmp_path, "nodes")
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        child.start()
        clock = MonotonicClock()
        started_ns = clock.now_ns()
        child.end()
    finally:
        signal.signal(signal.SIGINT, before)
    assert clock.now_ns() - started_ns < 0.5e9 * END_TIMEOUT_S


def test_a_process_that_has_ended_is_not_waited_for(tmp_path):
    with pytest.raises(BusError, match=r"^vcan0: no such interface$"):
        await_boot_ups(bus_of(Nodes(10**15)).port(), tmp_path, status=3)


def test_what_others_send_meanwhile_is_heard_by_the_cell(tmp_path):
    """A master that begins while the process starts is another master, as one that was there before."""
    bus, sent = bus_of(Nodes(1_000_000_000, beside=[(0x080, b"")])), []
    port = bus.port()
    cell = Cell(canprobe.plan(canprobe.load_scene("free")), port)
    cell.bring_up.listen()
    await_boot_ups(port, tmp_path, hear=cell.watch.push)
    bus.recorder = lambda can_id, *_: sent.append(can_id)
    with pytest.raises(BusError, match="SYNC from another master: another master is at work here"):
        cell.__enter__()
    assert sent == []
