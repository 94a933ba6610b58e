"""Tools for other people's nodes and masters: faults that happen on demand.

- `faults` is the registry of faults: what can go wrong with a node, its link, its drive, and how it is thrown.
- `link` judges whether a bus, its nodes and the machine hold a cycle.

The tools take nodes and ports; they never build them from a cell. Start reading at `faults`.
"""
