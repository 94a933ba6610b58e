"""Tools for other people's nodes and masters: faults on demand, a judge of masters, and reports.

- `faults` is the registry of faults: what can go wrong with a node, its link, its drive, and how it is thrown.
- `emulated_bus` puts emulated nodes on a bus of a test, in virtual or in real time.
- `judge` finds known faults of masters in the frames of a bus.
- `reports` are what examinations of nodes and masters report, for people and for CI servers.

The tools take nodes and ports; they never build them from a cell. Start reading at `faults`.
"""
