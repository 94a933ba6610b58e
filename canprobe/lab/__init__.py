"""What works with cells: studies, bridges to other software, a Gymnasium environment, and examples to copy.

- `studies` measure error against run time, stability, timing and faults, each with its machine, commit and seed.
- `bridge` hands what a cell measures to ROS 2, Foxglove, MCAP files, tables and the view in a browser.
- `gym` is a cell as an environment for learning. `examples` are scripts to start from.

Nothing below imports this wing: a cell runs without it, and each part is imported when it is asked for. A bridge runs
in a process of its own and can be slow or fail without a cycle noticing.
"""
