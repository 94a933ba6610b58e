"""Buses in real time: SocketCAN by a raw socket, and any interface of python-can.

    opening      `open_port`: a port by the name of its interface
    socketcan    the port on a kernel's interface, with kernel time stamps
    mmsg         many frames in one system call, under `socketcan`
    link         how a SocketCAN interface is set, and the lines that set it
    python_can   the port on every other interface
    echoes       which received frames are our own
    processor    priority and locked memory for a process in real time
    memory       reserved memory, and no garbage collection inside a cycle
    interrupts   Ctrl-C and signals between two cycles instead of inside one

Both ports keep the contract of `bus.port`: frames in batches, times of the monotonic clock, and no exception for what a
bus does. Start reading at `opening`.
"""
