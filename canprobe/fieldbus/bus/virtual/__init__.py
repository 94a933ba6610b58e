"""Buses in virtual time, in one process and one thread: the same seed gives the same log, byte by byte.

Nodes attach to a bus as participants: the bus gives them frames and the time, and takes frames and their next deadline.
Time is a `VirtualClock`. It passes only while somebody waits on it, and then jumps from one deadline to the next.

    lockstep         frames arrive at once, in the order of arbitration, without time on the wire
    timed            frames take their bits at the bit rate, wait for each other, and fail where the wire fails
    controllers      bits that the wire corrupts, and the error counters of all nodes: who has to wait, who is bus off

Start reading at `lockstep`; a `TimedBus` is a `LockstepBus` that adds the wire.
"""
