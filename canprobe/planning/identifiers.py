"""Identifiers of PDOs in the order of their deadlines, and what is wrong with a set of them.

The bus gives way to the lower identifier. With priorities in the order of the deadlines a message that can wait never
stands before one that cannot. Source: Davis et al. 2007 (priority assignment); restricted identifiers: CiA 301.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from canprobe.planning.model import PlannedPdo
from canprobe.protocol.frames import is_restricted
from canprobe.protocol.pdo import PdoLayout

_POOL = range(0x181, 0x580)
"""Identifiers below SYNC, emergencies and TIME and above SDO and heartbeats; restricted ones are left out."""


def order_by_deadline(pdos: Sequence[PlannedPdo]) -> list[PlannedPdo]:
    """The same PDOs with identifiers in the order of their deadlines.

    At one deadline feedback goes before commands, then as before. An RPDO that several drives read
    keeps one identifier.
    """
    free = (cob_id for cob_id in _POOL if not is_restricted(cob_id))
    first = {pdo.cob_id: pdo for pdo in reversed(pdos)}
    ordered = sorted(first.values(), key=lambda pdo: (pdo.deadline_ns, pdo.direction == "rpdo", pdo.cob_id))
    chosen = {pdo.cob_id: cob_id for pdo, cob_id in zip(ordered, free, strict=False)}
    return [_with_id(pdo, chosen[pdo.cob_id]) for pdo in pdos]


def _with_id(pdo: PlannedPdo, cob_id: int) -> PlannedPdo:
    layout = pdo.layout
    return replace(pdo, layout=PdoLayout(cob_id, layout.entries, layout.transmission_type, fd=layout.fd))


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
