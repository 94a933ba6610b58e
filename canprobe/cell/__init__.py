"""The master side: bring-up, drives, array, the cycle, supervision, safe stop and the run log.

`assembly.make_cell` makes a `cell.Cell` of a plan and a port; nothing is sent before it is entered.

1. Entering listens first: where another master is at work the cell sends nothing at all and gives up. Then `bringup`
   resets the nodes, checks identities, writes and reads back what `configuration` derives from the plan, and starts
   them.
2. `Cell.run` enables the drives and runs a `controller.Controller`. Each cycle: SYNC on an absolute deadline, TPDOs
   matched by identifier and arrival (`cycle`, `drives`), a `Measurement`, the supervision, `step`, RPDOs, then
   `update`, log, observers.
3. `supervisor` checks every cycle by the table in `conditions`: what can go wrong, how it is seen (`supervision` has
   the checks), how fast, and what is done: counted, hold, retreat, lift off, quick stop. `watch` keeps what the nodes
   say of themselves.
4. Leaving, by whatever way, lifts the probe off if it can, disables the drives, puts the nodes pre-operational and
   closes the bus.

`monitor` reads a bus without sending, `commission` gives node ids by LSS, `log` keeps rows and notes. The room knows
`Setup`, `Plan`, `Clock` and `Port`; it never sees the emulator. Start reading at `cell`, then `conditions`.
"""
