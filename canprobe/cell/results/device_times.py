"""Times that `canprobe conform` measured on a device, beside what a plan counts on."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from canprobe.cell.planning.model import HEARTBEAT_CONSUMED_MS, HEARTBEAT_PRODUCED_MS, Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.errors import UsageError
from canprobe.fieldbus.tools.conform.bench import HEARTBEAT_MS
from canprobe.fieldbus.tools.conform.points.timing import HEARTBEAT_TIME, SDO_TIME, SYNC_TIME
from canprobe.fieldbus.tools.reports import Report, read_json


@dataclass(frozen=True, slots=True)
class DeviceTime:
    """One time of one node.

    Attributes:
        node_id: node of the plan.
        what: what was measured.
        longest_ms: the longest time that was measured, ms.
        allowed_ms: the longest time that the plan counts on, ms.
        count: how often it was measured.
    """

    node_id: int
    what: str
    longest_ms: float
    allowed_ms: float
    count: int

    @property
    def fits(self) -> bool:
        """Whether the device is as quick as the plan needs it."""
        return self.longest_ms <= self.allowed_ms


@dataclass(frozen=True, slots=True)
class DeviceTimes:
    """All times of a report beside a plan.

    Attributes:
        title: title of the report.
        rows: the times.
    """

    title: str
    rows: tuple[DeviceTime, ...]

    @property
    def as_planned(self) -> bool:
        """Whether all times fit."""
        return all(row.fits for row in self.rows)

    def as_dict(self) -> dict[str, Any]:
        """The comparison in JSON types."""
        rows = [asdict(row) | {"fits": row.fits} for row in self.rows]
        return {"device": self.title, "as_planned": self.as_planned, "times": rows}

    def text(self) -> str:
        """The comparison as text."""
        lines = [f"measured by canprobe conform on {self.title}:"]
        for row in self.rows:
            note = "" if row.fits else "  longer than the plan allows"
            lines.append(
                f"  node {row.node_id:<3} {row.what:<22} {row.longest_ms:8.3f} ms of {row.allowed_ms:g} ms,"
                f" {row.count} times{note}"
            )
        return "\n".join(lines) + "\n"


def read_device_times(path: Path, plan: Plan) -> DeviceTimes:
    """Compare the times of a report with a plan; the device is known by vendor and product.

    An SDO answer must come within the time-out of bring-up, a TPDO within its deadline behind SYNC, and a heartbeat as
    much too late as was measured within the time of its consumer.

    Raises:
        UsageError: the file is no report of `conform`, has no times, or is of a device that the plan does not have.
    """
    report = read_json(path)
    if report.tool != "conform" or not report.distributions:
        raise UsageError(f"{path}: expected the --json report of canprobe conform with its points of timing")
    nodes = [node for node in plan.nodes if _is_device(node, report)]
    if not nodes:
        vendor, product = report.facts.get("vendor"), report.facts.get("product")
        raise UsageError(f"{path}: no node of the plan is a device of vendor {vendor} and product {product}")
    return DeviceTimes(report.title, tuple(row for node in nodes for row in _rows(node, report, plan)))


def _is_device(node: NodeConfiguration, report: Report) -> bool:
    wanted = (node.identity.vendor_id, node.identity.product_code)
    numbers = tuple(None if number is None else f"{number:#x}" for number in wanted)
    return None not in numbers and (report.facts.get("vendor"), report.facts.get("product")) == numbers


def _rows(node: NodeConfiguration, report: Report, plan: Plan) -> list[DeviceTime]:
    rows = []
    for name, times in report.distributions.items():
        if name.startswith(SDO_TIME) and times:
            rows.append(DeviceTime(node.node_id, name, max(times), plan.setup.bring_up.sdo_s * 1e3, len(times)))
    deadlines = [
        pdo.deadline_ns * 1e-6
        for pdo in plan.pdos
        if pdo.node_id == node.node_id and pdo.direction == "tpdo" and pdo.layout.synchronous
    ]
    if (times := report.distributions.get(SYNC_TIME, ())) and deadlines:
        rows.append(DeviceTime(node.node_id, SYNC_TIME, max(times), min(deadlines), len(times)))
    if times := report.distributions.get(HEARTBEAT_TIME, ()):
        late_ms = max(times) - HEARTBEAT_MS
        longest = HEARTBEAT_PRODUCED_MS + late_ms
        rows.append(DeviceTime(node.node_id, HEARTBEAT_TIME, longest, HEARTBEAT_CONSUMED_MS, len(times)))
    return rows
