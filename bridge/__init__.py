"""Adapters from a cell, live or recorded, to other tools. Nothing imports them: they are loaded by name, where asked.

Live tools never hold up a cycle: `process` is an observer that packs what the cell measured (`codec`) and hands it to
a separate process by a bounded queue (`pipe_queue`); `worker` is that process. There `sampling` makes one neutral
`sample.Sample` in SI units of each observation, with the tree of `frames` and the `node_states`. It goes into a sink:

    mcap_file, foxglove_live, ros2_dds   ROS 2 `messages` on `topics` into a file, a WebSocket, DDS (`dds_types`)
    view/                                three dimensions in a browser
    export                               a plan as `dcf`, `database` (DBC, KCD) and `bus_yml`, without any run

`interface` says what a sink offers, `description` draws the arm as a URDF, and `commands` checks what other tools ask
the cell to do.

What there is, what each needs and how it is installed stands in `canprobe.cell.planning.bridges`. To add one: a module
with `open_sink(context)`, a line in that table, an extra.
"""
