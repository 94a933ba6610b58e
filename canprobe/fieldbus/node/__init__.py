"""A CiA 301 node without I/O: object dictionary, SDO, PDO, SYNC, EMCY, error control, LSS and storage.

`slave_node.SlaveNode` has one method for what comes in (`receive(can_id, data, t)`) and one for time (`advance(t)`);
both return frames to send, and `next_deadline_ns` is when `advance` has to be called. It puts the services together;
they share `core`: identity, NMT state, time, timers, dictionary, and the quirks that make a node difficult.

- `dictionary` keeps values and makes every check that an access over the bus must pass, with the abort codes of CiA
  301.
- `sdo_server` does expedited, segmented and block transfers by one table of states, for several clients.
- `pdo` and `tpdo` route PDOs, hold parameters and mapping rules, events, inhibit times and SYNC.
- `emcy` has emergencies, heartbeat and guarding; `lss` node ids and stored parameters.
- `faults` injects faults into a node; `serve` serves nodes on a real interface and keeps what a master stores in them.

An application (`canprobe.fieldbus.drive`) hooks onto entries of the dictionary and gets every SYNC. A node never
sleeps, opens or waits: the same one runs in virtual time and on a real interface, for any master. Each point of the
conformance list is a test named after its clause.
"""
