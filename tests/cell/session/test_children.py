"""The emulated nodes' process as seen by its master, in virtual time: how long it is waited for, and what is told."""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import canprobe
from canprobe.cell.master.cell import Cell
from canprobe.cell.session.child_process import END_TIMEOUT_S, EmulatorChild
from canprobe.errors import BusError, NodeError
from canprobe.fieldbus.bus.clock import MonotonicClock, VirtualClock
from canprobe.fieldbus.bus.port import Port, nothing
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus, Participant
from canprobe.fieldbus.protocol.frames import Frame


class Nodes(Participant):
    """The nodes of the process: they say nothing until they boot, all but ``silent``."""

    next_deadline_ns: int | None = None

    def __init__(self, boots_ns: int, silent: int | None, beside: Sequence[Frame] = ()) -> None:
        self.next_deadline_ns = boots_ns
        self._silent = silent
        self._beside = tuple(beside)

    def advance(self, t_ns: int) -> list[Frame]:
        self.next_deadline_ns = None
        boot_ups = [(0x700 + node_id, b"\0") for node_id in range(1, 7) if node_id != self._silent]
        return [*self._beside, *boot_ups]


def await_boot_ups(folder: Path, boots_s: float, *, silent: int | None = None, status: int | None = None) -> list[str]:
    """What is told while the process of `free`'s nodes is waited for, at most 60 s."""
    bus = LockstepBus(VirtualClock())
    bus.attach(Nodes(round(boots_s * 1e9), silent))
    return await_on(bus.port(), folder, status)


def await_on(
    port: Port, folder: Path, status: int | None = None, hear: Callable[[int, bytes, int], object] = nothing
) -> list[str]:
    scene = canprobe.load_scene("free")
    scene = replace(scene, bring_up=replace(scene.bring_up, emulated_s=60.0))
    child = EmulatorChild(canprobe.plan(scene), folder, "lockstep")
    child._process = SimpleNamespace(poll=lambda: status, returncode=status)  # type: ignore[assignment]
    child._errors = (folder / "stderr").open("w+b")
    child._errors.write(b"a warning\ncanprobe: vcan0: no such interface\n")
    told: list[str] = []
    try:
        child.await_boot_ups(port, told.append, hear)
    finally:
        child._process = None
        child.end()
    return told


def test_a_machine_that_is_slow_is_waited_for_and_it_is_told(tmp_path: Path) -> None:
    assert await_boot_ups(tmp_path, 5.0) == []
    assert await_boot_ups(tmp_path, 43.0) == [
        f"the emulated nodes are still starting, after {n} s" for n in (10, 20, 30, 40)
    ]


def test_a_node_that_does_not_boot_in_time_is_named_with_the_way_out(tmp_path: Path) -> None:
    told = r"node 4: the emulated node did not boot within 60 s, and its process still runs: .* \[bring_up\] emulated_s"
    with pytest.raises(NodeError, match=told):
        await_boot_ups(tmp_path, 1.0, silent=4)


@pytest.mark.realtime
def test_in_the_background_of_a_script_it_ends_at_once_too(tmp_path: Path) -> None:
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


def test_a_process_that_has_ended_is_not_waited_for(tmp_path: Path) -> None:
    with pytest.raises(BusError, match=r"^vcan0: no such interface$"):
        await_boot_ups(tmp_path, 1e6, status=3)


def test_what_others_send_meanwhile_is_heard_by_the_cell(tmp_path: Path) -> None:
    """A master that begins while the process starts is another master, as one that was there before."""
    bus = LockstepBus(VirtualClock())
    bus.attach(Nodes(1_000_000_000, None, beside=[(0x080, b"")]))
    port = bus.port()
    cell = Cell(canprobe.plan(canprobe.load_scene("free")), port)
    cell.bring_up.listen()
    await_on(port, tmp_path, hear=cell.watch.push)
    sent: list[int] = []
    bus.recorder = lambda can_id, _data, _t_ns: sent.append(can_id)
    with pytest.raises(BusError, match="SYNC from another master: another master is at work here"):
        cell.__enter__()
    assert sent == []
