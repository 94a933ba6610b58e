"""CANopen bytes and their meaning, pure: no socket, no clock, no side of the bus.

Bytes come in and values go out, or the reverse. Master and emulated nodes read the same tables, so that a mistake in
one of them shows on both sides of the bus.

    frames                identifiers of CiA 301, NMT, heartbeat and SYNC, flags of long identifiers and remote requests
    pdo                   PDO mappings, compiled once to struct formats
    sdo                   SDO requests, and what stands where in requests and answers
    emcy                  emergency messages and the words for their codes
    lss                   layer setting services
    cia402                the state machine of a drive as one table, which the drive and its master both read
    si_unit               units of velocity and acceleration (60A9h, 60AAh)
    tactile               tactile frames in PDOs: header, CRC, window and features; put together again, losses noticed
    raw_image             images in raw CAN frames, of arrays without CANopen
    period                the sampling instants of a free-running device
    frame_bits            bits of a frame on the wire: exact for given contents, best case and worst case
    response_times        how late a message can be, where nodes send their highest priority or their oldest frame first

Invariants: every decoder raises `ProtocolError` and nothing else, whatever the bytes; nothing holds state but the
assemblers, the SYNC counter and the period fit; the source of each table is cited. Start reading at `frames`, then
`pdo` and `cia402`.
"""
