"""A node's stored parameters (1010h, 1011h, LSS) in a JSON file, so that they survive a restart of the process."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from canprobe.errors import CanprobeError, UsageError, check_schema
from canprobe.fieldbus.bus.files import write_text
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.node.slave_node import SlaveNode
from canprobe.fieldbus.protocol.lss import UNCONFIGURED_ID
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

SCHEMA = 1


def keep_in_file(node: SlaveNode, path: Path) -> None:
    """Read the file, if there is one; from now on write it at every "save" and "load", and when LSS stores an id.

    Call it before the node is started. A write that fails aborts the SDO with 06060000h, or LSS with error 2.

    Args:
        node: the node, not yet started.
        path: path of the file; its folder is made.

    Raises:
        UsageError: the file cannot be read, or holds the values of another device.
    """
    if path.exists():
        _read(node, path)

    def write() -> None:
        try:
            _write(node, path)
        except (OSError, CanprobeError) as error:
            raise SdoAbort(Abort.HARDWARE) from error

    node.store.changed = write


def _identity(node: SlaveNode) -> list[int]:
    return [node.dictionary.number(0x1018, subindex) for subindex in (1, 2, 3)]


def _write(node: SlaveNode, path: Path) -> None:
    content = {
        "schema": SCHEMA,
        "identity": _identity(node),
        "device": node.store.kept.hex(),
        **({} if node.store.node_id is None else {"node_id": node.store.node_id}),
        "values": {
            f"{key >> 8:04X}:{key & 0xFF:02X}": {"hex": value.hex()} if isinstance(value, bytes) else value
            for key, value in sorted(node.store.saved.items())
        },
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(content, indent=1))


def _read(node: SlaveNode, path: Path) -> None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        check_schema(path, content["schema"], SCHEMA, "remove it, and let the node store again")
        identity, texts, device = content["identity"], content["values"], bytes.fromhex(content["device"])
        values = {_key(text): _value(plain) for text, plain in texts.items()}
        node_id = _node_id(content.get("node_id"))
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise UsageError(f"{path}: no stored parameters of a node can be read from it: {error!r}") from error
    if identity != _identity(node):
        raise UsageError(f"{path}: stored by the device {identity}, {node.name} is {_identity(node)} (1018h:01 to 03)")
    for key, value in values.items():
        _check(node, path, key, value)
    node.store.saved, node.store.kept, node.store.node_id = values, device, node_id


def _node_id(value: Any) -> int | None:
    if value is None or value == UNCONFIGURED_ID or (type(value) is int and 1 <= value <= 127):
        return value  # type: ignore[no-any-return]
    raise ValueError(f"expected a node id from 1 to 127, or 255, got {value!r}")


def _key(text: str) -> int:
    index, subindex = text.split(":")
    return int(index, 16) << 8 | int(subindex, 16)


def _value(plain: Any) -> Value:
    if isinstance(plain, dict):
        return bytes.fromhex(plain["hex"])
    if isinstance(plain, bool) or not isinstance(plain, (int, float)):
        raise TypeError(f"expected a number or hex, got {plain!r}")
    return plain


def _check(node: SlaveNode, path: Path, key: int, value: Value) -> None:
    """Check that a value from the file is one of its entry, as the cyclic code packs it unchecked."""
    where = f"{path}: {key >> 8:04X}h:{key & 0xFF:02X}"
    entry = node.dictionary.entries.get(key)
    if entry is None:
        raise UsageError(f"{where}: the EDS of {node.name} has no such object")
    try:
        entry.from_bytes(entry.to_bytes(value))
        entry.check_limits(value)
        fits = isinstance(value, bytes) is not bool(entry.bits) and (bool(entry.real) or not isinstance(value, float))
    except (SdoAbort, OverflowError, ValueError) as error:
        raise UsageError(f"{where}: {value!r} is no value of it: {error}") from error
    if not fits:
        raise UsageError(f"{where}: {value!r} is no value of it: another data type")
