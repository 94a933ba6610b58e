"""A CiA 402 drive: its states and faults, its modes of operation, and the motion that it asks of the plant."""
