"""Where canprobe touches the world: clocks, CAN ports, requests and answers over them, and files.

Everything above knows two small interfaces, both in `port`: a `Clock` (now, sleep until) and a `Port` (`send_batch`,
`drain`, counters, the controller's state). Behind them:

    virtual/   virtual time, one thread: frames take no time, or their bits at the bit rate, with arbitration, error
               frames and error states; the same seed gives the same log
    real/      SocketCAN by a raw socket, any interface of python-can, how a link is set, the machine's real time

`sdo` asks and waits for answers without threads (SDO, LSS): whoever waits pumps the port, in the port's own time.
`canopen_network` lets canopen-python do that. `candump` reads and writes logs, `clock_steps` follows a recording whose
clock was set, `files` writes files whole or not at all.

`time`, `socket`, `threading` and python-can are imported in this room, in `vcan/` and in `cell/session/` only. Times
are integer nanoseconds. A port never raises for what a bus does; it counts, and reports its state.
"""
