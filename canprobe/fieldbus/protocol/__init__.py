"""CANopen bytes and their meaning, pure: no socket, no clock, no side of the bus.

Master and emulated nodes read the same tables, so that neither can be right alone.

frames          identifiers, NMT, heartbeat, SYNC, EMCY, LSS: a few bytes each, packed and parsed
pdo             PDO mappings, compiled once to struct formats
cia402          the drive state machine as one table, read by the drive and by its master
tactile         tactile frames: header, CRC, window and features, and their reassembly with losses noticed
frame_bits      bits of a frame on the wire: exact for given contents, and the best and worst case
response_times  how late each message can be in the worst case (Davis, Burns, Bril, Lukkien 2007)

Every decoder raises only `ProtocolError`, whatever the bytes. Sources are cited where a table comes from.
"""
