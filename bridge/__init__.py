"""Adapters from a cell, live or recorded, to other tools. Nothing imports them: they are loaded by name, where asked.

Live tools never hold up a cycle: `process` is an observer that packs what the cell saw and hands it to a process of
its own, `worker` is that process. There one neutral `sample.Sample` in SI units is made of each observation and goes
into a sink:

    mcap_file, foxglove_live, ros2_dds   ROS 2 messages (`messages`) into a file, a WebSocket, DDS topics
    view/                                 three dimensions in a browser
    export, database                      a plan as DCF, DBC, KCD and bus.yml, without any run

What there is, what each needs and how it is installed stands in `canprobe.cell.planning.bridges`. To add one: a module
with `open_sink(context)`, a line in that table, an extra.
"""
