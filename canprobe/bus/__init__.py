"""Where canprobe touches the world: clocks, CAN ports, canopen's network over them, recording, and vcan.

The only package that imports `time`, `socket`, `threading` or `can`.
"""
