"""Tools for other people's nodes and masters: examinations, faults on demand, and reports.

- `conform` examines a device of any maker, and leaves it as it was.
- `faults` is the registry of faults: what can go wrong with a node, its link, its drive, and how it is thrown.
- `reports` are what examinations of nodes and masters report, for people and for CI servers.

The tools take nodes and ports; they never build them from a cell. Start reading at `faults`.
"""
