"""The commissioning record of a cell: which joints were seen to move as its file says, when, and what showed it.

It is kept beside the record of the zeros, an entry a drive, and only for real drives. `canprobe up --check-joints`
writes it. `plan`, `run` and `up` read it and warn where a joint was not checked, or where the cell file or the drive
has changed since. Nothing refuses to move for want of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, Any

from canprobe.cell.master.bringup import BringUp
from canprobe.cell.master.node_record import NodeRecord
from canprobe.cell.planning.model import Plan
from canprobe.cell.session.folder import record_file
from canprobe.errors import UsageError

if TYPE_CHECKING:
    from canprobe.cell.tasks.joint_check import JointFinding

WHAT_CHANGED = {
    "joint": "node id",
    "identity": "make of its drive",
    "units": "counts, gear, sign or coupling",
    "zero": "zero",
    "serial": "drive (1018h:04)",
}
"""What has changed where a key of an entry differs."""


class JointRecord:
    """The commissioning record of the real drives of a plan.

    Args:
        plan: the plan.

    Attributes:
        node_ids: the real drives, joint by joint.

    Raises:
        UsageError: the file is of a newer canprobe.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._axes = {drive.node_id: axis for axis, drive in enumerate(plan.setup.drives) if not drive.emulated}
        self.node_ids = tuple(self._axes)
        self.path = record_file("joints", plan.setup.needed_arm()) if self._axes else None
        self._record = NodeRecord(self.path, "check the joints again")

    def changes(self, serials: Mapping[int, int]) -> dict[int, str]:
        """What has changed since a joint was checked, in words, by its number from 0; "" where it never was.

        Args:
            serials: serial numbers of the drives by node id, as far as they are known.
        """
        found = {}
        for node_id, axis in self._axes.items():
            then = self._record.entry(node_id)
            now = self._settings(axis, serials.get(node_id))
            known = {key: value for key, value in now.items() if value is not None and then.get(key) is not None}
            differ = [what for key, what in WHAT_CHANGED.items() if key in known and then[key] != known[key]]
            if differ or not then:
                found[axis] = " and ".join(differ)
        return found

    def put(self, finding: JointFinding, serials: Mapping[int, int]) -> None:
        """Record a joint that was seen to be right; forget one that was not.

        Raises:
            ResultsError: the file cannot be written.
        """
        for node_id, axis in self._axes.items():
            if axis != finding.joint or finding.skipped is not None:
                continue
            if finding.fault is not None:
                self._record.put(node_id, None)
            elif finding.seen is not None:
                entry = self._settings(axis, serials.get(node_id))
                entry |= {"seen": finding.seen, "asked": f"{finding.asked:+.2f} {finding.unit}"}
                entry |= {"array_n": finding.force, "date": datetime.now().astimezone().isoformat(timespec="seconds")}
                self._record.put(node_id, entry)

    def _settings(self, axis: int, serial: int | None) -> dict[str, Any]:
        """The values with which what was seen is valid, as JSON gives them back; None where one is not known."""
        arm = self._plan.setup.needed_arm()
        drive, model = arm.drives[axis], arm.model
        identity = next(node.identity for node in self._plan.nodes if node.node_id == drive.node_id)
        return {
            "joint": model.joints[axis].name,
            "identity": [identity.vendor_id, identity.product_code],
            "serial": serial if serial is not None else drive.serial,
            "units": model.units_per_q[axis].tolist(),
            "zero": [float(model.zero_units[axis]), None if drive.zero is None else drive.zero.home],
        }


def warned(plan: Plan) -> Plan:
    """The plan, with a warning where a joint of a real drive was not checked as it is now."""
    warning = _warning(plan, {})
    return plan if warning is None else replace(plan, warnings=(*plan.warnings, warning))


def exchanged(plan: Plan, bring_up: BringUp) -> str | None:
    """A warning where a checked joint has another drive than then, once the nodes are up; None without one."""
    if _warning(plan, {}) is not None or not (node_ids := JointRecord(plan).node_ids):
        return None
    return _warning(plan, bring_up.serial_numbers(node_ids))


def _warning(plan: Plan, serials: Mapping[int, int]) -> str | None:
    try:
        changes = JointRecord(plan).changes(serials)
    except UsageError as error:
        return str(error)
    if not changes:
        return None
    never = [axis for axis, what in changes.items() if not what]
    told = [f"{_joints(never)} not checked"] if never else []
    told += [f"{_joints([axis])} checked with another {what}" for axis, what in changes.items() if what]
    line = plan.setup.line_to_type("up", "--check-joints")
    return (
        f"whether the arm moves as its file says is not known: {'; '.join(told)}; before the first contact type: {line}"
    )


def _joints(axes: Sequence[int]) -> str:
    numbers = ", ".join(str(axis + 1) for axis in axes)
    return f"joint {numbers} was" if len(axes) == 1 else f"joints {numbers} were"
