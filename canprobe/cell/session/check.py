"""`canprobe check`: a verdict on link and machine before anything moves."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from typing import Any

from canprobe.cell.master.cell import Cell
from canprobe.cell.master.options import RunOptions, Say, quiet
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import MASTER_NODE_ID, Plan
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session, link_limits
from canprobe.errors import InterfaceError, UsageError
from canprobe.fieldbus.bus.clock import wake_lateness
from canprobe.fieldbus.bus.port import ControllerState, Port, stamps_text
from canprobe.fieldbus.bus.real.adapters import SOCKETCAN
from canprobe.fieldbus.bus.real.link import read_link
from canprobe.fieldbus.bus.real.processor import MASTER_PRIORITY, realtime
from canprobe.fieldbus.protocol.frames import EMCY_BASE, HEARTBEAT_BASE, SDO_RX_BASE, SDO_TX_BASE
from canprobe.fieldbus.tools.link import Fitness, LinkFigures, LinkMeter, LinkVerdict, judge_link
from canprobe.fieldbus.tools.link.figures import IDLE_FAST_NS, quantile, us
from canprobe.fieldbus.tools.link.machine import NOT_AVAILABLE, machine_facts

IDLE_S = 2.0
"""Time of each loop that does nothing."""
MIN_SECONDS = 1.0
SETTLE_S = 0.3
"""Time of cycles before the measurement, until both sides run at their usual speed."""


@dataclass(frozen=True, slots=True)
class LinkReport:
    """The result of a check.

    Attributes:
        scene: name of the scene.
        channels: channels of its buses.
        verdict: the verdict.
        figures: what was measured.
        machine: facts of the machine; empty in virtual time, which has none.
        remarks: what could not be put back in the nodes.
    """

    scene: str
    channels: tuple[str, ...]
    verdict: LinkVerdict
    figures: LinkFigures
    machine: dict[str, str]
    remarks: tuple[str, ...] = ()

    @property
    def fit(self) -> bool:
        """Whether the link is fit for the plan's rate."""
        return self.verdict.fitness is Fitness.FIT

    def as_document(self) -> dict[str, Any]:
        """The report for JSON."""
        return {
            "scene": self.scene,
            "channels": list(self.channels),
            **self.verdict.as_document(),
            "figures": self.figures.as_document(),
            "machine": self.machine or None,
            "remarks": list(self.remarks),
        }

    def text(self) -> str:
        """The report for people."""
        verdict, figures = self.verdict, self.figures.as_document()
        late, load = figures["sync_late_us"], figures["load"]
        lines = [f"{self.scene} on {', '.join(self.channels)}: {verdict.fitness.upper()} for {verdict.rate_hz:g} Hz"]
        if verdict.why:
            lines += [f"  cause    {verdict.why}", f"  do       {verdict.way_out.replace('CHANNEL', self.channels[0])}"]
        best = "none" if verdict.fit_rate_hz is None else f"{verdict.fit_rate_hz:g} Hz"
        lines += [
            f"  fit for  {best}",
            f"  SYNC     late by p50 {_us(late['p50'])}, p99 {_us(late['p99'])}, at most {_us(late['max'])};"
            f" {figures['overruns_percent']:.2f} % overruns in {self.figures.seconds:.0f} s",
        ]
        for node in figures["nodes"]:
            times = node["answer_us"]
            lines.append(
                f"  node {node['node_id']:3d} answers after p50 {_us(times['p50'])}, p99.9 {_us(times['p999'])}, at"
                f" most {_us(times['max'])}; late {node['late']}, absent {node['absent']} of {node['expected']}"
            )
        shown = "not available" if load is None else f"{100 * load:.1f} %"
        planned = "" if figures["planned_load"] is None else f", planned at worst {100 * figures['planned_load']:.1f} %"
        lines.append(
            f"  bus      load {shown}{planned}; frames of others {figures['foreign_hz']:.0f}/s; queue full"
            f" {figures['queue_full']}, dropped {figures['dropped']}, bus errors {figures['error_frames']}"
        )
        rates = ", ".join(f"{rate:g} Hz {100 * share:.2f} %" for rate, share in sorted(verdict.overruns.items()))
        lines.append(f"  overruns {rates}")
        lines += [f"  {name.replace('_', ' '):18} {value}" for name, value in self.machine.items()]
        return "\n".join([*lines, *(f"  warning: {remark}" for remark in self.remarks)])


def _us(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f} µs"


def check(scene: Scene, *, seconds: float = 10.0, say: Say = quiet) -> LinkReport:
    """Measure the link of a cell in the cycle of its plan, with the drives disabled, and judge it.

    The plan's configuration is written, and what was there before is put back. The nodes are not reset.

    Args:
        scene: scene of the cell.
        seconds: length of the measurement, s.
        say: called with each step.

    Returns:
        The report.

    Raises:
        UsageError: the scene does not fit, or has no bus.
        BusError: another master is at work, a drive is under power, or a node does not answer.
    """
    plan = make_plan(resolve(scene))
    if plan.setup.bus.direct:
        raise UsageError("check: there is no bus in --bus direct; name one with --bus")
    if seconds < MIN_SECONDS:
        raise UsageError(f"check: expected at least {MIN_SECONDS:g} s, got {seconds:g}: a verdict needs cycles")
    return measure_link(Session(plan, options_of_check(say)), seconds)


def options_of_check(say: Say = quiet) -> RunOptions:
    """Options of a session whose link is measured."""
    return RunOptions(None, say, to_home=True, to_check=True)


def measure_link(session: Session, seconds: float) -> LinkReport:
    """Measure the link of a session that is not entered yet; see `check`.

    What the session puts `around` its port lies between the meter and the bus.
    """
    plan, around, failure = session.plan, session.around, None
    meters: list[LinkMeter] = []
    idle_ns: dict[int, list[int]] = {}  # lateness of two loops that do nothing but wake, by their periods

    def metered(port: Port) -> Port:
        port = around(port)
        with realtime(MASTER_PRIORITY, quiet) if plan.setup.realtime and not session.virtual else nullcontext():
            for period_ns in (plan.sync.period_ns, IDLE_FAST_NS):
                idle_ns[period_ns] = wake_lateness(port.clock, period_ns, round(IDLE_S * 1e9 / period_ns))
        meters.append(LinkMeter(port, **_traffic(plan)))
        return meters[0]

    session.around = metered
    machine = {} if session.virtual else machine_facts(plan.buses[0].channel)
    with session:
        cell, meter = session.cell, meters[0]
        lateness_ns, first, full, torn = cell.cycles.cycle.statistics.period_error_ns, 0, 0, 0
        session.options.say(f"measure for {seconds:g} s, with the drives disabled")
        try:
            cell.idle(SETTLE_S)
            first, full, torn = len(lateness_ns), meter.counters.transmit_full, _torn(cell)
            meter.begin()
            cell.idle(seconds)
        except InterfaceError as error:
            failure = str(error)
        meter.end()
        counters, load = meter.counters, meter.load(plan.setup.bus.bitrate)
        age = cell.cycles.recorded.tactile_age
        figures = LinkFigures(
            period_ns=plan.sync.period_ns,
            lateness_ns=sorted(list(lateness_ns)[first:]),
            wait_ns=plan.budget.looks_ns[-1],
            answers=meter.answers(),
            torn=None if cell.tactile is None else _torn(cell) - torn,
            array_silent=age is not None and age > cell.supervisor.seen.limits.tactile_timeout,
            load=None if load is None else load / len(plan.buses),
            planned_load=max(bus.load for bus in plan.buses),
            foreign_hz=meter.foreign / max(meter.seconds, 1e-9),
            queue_full=counters.transmit_full - full,
            dropped=counters.overruns,
            error_frames=counters.error_frames,
            passive=meter.state in (ControllerState.PASSIVE, ControllerState.BUS_OFF),
            failure=failure,
            work_ns=meter.work_ns,
            idle_ns=idle_ns[plan.sync.period_ns],
            idle_fast_ns=idle_ns[IDLE_FAST_NS],
        )
    if not session.virtual:
        late = [_us(us(quantile(idle_ns[plan.sync.period_ns], share))) for share in (0.5, 0.99, 1.0)]
        machine = {"wakes_late_by": "p50 {}, p99 {}, at most {}, without a bus".format(*late), **machine}
        machine["frames_stamped"] = stamps_text(meter, idle_ns[plan.sync.period_ns][-1])
        machine["controller"] = _controller(plan)
    found = session.cell.found
    return LinkReport(
        plan.setup.name,
        tuple(bus.channel for bus in plan.buses),
        judge_link(figures, link_limits(plan)),
        figures,
        machine,
        tuple(found.remarks) if found is not None else (),
    )


def _controller(plan: Plan) -> str:
    """State and error counters of the first bus's CAN controller, as its driver tells them."""
    link = read_link(plan.buses[0].channel) if plan.scene.bus.interface == SOCKETCAN else None
    if link is None or link.state is None:
        return NOT_AVAILABLE
    return f"{link.state}, error counters {link.tx_errors} transmit, {link.rx_errors} receive"


def _traffic(plan: Plan) -> dict[str, Any]:
    """What a meter has to know of a plan."""
    answers = {pdo.cob_id: pdo.node_id for pdo in plan.pdos if pdo.part == "feedback" and pdo.transmission_type == 1}
    bases = (EMCY_BASE, HEARTBEAT_BASE, SDO_RX_BASE, SDO_TX_BASE)
    known = {pdo.cob_id for pdo in plan.pdos} | {frames.can_id for frames in plan.raw}
    known |= {base + node_id for base in bases for node_id in (*plan.node_ids, MASTER_NODE_ID)}
    return {"wait_ns": plan.budget.looks_ns[-1], "answers": answers, "known": known}


def _torn(cell: Cell) -> int:
    """Images that did not come, or not whole."""
    return cell.tactile.unusable + cell.tactile.lost if cell.tactile is not None else 0
