"""The composition root: a cell with everything round it, the emulated nodes and bridges in their processes.

`session.Session` is the only place, besides studies and tests, that sees both sides of the bus. Entered, it plans,
opens the buses, starts recording, makes the cell and, where nodes are emulated, their world: in the same process on a
lockstep bus or without a bus, in a child (`children`) on a real one. It listens before it starts a child. Left, it
stops everything in the reverse order: drives disabled, logs flushed, bus closed, children ended, truth kept.

    target      the bus of a run or a command: interface, channels and bit rate, put into a scene by one function
    links       how the interfaces are set, checked before anything is sent
    session     one cell from bring-up to safe stop
    direct      a cell without a bus
    children    the processes beside it: emulated nodes, bridges to other tools
    up          a cell that is held for days, or whose joints are checked
    looking     a bus without a cell: scan, node ids, monitor
    emulation   emulated nodes for other masters
    array_calibration  touches of known objects, visit by visit, and the fit

A session holds the `Scene`, because scenes cross processes as text.
"""
