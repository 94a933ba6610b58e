"""Buses in real time: SocketCAN by a raw socket, and any interface of python-can.

`socketcan` is the port on a kernel's interface, with `mmsg` for bursts of frames in one system call; `link` says how
the interface is set. `python_can` is the port on everything else. `processor` asks the machine for real time and keeps
interrupts between two cycles.
"""
