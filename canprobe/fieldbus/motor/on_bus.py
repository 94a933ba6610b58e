"""Motors on one bus: what a command line says of them, and identifiers that two devices would share."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from canprobe.errors import UsageError, did_you_mean
from canprobe.fieldbus.motor.damiao import DamiaoMotor
from canprobe.fieldbus.motor.protocol import REGISTER_ID, TYPES


def motors_on_bus(
    names: Sequence[str], ids: Sequence[int], mst_ids: Sequence[int], node_ids: Collection[int] = ()
) -> list[DamiaoMotor]:
    """The motors of a command line, compared with each other and with the CANopen nodes beside them.

    Args:
        names: make and type of each, such as `damiao:dm4310`.
        ids, mst_ids: ESC_ID and MST_ID of each; where no MST_ID is given, all are 0.
        node_ids: ids of the nodes, whose identifiers are those of CANopen's predefined connection set.

    Raises:
        UsageError: a type is unknown, an id is missing, or two devices would share an identifier.
    """
    if len(ids) != len(names) or len(mst_ids) not in (0, len(names)):
        given = f"{len(names)} --motor, {len(ids)} --id, {len(mst_ids)} --mst-id"
        raise UsageError(f"{given}: each motor needs its --id, and all of them an --mst-id or none")
    types = {f"damiao:{name}": name for name in TYPES}
    taken = {REGISTER_ID: "requests for registers"} | ({0: "NMT", 0x80: "SYNC", 0x100: "TIME"} if node_ids else {})
    taken |= {base + one: f"a frame of node {one}" for one in node_ids for base in range(0x80, 0x780, 0x80)}
    motors = []
    for name, motor_id, mst_id in zip(names, ids, mst_ids or [0] * len(ids), strict=True):
        if name not in types:
            raise UsageError(f"--motor {name}: expected one of {', '.join(types)}{did_you_mean(name, types)}")
        if motor_id in node_ids or ids.count(motor_id) > 1:
            raise UsageError(f"--id {motor_id}: another device hears {0x200 + motor_id:03X}h too; give another --id")
        if mst_id in taken or mst_id & 0xFF in ids:
            what = taken.get(mst_id, "a command to a motor, which compares the low byte alone")
            free = next(one for one in range(0x10 + motor_id, 0x7FF) if one not in taken and one & 0xFF not in ids)
            raise UsageError(f"--mst-id {mst_id:#x} of motor {motor_id} is {what}; give --mst-id {free:#x}")
        motors.append(DamiaoMotor(types[name], motor_id, mst_id))
    return motors
