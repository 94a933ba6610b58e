"""The master side: bring-up, drives, sensor, the cycle, supervision, safe stop and the run log.

`assembly` makes a `cell.Cell` of a plan and a port. Entered, it brings the nodes up (`bringup`, `configuration`) and
enables the drives; `cycle` runs a `controller.Controller`, `supervisor` checks every cycle by the table in
`conditions`; left, by whatever way, it disables the drives.
"""
