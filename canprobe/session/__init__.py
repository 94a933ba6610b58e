"""The composition root: a cell with everything round it, the emulated nodes and bridges in their processes.

`session.Session` is the only place, besides studies and tests, that sees both sides of the bus. Entered, it plans,
opens the buses, starts recording, makes the cell and, where nodes are emulated, their world: in the same process on a
lockstep bus, in a child (`children`) on a real one. It listens before it starts a child. Left, it stops everything in
the reverse order: drives disabled, logs flushed, bus closed, children ended, truth kept.

`emulation` serves nodes for other masters, `links` checks how the interfaces are set before anything is sent, `up` is
what `canprobe up` needs besides. A session holds the `Scene`, because scenes cross processes as text.
"""
