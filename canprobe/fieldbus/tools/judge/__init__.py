"""Judges CANopen masters by what they send: known faults of masters, each a rule on the frames of a bus.

Frames come in, of a log or of nodes that are served here; findings go out, each with the frames that show it.

    bus_frame   a frame, with its time; those of a candump log
    events      what a frame means, such as `ControlSeen`, a controlword
    seen_node   what is known of one node, from frames and its EDS
    seen_motor  the same of a motor that does not speak CANopen, whose rules are motor_rules
    sdo_channel which SDO transfer is open, and what it carried
    bus_state   frames → events; nothing that was not on the bus
    rule        what a rule is: its facts, which rules.toml has, and a generator that gets events; a `Case` is one at
                work. One module a family: enable (and homing), targets, pdo_rules, sdo_rules, network_rules (NMT,
                SYNC, watchdogs), reactions
    judging     the table of all rules, and `Judge`: events to rules, findings to a report
    bench       a master on nodes that are served here, started and ended; injections throws faults meanwhile. It is
                imported by itself: a log needs no nodes

Guards against false alarms: a node is judged after its state was seen; three SYNCs after an NMT start and frames that
may have waited in a queue are passed over; what is wrong counts when it is wrong twice in a row, but for faults that
move an axis at once; limits come from values that were read or from the EDS; after a fault that was thrown at a node
only reactions to it are judged for a second. A rule that had nothing to judge is not passed but not applicable.
Several axes in one node (objects from 6800h on) are not known.

Start reading at `bus_state`, then `rule`, then `enable`.
"""

from canprobe.fieldbus.tools.judge.bus_frame import BusFrame, nodes_of, read_record
from canprobe.fieldbus.tools.judge.judging import RULES, Judge

__all__ = ["RULES", "BusFrame", "Judge", "nodes_of", "read_record"]
