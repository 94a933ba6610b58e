"""Where canprobe touches the world: clocks, CAN ports, requests and answers over them, and files.

Everything above knows two small interfaces, both in `port`: a `Clock` (now, sleep until) and a `Port` (`send_batch`,
`drain`, counters, the controller's state). Behind them:

    lockstep, timed, controllers   virtual time, one thread: frames take no time, or their bits at the bit rate, with
                                   arbitration, error frames and error states; the same seed gives the same log
    socketcan, mmsg, link          a raw socket, a burst of frames a system call; how the link is set
    interfaces                     any interface of python-can

`network` asks and waits for answers without threads (SDO, LSS): whoever waits pumps the port, in the port's own time.
`scheduling` asks the machine for real time and keeps interrupts between two cycles. `disk` writes files whole or not
at all, and reads and writes logs.

`time`, `socket`, `threading` and python-can are imported in this room, in `vcan/` and in `session/` only. Times are
integer nanoseconds. A port never raises for what a bus does; it counts, and reports its state.
"""
