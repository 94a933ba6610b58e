"""A small master of one Damiao motor on python-can, for `canprobe judge`: `motor_master.py PLACE SECONDS`.

It sets the watchdog, asks for the position, enables, and commands PLACE (rad) until its time is over, whatever the
motor says. With `held` for PLACE it holds the position that it found, and goes on only while the motor is enabled.
"""

import sys
import time

import can

from canprobe.fieldbus.motor.protocol import (
    SPECIAL,
    TYPES,
    Feedback,
    MitCommand,
    MotorStatus,
    RegisterOp,
    Rid,
    pack_register,
)

RANGES, MOTOR, MST_ID = TYPES["dm4310"], 1, 0x11


def ask(bus, can_id, data):
    """Send a frame; its answer, or None after a while."""
    bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False))
    end_s = time.monotonic() + 0.5
    while (left_s := end_s - time.monotonic()) > 0.0:
        message = bus.recv(left_s)
        if message is not None and message.arbitration_id == MST_ID:
            return bytes(message.data)
    return None


def main(place, seconds):
    with can.Bus() as bus:
        ticks = 2_000_000_000 // 50_000
        ask(bus, 0x7FF, pack_register(MOTOR, RegisterOp.WRITE, Rid.TIMEOUT, ticks.to_bytes(4, "little")))
        found = Feedback.unpack(ask(bus, MOTOR, SPECIAL + b"\xfd"), RANGES)
        ask(bus, MOTOR, SPECIAL + b"\xfc")
        careful = place == "held"
        command = MitCommand(found.p if careful else float(place), kp=50.0, kd=1.0).pack(RANGES)
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            answer = ask(bus, MOTOR, command)
            if careful and (answer is None or Feedback.unpack(answer, RANGES).status is not MotorStatus.ENABLED):
                break
            time.sleep(0.01)


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]))
