"""A CiA 301 node without I/O: object dictionary, SDO, PDO, SYNC, EMCY, error control, LSS and storage.

`slave_node` puts the services together; each has its state in `core` and takes bytes and a time.
"""
