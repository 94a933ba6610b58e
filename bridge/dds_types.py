"""ROS 2 message types as types of Cyclone DDS, made from rosbags' definitions: one type store for all sinks.

A type made here carries messages that are CDR already, byte for byte. Built field by field it is serialised by
Cyclone itself, which the tests hold against rosbags.

Source: ROS 2's mapping to DDS: `pkg/msg/Name` is `pkg::msg::dds_::Name_`, final, plain CDR (XCDR1).
"""

from __future__ import annotations

import dataclasses
import types as python_types
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl import annotations as annotate
from cyclonedds.idl import types as idl

from canprobe.lab.bridge.messages import Encoder

_BASE: dict[str, Any] = {
    "bool": bool,
    "byte": idl.uint8,
    "char": idl.uint8,
    "string": str,
    **{f"{kind}{bits}": getattr(idl, f"{kind}{bits}") for kind in ("int", "uint") for bits in (8, 16, 32, 64)},
    "float32": idl.float32,
    "float64": idl.float64,
}
_NODE_BASE, _NODE_NAME, _NODE_ARRAY = 1, 2, 3


def _serialize(self: Any, buffer: Any = None, endianness: Any = None, use_version_2: Any = None) -> bytes:
    """The bytes for the wire, encapsulation included: those that a message carries, or its serialised fields."""
    carried = self.__dict__.get("carried")
    if carried is not None:
        return bytes(carried)
    return IdlStruct.serialize(self, buffer, endianness, use_version_2)


class DdsTypes:
    """The DDS types of one type store, each made at its first use.

    Args:
        encoder: encoder whose store has the message types.
    """

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self._made: dict[str, Any] = {}

    def of(self, type_name: str) -> Any:
        """The class of a ROS type, such as `sensor_msgs/msg/JointState`."""
        if type_name not in self._made:
            _, fields = self._encoder.store.fielddefs[type_name]
            self._made[type_name] = self._make(type_name, {name: self._field(node) for name, node in fields})
        return self._made[type_name]

    def carry(self, type_name: str, cdr: bytes) -> Any:
        """A message of a type whose bytes are sent unchanged."""
        cls = self.of(type_name)
        message = cls.__new__(cls)
        message.__dict__["carried"] = cdr
        return message

    def _make(self, type_name: str, fields: dict[str, Any]) -> Any:
        name = dds_name(type_name)

        def body(namespace: dict[str, Any]) -> None:
            namespace["__annotations__"].update(fields)
            namespace["__module__"] = __name__
            namespace["serialize"] = _serialize

        typename = {"typename": name.replace("::", ".")}
        cls = python_types.new_class(name.rpartition(":")[2], (IdlStruct,), typename, body)
        return annotate.final(dataclasses.dataclass(cls))

    def _field(self, node: tuple[Any, Any]) -> Any:
        kind, of = int(node[0]), node[1]
        if kind == _NODE_BASE:
            return _BASE[of[0]]
        if kind == _NODE_NAME:
            return self.of(of)
        inner, length = self._field(of[0]), of[1]
        if kind == _NODE_ARRAY:
            return idl.array[inner, length]  # type: ignore[misc]
        return idl.sequence[(inner, length) if length else inner]  # type: ignore[misc]


def dds_name(type_name: str) -> str:
    """Name of a type in DDS: `sensor_msgs/msg/JointState` → `sensor_msgs::msg::dds_::JointState_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"
