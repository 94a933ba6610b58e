"""A CiA 402 drive: its states and faults, its modes of operation, and the motion that it asks of the plant.

`drive.DriveApplication` is the application of a node: controlword in, statusword out, by the table in
`canprobe.fieldbus.protocol.cia402`. The active mode (`modes`, `homing`; `mode` has what they share) gives a
reference, `reference` turns it into ramps, holds and stops of one axis of the plant, and `parameters` reads units,
limits and options from the dictionary whenever one is written. An object that the EDS lacks has a default here.

Loss of SYNC, RPDOs or heartbeat quick-stops the drive by itself (6007h, 605Ah): a dead master never leaves it moving.
"""
