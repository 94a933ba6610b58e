"""CANopen bytes and their meaning, pure: no socket, no clock, no side of the bus.

frames      identifiers, NMT, heartbeat, SYNC, EMCY, LSS    pdo     PDO mappings compiled to struct
cia402      the drive state machine, both roles             tactile tactile frames, packed and reassembled
frame_bits  lengths of frames on the wire                   response_times  how late each can be in the worst case
"""
