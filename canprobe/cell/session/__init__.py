"""The composition root: a cell with everything round it, the emulated nodes and bridges in their processes.

`session.Session` is the only place, besides studies and tests, that sees both sides of the bus. Entered, it plans,
opens the buses, starts recording, makes the cell and, where nodes are emulated, their world: in the same process on a
lockstep bus or without a bus, in a child (`child_process`) on a real one. It listens before it starts a child. Left,
it stops everything in the reverse order: drives disabled, logs flushed, bus closed, children ended, truth kept.

    session         one cell from bring-up to safe stop
    target          the bus of a run or a command: its interface, channels and bit rate; put into a scene, or opened
    buses           the three kinds of bus, with what is on their other side: no bus, virtual, real; their record
    links           check of the interfaces' settings, and of their controllers, before anything is sent
    folder          the folder of a run, the file of its steps, and the files of what a cell keeps
    direct          a cell without a bus
    child_process   a process beside the master, and that of the emulated nodes
    children        the processes of the bridges to other tools
    recovery        a cell that comes back after a node or the bus was lost
    up              a cell that holds its position for days; its joints one after the other: which is which, their zeros
    check           a verdict on link and machine before motion
    joint_record    what a check of the joints has shown, for later runs
    bus_tools       a bus without a cell: scan, node ids, monitor, emulated nodes of a scene for other masters
    served          nodes of EDS files for them, and how nodes are served
    array_calibration    touches of known objects, visit by visit, and the fit
    terminal        steps and a progress bar on a terminal

A session holds the `Scene`, because scenes cross processes as text.
"""
