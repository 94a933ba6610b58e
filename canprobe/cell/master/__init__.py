"""The master side: bring-up, drives, array, the cycle, supervision, safe stop and the run log.

A `cell.Cell` is made of a plan and a port; nothing is sent before it is entered.

1. Entering brings the nodes up (`bringup`, top to bottom): listen, reset, configure each (`node_bringup`), start.
   Where another master is at work the cell sends nothing and gives up. The plan's `configuration` states what is
   written into each node: a list of objects with value and purpose.
2. `Cell.run` enables the drives (`arm_power`) and runs a `controller.Controller`. Each cycle: SYNC on an
   absolute deadline, TPDOs matched by identifier and arrival (`cycle`, `drives`, `array`), a `Measurement`, the
   supervision, `step`, RPDOs, then `update`, log, observers: `Cell._run_cycle`, on a `supervised_cycle`.
3. `conditions` is the table of faults, each row with its check, its reaction and its time. `supervision` has the data
   that checks read, `supervisor` runs the table in every cycle and guards the joints. `watch` follows boot-ups,
   heartbeats and emergencies of the nodes. `notes` counts the faults that did not stop the run.
4. Leaving, by whatever way, lifts the probe off if it can (`lift_off`), disables the drives, puts the nodes
   pre-operational and closes the bus.

`position_track` is the position of a motor as its TPDOs report it, `tactile_frame` the frame that controllers see;
`observers` see every cycle after its work. `log` keeps rows. `homing` finds the zeros of drives without an absolute
encoder, each led by SDO, and `node_record` keeps them. `monitor` reads a bus without sending.
`commission` lists nodes, and gives node ids by LSS; `options` is what the caller of a run sets.
The room knows `Setup`, `Plan`, `Clock` and `Port`; it never sees the emulator.
Start reading at `cell`, then `conditions`.
"""
