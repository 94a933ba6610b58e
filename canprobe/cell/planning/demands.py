"""Needs of every node: objects, each with its purpose, and the bit rate of the bus."""

from __future__ import annotations

from collections.abc import Mapping

from canprobe.cell.planning.abilities import Abilities
from canprobe.cell.planning.model import NodeKind
from canprobe.cell.scene.setup import Setup

_EVERY_NODE: Mapping[int, str] = {
    0x1000: "device type",
    0x1005: "COB-ID of SYNC",
    0x1017: "producer heartbeat",
    0x1018: "identity",
}
_OF_KIND: Mapping[NodeKind, Mapping[int, str]] = {
    "drive": {
        0x6040: "controlword",
        0x6041: "statusword",
        0x6060: "modes of operation",
        0x6061: "modes of operation display",
        0x6064: "position actual value",
    },
    "tactile": {0x2000: "tactile mode"},
}


def missing_objects(device: Abilities, kind: NodeKind, setup: Setup) -> list[str]:
    """One line for every object that the EDS lacks."""
    needed = {**_EVERY_NODE, **_OF_KIND[kind]}
    section = "arm" if kind == "drive" else "sensor"
    return [
        f"{section}.eds = {device.eds}: object {index:04X}h ({what}) is missing; scene {setup.name} needs it"
        for index, what in needed.items()
        if index not in device.od.indices
    ]


def missing_bitrate(device: Abilities, kind: NodeKind, setup: Setup) -> list[str]:
    """One line where the EDS lists bit rates and that of the bus is not among them."""
    bitrates = device.description.bitrates
    if not bitrates or setup.bus.bitrate in bitrates:
        return []
    section = "arm" if kind == "drive" else "sensor"
    has = ", ".join(map(str, bitrates))
    return [f"bus.bitrate = {setup.bus.bitrate}: {section}.eds = {device.eds} has {has} bit/s"]
