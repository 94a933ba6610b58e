"""A small master on python-can that sends a target of 0 to a drive wherever it stands, as some do.

python small_master.py NODE [INTERFACE CHANNEL]
"""

import struct
import sys
import time

import can

node = int(sys.argv[1])
bus = can.Bus(**dict(zip(("interface", "channel"), sys.argv[2:], strict=False)))


def send(can_id, data):
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))


def heard(can_id, patience_s):
    until = time.monotonic() + patience_s
    while time.monotonic() < until:
        message = bus.recv(0.1)
        if message is not None and message.arbitration_id == can_id:
            return bytes(message.data)
    return None


def hear(can_id):
    return heard(can_id, 60.0) or sys.exit(f"{can_id:03X} was not heard")


def read(index):
    send(0x600 + node, struct.pack("<BHBi", 0x40, index, 0, 0))


def write(index, subindex, value, size):
    send(0x600 + node, struct.pack("<BHBi", 0x23 | 4 - size << 2, index, subindex, value))
    hear(0x580 + node)


read(0x1000)
while heard(0x580 + node, 1.0) is None:  # until the nodes are served
    read(0x1000)
write(0x1006, 0, 20_000, 4)
write(0x60C2, 1, 20, 1)
write(0x60C2, 2, -3, 1)
write(0x6060, 0, 8, 1)
read(0x6061)
hear(0x580 + node)
send(0, bytes((1, node)))
for word, state in ((0, 0x40), (6, 0x21), (7, 0x23), (15, 0x27), (15, 0x27), (2, 0x40), (0, 0x40)):
    for _ in range(20):
        send(0x80, b"")
        send(0x200 + node, struct.pack("<Hi", word, 0))
        status = hear(0x180 + node)[0] & 0x6F
        time.sleep(0.02)
        if status & 0x4F == state & 0x4F:
            break
bus.shutdown()
print("done")
