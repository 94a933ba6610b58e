"""Look at a bus without a cell: list its nodes, give ids to nodes without one, watch a running cell."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from canprobe.cell.master.commission import Commissioned, Wanted, scan_nodes, wanted_by
from canprobe.cell.master.commission import commission as commission_nodes
from canprobe.cell.master.monitor import CellView, Monitor
from canprobe.cell.master.options import Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.hardware import BringUpSettings
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.buses import open_ports
from canprobe.cell.session.links import check_links, expected_of, need_controllers
from canprobe.cell.session.target import Target, open_bus, refuse_virtual
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port

MONITOR_PERIOD_NS = 100_000_000
SILENCE_NS = 1_000_000_000
"""Time without a frame on a bus after which the state of its controller is read."""


def scan(target: Target | Port, *, timeout_s: float | None = None, say: Say = quiet) -> list[dict[str, Any]]:
    """List the nodes that answer or send heartbeats on a bus, with the identity that 1018h gives.

    Args:
        target: the bus, or a port of it, which stays open.
        timeout_s: longest time to one SDO answer; by default that of a bring-up.
        say: called with each warning about the interface's setting.

    Raises:
        InterfaceError: when there is no such interface, or the CAN controller's state explains that no node answers.
    """
    with open_bus(target, say) if isinstance(target, Target) else contextlib.nullcontext(target) as port:
        nodes = scan_nodes(port, timeout_s or BringUpSettings().sdo_s)
    if not nodes and isinstance(target, Target):
        need_controllers(target.interface, {target.channel: port})
    return nodes


def commission(
    target: Target,
    *,
    scene: Scene | None = None,
    assign: Sequence[tuple[tuple[int | None, int | None, int | None, int | None], int]] = (),
    store: bool = True,
    timeout_s: float | None = None,
    say: Say = quiet,
) -> Commissioned:
    """Find the nodes that have no id and give them theirs by LSS (CiA 305).

    Args:
        target: the bus.
        scene: scene whose nodes get their ids, as far as EDS files and serial numbers identify the devices.
        assign: without a scene: ((vendor, product, revision, serial number), node id), None for any number.
        store: whether the devices store their ids.
        timeout_s: longest time to one SDO answer; by default that of the scene, or else of a bring-up.
        say: called with each warning about the interface's setting.

    Raises:
        UsageError: when the scene does not fit.
        BusError: see `canprobe.cell.master.commission.commission`.
        InterfaceError: when there is no such interface, or the CAN controller's state explains that no node answers.
    """
    wanted = [Wanted(node_id, "--assign", numbers) for numbers, node_id in assign]
    if scene is not None:
        on_interface = replace(Target.over(scene), interface=target.interface)
        wanted = wanted_by(make_plan(resolve(on_interface.applied_to(scene))))
    answer_s = timeout_s or (BringUpSettings() if scene is None else scene.bring_up).sdo_s
    with open_bus(target, say) as port:
        done = commission_nodes(port, wanted, must=scene is None, store=store, timeout_s=answer_s)
    if not done.nodes and not done.unconfigured:
        need_controllers(target.interface, {target.channel: port})
    return done


def monitor(scene: Scene, *, duration_s: float | None = None, say: Say = quiet) -> Iterator[CellView]:
    """Watch a running cell ten times a second without sending anything.

    Args:
        scene: scene of the cell.
        duration_s: length of the watch; without end by default.
        say: called with each warning about the interface's setting.

    Yields:
        The view of the cell so far; the same object each time.

    Raises:
        UsageError: when the scene does not fit, or its bus is a lockstep bus, which lives inside one run.
        InterfaceError: when there is no such interface, it was lost, or its controller's state explains its silence.
    """
    refuse_virtual(scene.bus.interface, "monitor")
    plan, clock, interface = make_plan(resolve(scene)), MonotonicClock(), scene.bus.interface
    wanted = {name: replace(expected, frames_at_once=0) for name, expected in expected_of(plan).items()}
    check_links(interface, wanted, say, must=False)
    with open_ports(plan, clock) as ports:
        listener = Monitor(plan)
        start_ns = next_ns = clock.now_ns()
        duration_ns = None if duration_s is None else duration_s * 1e9
        patience_ns = SILENCE_NS if duration_ns is None else min(SILENCE_NS, duration_ns)
        heard_ns = dict.fromkeys(ports, start_ns)
        while duration_ns is None or next_ns < start_ns + duration_ns:
            next_ns += MONITOR_PERIOD_NS
            clock.sleep_until_ns(next_ns)
            for name, port in ports.items():
                if frames := port.drain():
                    listener.push(frames, name)
                    heard_ns[name] = next_ns
                elif next_ns - heard_ns[name] >= patience_ns:
                    need_controllers(interface, {name: port})
                    heard_ns[name] = next_ns  # the state is asked for once a second at most
            yield listener.view(clock.now_ns())
