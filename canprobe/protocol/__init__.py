"""CANopen bytes and their meaning, pure: no socket, no clock, no side of the bus.

frames      identifiers, NMT, heartbeat         pdo     PDO mappings compiled to struct
sync        the SYNC counter                    cia402  the drive state machine, both roles
emcy        emergency messages                  tactile tactile frames, packed and reassembled
timing      frame lengths and worst-case response times
"""
