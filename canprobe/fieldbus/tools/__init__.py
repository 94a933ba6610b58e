"""Tools for other people's nodes and masters: examinations, a judge, faults on demand, and reports.

- `conform` examines a device of any maker, and leaves it as it was.
- `faults` is the registry of faults: what can go wrong with a node, its link, its drive, and how it is thrown.
- `emulated_bus` puts emulated nodes on a bus of a test, in virtual or in real time;
  `judged_bus` judges the master of a test on it.
- `judge` finds known faults of masters in the frames of a bus.
- `link` judges whether a bus, its nodes and the machine hold a cycle.
- `reports` are what examinations of nodes and masters report, for people and for CI servers.

The tools take nodes and ports; they never build them from a cell. Start reading at `faults`.
"""
