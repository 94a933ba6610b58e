"""Where canprobe touches the world: clocks, CAN ports, requests and answers over them, and files.

Everything above knows two small interfaces: a `Clock` (now, sleep until) and a `Port` (`send_batch`, `drain`, counters,
state of the controller). Frames go out in batches and come in with the time of their reception.

    virtual/          buses in virtual time, in one thread: the same seed gives the same log
    real/             SocketCAN by a raw socket, any interface of python-can, the settings of a link, real time
    clock             virtual time that jumps, and the monotonic clock of the machine
    port              the interface `Port`, its counters, and the states of a controller
    joined            several buses as one port
    pumped            a port that is read by whoever waits for an answer
    sdo, lss          SDO transfers to many nodes at once, LSS requests; neither uses a thread
    presence          which nodes are on a bus
    canopen_network   canopen-python on a port
    candump           logs in candump's format: written, read, recorded from a port
    clock_steps       a recording whose clock was set while it was recorded
    files             files that are written whole or not at all

Invariants: times are integer nanoseconds. A port never raises for what a bus does: it counts, and reports its state.
`time`, `socket`, `threading` and python-can are imported in this room, in `vcan/` and in `cell/session/` only. Start
reading at `port`, then `virtual/lockstep`.
"""
