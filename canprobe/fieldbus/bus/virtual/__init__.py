"""Buses in virtual time, in one process and one thread: the same seed gives the same log, byte by byte.

`lockstep` delivers frames at once, in the order of arbitration. `timed` gives each frame its bits at the bit rate, with
arbitration, queues and error frames; `controllers` are the error counters and states of the nodes on it.
"""
