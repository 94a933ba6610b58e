"""Adapters from a cell, live or recorded, to other tools. No room imports them: they are loaded by name on request.

Live tools never delay a cycle: `process` is an observer that packs the cell's measurements and hands them to a separate
process by a bounded queue (`pipe`); `worker` is that process. There `sampling` makes one neutral `sample.Sample` in SI
units of each observation, with the states of the nodes. It goes into:

    mcap_file, foxglove_live, ros2_dds   ROS 2 `messages` on topics into a file, a WebSocket, DDS (`dds_types`)
    view/                                three dimensions in a browser
    export                               a plan as `dcf`, `database` (DBC, KCD) and `bus_yml`, without any run

`sample` has the methods of a sink too, and `description` the arm's frames and its URDF.

`canprobe.cell.planning.bridges` lists the bridges, their packages and how to install them. To add one: a module
with `open_sink(context)`, a line in that table, an extra.
"""
