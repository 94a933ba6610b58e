"""A CiA 301 node without I/O: object dictionary, SDO, PDO, SYNC, EMCY, error control, LSS and storage.

`slave_node.SlaveNode` has one method for what comes in, `receive(can_id, data, t)`, and one for time, `advance(t)`;
both return frames to send, and `next_deadline_ns` says when `advance` has to be called. It puts the services together.
Each service of the standard is one module:

    core                what all services share: identity, NMT state, time, timers, dictionary, frames to send
    timers              the deadlines of one node
    dictionary          its entries: type, rights, limits, bytes; all values, with the checks of an access over the bus
    sdo_states          the state machine of an SDO server as a table
    sdo_transfers       segmented and block transfers, each a generator
    sdo_server          expedited transfers, and the beginning and end of the others
    pdo                 all PDOs of a node: which frame goes where, and what a SYNC does
    rpdo, tpdo          one RPDO, one TPDO
    pdo_rules           what may be written to their parameters, and when
    sync                the SYNC consumer
    emcy                emergencies, error register, error history
    error_control       heartbeat producer and consumer, node guarding and life guarding
    lss                 node ids over the bus, and how a node without one is found
    store, stored_file  stored parameters, in memory and in a file
    quirks              what makes a node difficult
    serve               nodes on a real interface, in real time

An application (`canprobe.fieldbus.drive`) hooks onto entries of the dictionary and gets every SYNC. Invariants: a node
never sleeps, opens or waits, so that the same node runs in virtual time and on a real interface, for any master;
`receive` never raises, whatever is on the bus. Each point of the conformance list is a test named after its clause.
Start reading at `slave_node`, then `core`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from canprobe.errors import door

if TYPE_CHECKING:  # for type checkers, which do not read the table
    from canprobe.fieldbus.node.quirks import Quirks as Quirks
    from canprobe.fieldbus.node.slave_node import Application as Application
    from canprobe.fieldbus.node.slave_node import SlaveNode as SlaveNode
    from canprobe.fieldbus.protocol.sdo import Abort as Abort
    from canprobe.fieldbus.protocol.sdo import SdoAbort as SdoAbort

__getattr__, __dir__, __all__ = door(
    __name__,
    {
        "node.quirks": ("Quirks",),
        "node.slave_node": ("Application", "SlaveNode"),
        "protocol.sdo": ("Abort", "SdoAbort"),
    },
)
