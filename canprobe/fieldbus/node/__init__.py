"""A CiA 301 node without I/O: object dictionary, SDO, PDO, SYNC, EMCY, error control, LSS and storage.

`slave_node.SlaveNode` has one method for what comes in (`receive(can_id, data, t)`) and one for time (`advance(t)`);
both return frames to send, and `next_deadline_ns` is when `advance` has to be called. It puts the services together;
they share `core`: identity, NMT state, time, timers, dictionary, and the quirks that make a node difficult.

- `dictionary` keeps values and makes every check that an access over the bus must pass, with the abort codes of CiA
  301.
- `sdo_server` does expedited, segmented and block transfers by one table of states, for several clients.
- `pdo_engine` and `rpdo_tpdo` route PDOs, hold parameters and mapping rules, events, inhibit times and SYNC.
- `error_control` is heartbeat, guarding and emergencies; `lss_slave` node ids and stored parameters.

An application (`canprobe.fieldbus.drive`, `canprobe.cell.emulated.array`) hooks onto entries of the dictionary and gets
every SYNC.
"""
