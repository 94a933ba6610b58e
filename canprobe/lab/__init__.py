"""Software that works with cells: studies, bridges to other tools, a Gymnasium environment, and examples to copy.

- `studies` measure error against run time, stability, timing and faults, each with its machine, commit and seed.
- `bridge` hands the measurements of a cell to ROS 2, Foxglove, MCAP files, tables and the view in a browser.
- `gym` is a cell as an environment for learning. `examples` are scripts to start from.

Nothing below imports this wing: a cell runs without it, and each part is imported at its first use. A bridge runs
in a separate process and can be slow or fail without an effect on the cycle.
"""
