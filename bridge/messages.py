"""Encoder of ROS 2 messages, and their definitions: message → CDR.

The encoder is `rosbags`. Source: ROS 2 Jazzy's message definitions as rosbags carries them; can_msgs of ros_canopen and
ros2_socketcan_msgs, which it does not carry.
"""

from __future__ import annotations

import struct
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from canprobe.fieldbus.protocol.frames import EFF_FLAG, RTR_FLAG

CAN_FRAME = "can_msgs/msg/Frame"
CAN_FD_FRAME = "ros2_socketcan_msgs/msg/FdFrame"
_CAN_FRAME_MSG = """\
std_msgs/Header header
uint32 id
bool is_rtr
bool is_extended
bool is_error
uint8 dlc
uint8[8] data
"""

_CAN_FD_FRAME_MSG = """\
std_msgs/Header header
uint32 id
bool is_extended
bool is_error
uint8 len
uint8[<=64] data
"""
_CAN_FRAME_CDR = struct.Struct("<4siIIB3xI???B8s")
"""Encapsulation, stamp, an empty frame_id, id, three flags, dlc, data: a cycle has twenty such frames."""
_LITTLE_ENDIAN = b"\x00\x01\x00\x00"


def encode_can_frame(t_ns: int, can_id: int, data: bytes) -> bytes:
    """A `can_msgs/msg/Frame` as the encoder makes it, for a fiftieth of its time.

    Args:
        t_ns: time since the epoch.
        can_id: identifier with `EFF_FLAG` and `RTR_FLAG`.
        data: data, up to 8 bytes.
    """
    seconds, ns = divmod(t_ns, 1_000_000_000)
    identifier, extended = _identifier(can_id)
    remote = bool(can_id & RTR_FLAG)
    return _CAN_FRAME_CDR.pack(_LITTLE_ENDIAN, seconds, ns, 1, 0, identifier, remote, extended, False, len(data), data)


def _identifier(can_id: int) -> tuple[int, bool]:
    """The identifier without flags, and whether it has 29 bits."""
    extended = bool(can_id & EFF_FLAG)
    return can_id & (0x1FFFFFFF if extended else 0x7FF), extended


class Encoder:
    """ROS 2 messages → CDR, their definitions, and their RIHS01 hashes; one for each sink.

    Attributes:
        store: type store of rosbags; `types[name]` are the message classes.
    """

    def __init__(self) -> None:
        self.store: Any = get_typestore(Stores.ROS2_JAZZY)
        self.store.register(get_types_from_msg(_CAN_FRAME_MSG, CAN_FRAME))
        self.store.register(get_types_from_msg(_CAN_FD_FRAME_MSG, CAN_FD_FRAME))

    def encode(self, type_name: str, message: object) -> bytes:
        """A message as CDR, little-endian, with its four bytes of encapsulation."""
        return bytes(self.store.serialize_cdr(message, type_name))

    def decode(self, type_name: str, data: bytes) -> Any:
        """The inverse of `encode`."""
        return self.store.deserialize_cdr(data, type_name)

    def definition(self, type_name: str) -> str:
        """The definition for MCAP's `ros2msg` and Foxglove, with all types that it refers to."""
        text, _ = self.store.generate_msgdef(type_name, ros_version=2)
        return str(text)

    def type_hash(self, type_name: str) -> str:
        """The hash `RIHS01_…`, which ROS 2 compares before it connects (REP 2016)."""
        return str(self.store.hash_rihs01(type_name))
