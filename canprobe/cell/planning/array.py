"""The array of a plan: what its taxels support, and the raw frames of one that is no CANopen node.

Force is a sum over taxels. A centroid needs a few of them under the patch. The second moments of a patch, and with them
its curvature, need about sixteen: on fewer they are those of the grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

from canprobe.cell.planning.model import MASTER_NODE_ID, PlannedFrames, PlannedPdo
from canprobe.cell.planning.traffic import frame_bits
from canprobe.cell.planning.window import patch_radius_m
from canprobe.cell.scene.setup import Array, Calibrate, Setup, Touch
from canprobe.errors import UsageError
from canprobe.fieldbus.protocol.frames import (
    EMCY_BASE,
    HEARTBEAT_BASE,
    NMT_ID,
    SDO_RX_BASE,
    SDO_TX_BASE,
    SYNC_ID,
    Frame,
)

What = Literal["image", "start", "stop", "poll"]
CENTROID_TAXELS, CURVATURE_TAXELS = 4, 16
"""Taxels under the patch from which there is a centroid, and second moments."""
COARSE_SHARE = 0.1
"""Share of a sphere's radius: taxels that are nearer to each other than this see the contact of 1 N from all sides."""


@dataclass(frozen=True, slots=True)
class Support:
    """What an array measures of the contact that its task makes.

    Attributes:
        taxels: under the patch on a plane at the task's force; all of them where nothing is pressed.
        centroid: there is one.
        no_curvature: why there is no curvature; None where there is one. Force is always there.
    """

    taxels: float
    centroid: bool
    no_curvature: str | None

    @property
    def curvature(self) -> bool:
        """The patch shows it."""
        return self.no_curvature is None

    def __str__(self) -> str:
        has = ["force", *(["centroid"] if self.centroid else []), *(["curvature"] if self.curvature else [])]
        text = " and ".join([", ".join(has[:-1]), has[-1]] if len(has) > 1 else has)
        return text if self.curvature else f"{text}; no curvature: {self.no_curvature}"


def support_of(setup: Setup) -> Support | None:
    """What the setup's array supports; None without one."""
    array, touch = setup.array, setup.touch
    if array is None:
        return None
    taxels = float(array.pad.taxels)
    if touch is not None and not array.pad.is_flat:
        patch = math.pi * patch_radius_m(touch.force, touch.probe) ** 2
        taxels = min(taxels, patch / array.pad.pitch_m**2)
    lacks = None
    if array.pad.is_flat:
        lacks = "the array is flat"
    elif not array.pad.is_grid:
        lacks = "the taxels are no grid"
    elif taxels < CURVATURE_TAXELS:
        lacks = f"fewer than {CURVATURE_TAXELS} taxels under the patch"
    return Support(taxels, taxels >= CENTROID_TAXELS, lacks)


def as_supported(setup: Setup) -> Setup:
    """The setup without curvature from the patch where its array shows none."""
    support, task = support_of(setup), setup.task
    if support is None or support.curvature or not isinstance(task, Touch) or task.shape is None:
        return setup
    return replace(setup, task=replace(task, shape=replace(task.shape, patch=False)))


def array_text(array: Array) -> str:
    """The array in a line."""
    pad = array.pad
    taxels = f"{pad.rows}×{pad.columns} taxels"
    where = "flat" if pad.mount_radius_m is None else f"on a sphere of radius {1e3 * pad.mount_radius_m:g} mm"
    spread = f"{1e3 * pad.pitch_m:g} mm apart" if pad.is_grid else "at given places"
    return f"{array.name}: {taxels} {spread}, {where}"


def array_problems(setup: Setup) -> Iterator[str]:
    """Why the task cannot be done with the array."""
    array, task, support = setup.array, setup.task, support_of(setup)
    if array is None or support is None:
        return
    if not array.pad.is_flat and array.pad.pitch_m > COARSE_SHARE * array.pad.radius_m:
        yield from _unreadable(array)
    what = 'task.kind = "scan"' if setup.scan is not None else 'task.kind = "calibrate"'
    if setup.scan is not None or isinstance(task, Calibrate):
        needs = "its contact must be able to move over the sphere of a probe; press or listen with it"
        if array.pad.is_flat:
            yield f'{what}: the array {array.name} is flat (sensor.mount = "flat"): {needs}'
        elif not array.pad.is_grid:
            yield f"{what}: the array {array.name} is a list of taxels (sensor.positions_mm), no grid: {needs}"
        elif not support.centroid:
            covers = f"the patch covers {support.taxels:.1f} taxels"
            why = f"fewer than {CENTROID_TAXELS} show no place; raise task.force_n, or take a finer array"
            yield f"{what}: {covers} of the array {array.name}, and {why}"
    if setup.scan is not None and not array.pad.is_flat:
        most = array.pad.pitch_m * array.rate_hz
        if setup.scan.speed > most:
            moves = 1e3 * setup.scan.speed / array.rate_hz
            yield (
                f"task.speed_mm_s = {1e3 * setup.scan.speed:g}: the contact would move {moves:.3g} mm from one image to"
                f" the next (sensor.rate_hz = {array.rate_hz:g}), more than the {1e3 * array.pad.pitch_m:g} mm between"
                f" taxels; lower it to {1e3 * most:.3g}"
            )


def _unreadable(array: Array) -> Iterator[str]:
    """That no force can be read from the array, because a contact falls between its taxels."""
    from canprobe.mechanics.touch.patch.image_model import make_patch_calibration  # late, as it imports scipy

    try:
        make_patch_calibration(array.calibration, array.pad)
    except UsageError:
        pad = array.pad
        yield (
            f"sensor.pitch_mm = {1e3 * pad.pitch_m:g}: on the sphere of probe.radius_mm = {1e3 * pad.radius_m:g} a"
            f" contact is too small for taxels so far apart, and the array {array.name} shows no force; take a finer"
            " array, or a larger sphere"
        )


# Raw frames.


def plan_raw_frames(setup: Setup) -> tuple[PlannedFrames, ...]:
    """The frames of an array that is no CANopen node, an entry for each identifier and sender."""
    array = setup.array
    if array is None or array.raw is None:
        return ()
    raw, channel = array.raw, array.channel

    def planned(what: What, can_id: int, lengths: list[int], rate_hz: float, *, sent: bool) -> PlannedFrames:
        bits = sum(frame_bits(length, setup.bus) for length in lengths)
        return PlannedFrames(can_id, channel, what, sent, len(lengths), max(lengths), rate_hz, bits)

    lengths = [frame.length for frame in raw.image.frames]
    found = [planned("image", can_id, lengths, array.rate_hz, sent=False) for can_id in raw.image.ids]
    commands: tuple[tuple[What, tuple[Frame, ...], float], ...] = (
        ("start", raw.start, 0.0),
        ("stop", raw.stop, 0.0),
        ("poll", raw.poll, array.rate_hz),
    )
    for what, frames, rate_hz in commands:
        for can_id in dict.fromkeys(can_id for can_id, _ in frames):
            mine = [len(data) for each, data in frames if each == can_id]
            found.append(planned(what, can_id, mine, rate_hz, sent=True))
    return tuple(found)


def raw_frame_problems(
    frames: tuple[PlannedFrames, ...], pdos: list[PlannedPdo], buses: Mapping[str, tuple[int, ...]], name: str
) -> list[str]:
    """Identifiers of raw frames that something else in the cell has.

    The cell knows what it receives by its identifier alone, whichever bus it comes from; what it sends goes to one bus.

    Args:
        frames: of the array.
        pdos: of all nodes.
        buses: node ids by channel.
        name: of the array.
    """
    problems = []
    received, on_bus = _identifiers(pdos, buses)
    for frame in frames:
        own = on_bus[frame.channel].get(frame.can_id)
        other = own or (None if frame.sent else received.get(frame.can_id))
        if other is None:
            continue
        if own:
            ways = f'on {frame.channel}; give it a bus of its own (sensor.channel = "can1"), or take other node ids'
        else:
            ways = "on another bus, and the cell knows what it receives by the identifier alone; take other node ids"
        problems.append(f"array {name}: its {frame.what} frame {frame.can_id:03X}h is {other} {ways}")
    if len(problems) > 1:
        return [f"{problems[0]} ({len(problems) - 1} more of its identifiers are taken too)"]
    return problems


def _identifiers(
    pdos: list[PlannedPdo], buses: Mapping[str, tuple[int, ...]]
) -> tuple[dict[int, str], dict[str, dict[int, str]]]:
    """What the cell receives on any bus, and all that is on each bus, by identifier."""
    received: dict[int, str] = {}
    on_bus: dict[str, dict[int, str]] = {}
    for channel, node_ids in buses.items():
        here = on_bus[channel] = {
            NMT_ID: "NMT",
            SYNC_ID: "SYNC",
            HEARTBEAT_BASE + MASTER_NODE_ID: "the heartbeat of the master",
        }
        for node_id in node_ids:
            its = {
                HEARTBEAT_BASE + node_id: f"the heartbeat of node {node_id}",
                EMCY_BASE + node_id: f"the EMCY of node {node_id}",
                SDO_TX_BASE + node_id: f"the SDO answer of node {node_id}",
            }
            mine = [pdo for pdo in pdos if pdo.node_id == node_id]
            its |= {pdo.cob_id: f"TPDO{pdo.number} of node {node_id}" for pdo in mine if pdo.direction == "tpdo"}
            received |= its
            here |= its | {SDO_RX_BASE + node_id: f"the SDO request to node {node_id}"}
            here |= {pdo.cob_id: f"RPDO{pdo.number} of node {node_id}" for pdo in mine if pdo.direction == "rpdo"}
    for common in (NMT_ID, SYNC_ID, HEARTBEAT_BASE + MASTER_NODE_ID):
        received[common] = next(iter(on_bus.values()))[common]
    return received, on_bus
