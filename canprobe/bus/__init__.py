"""Where canprobe touches the world: clocks, CAN ports, canopen's network over them, and files.

`port` is what the cycle knows of it. Behind it stand `lockstep` and `timed`, buses in virtual time; `socketcan` with
`mmsg`; and `interfaces` for whatever python-can drives.
"""
