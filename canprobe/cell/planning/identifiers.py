"""Identifiers of PDOs in the order of their deadlines, and what is wrong with a set of them.

The bus gives way to the lower identifier. With priorities in the order of the deadlines a message that can wait never
stands before one that cannot. Source: Davis et al. 2007 (priority assignment); restricted identifiers: CiA 301.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from canprobe.cell.planning.device_capabilities import DeviceCapabilities
from canprobe.cell.planning.model import PlannedPdo
from canprobe.fieldbus.protocol.frames import is_restricted
from canprobe.fieldbus.protocol.pdo import PdoLayout

_POOL = range(0x181, 0x580)
"""Identifiers below SYNC, emergencies and TIME and above SDO and heartbeats; restricted ones are left out."""


def order_by_deadline(pdos: Sequence[PlannedPdo], devices: Iterable[DeviceCapabilities] = ()) -> list[PlannedPdo]:
    """The same PDOs with identifiers in the order of their deadlines.

    At equal deadlines feedback has priority over commands; otherwise the order stays. An RPDO that several drives read
    keeps one identifier, and so does a PDO whose COB-ID cannot be changed.

    Args:
        pdos: PDOs of all nodes.
        devices: devices whose RPDOs may have fixed identifiers, which no other PDO gets.
    """
    fixed = {pdo.cob_id for pdo in pdos if pdo.fixed_id}
    fixed |= {
        id_ for one in devices for n in one.pdo_numbers("rpdo") if (id_ := one.fixed_cob_id("rpdo", n)) is not None
    }
    free = (cob_id for cob_id in _POOL if not is_restricted(cob_id) and cob_id not in fixed)
    first = {pdo.cob_id: pdo for pdo in reversed(pdos) if not pdo.fixed_id}
    ordered = sorted(first.values(), key=lambda pdo: (pdo.deadline_ns, pdo.direction == "rpdo", pdo.cob_id))
    chosen = {pdo.cob_id: cob_id for pdo, cob_id in zip(ordered, free, strict=False)}
    return [
        pdo
        if pdo.fixed_id
        else replace(pdo, layout=PdoLayout(chosen[pdo.cob_id], pdo.entries, pdo.transmission_type, fd=pdo.layout.fd))
        for pdo in pdos
    ]


def identifier_problems(pdos: Iterable[PlannedPdo]) -> list[str]:
    """Restricted identifiers, and identifiers that two producers would send. Source: CiA 301.

    An RPDO's producer is the master, so several drives may read one; a TPDO's identifier belongs to its node alone.
    """
    problems, owners = [], dict[int, PlannedPdo]()
    for pdo in pdos:
        name = f"node {pdo.node_id} {pdo.direction.upper()}{pdo.number}"
        if is_restricted(pdo.cob_id):
            problems.append(f"{name}: COB-ID {pdo.cob_id:03X}h is restricted (CiA 301); choose another node id")
        other = owners.setdefault(pdo.cob_id, pdo)
        if other is not pdo and "tpdo" in (pdo.direction, other.direction):
            problems.append(
                f"{name}: COB-ID {pdo.cob_id:03X}h is used by node {other.node_id} "
                f"{other.direction.upper()}{other.number} too; choose other node ids"
            )
    return problems
