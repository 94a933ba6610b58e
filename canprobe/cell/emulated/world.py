"""Makes the emulated side of a plan: one plant, its nodes, and the recorder of the truth."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.emulated.array import RawArray, TactileApplication
from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.node_configuration import NodeConfiguration
from canprobe.cell.planning.units import FEED, GEAR_RATIO, RESOLUTION
from canprobe.cell.plant.config import PlantConfig, PressMotion
from canprobe.cell.plant.plant import Plant, truth_columns
from canprobe.cell.plant.taxels import TaxelConfig
from canprobe.cell.rows import BLOCK_ROWS, ROWS_SUFFIX, TRUTH_PHASE, LazyColumns, Rows, joint_columns
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.eds.packaged import FULL_SCALE, has_known, load_eds
from canprobe.fieldbus.node.slave_node import SlaveNode, set_serial_number
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame
from canprobe.fieldbus.protocol.lss import UNCONFIGURED_ID
from canprobe.mechanics.robot.chain import Chain, forward
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.fieldbus.tools.faults import Fault, FaultyNodes

NAMES = {
    "probe_centre": "probe_centre_m",
    "force": "force_n",
    "depth": "depth_m",
    "depth_rate": "depth_rate_m_s",
    "contact_point": "contact_point_m",
    "kappa": "kappa_per_m",
    "pad_uv": "pad_uv_m",
}
"""Name in the plant, where all is SI without a suffix → name in `truth.npz`. Other columns have no unit."""


def with_units(columns: Mapping[str, NDArray[Any]], prismatic: Sequence[bool]) -> dict[str, NDArray[Any]]:
    """The plant's columns, as `Plant.truths` names them and others, under the names of the file.

    The joints `q` are `q_rad` and `q_m`, as in `log.npz`, by which of them slide.
    """
    named: dict[str, NDArray[Any]] = {}
    slides = np.array(prismatic, dtype=bool) if any(prismatic) else None
    for name, column in columns.items():
        named |= joint_columns("q", column, slides) if name == "q" else {NAMES.get(name, name): column}
    return named


TRUTH_BLOCK = 20
"""SYNCs whose truth becomes rows together: a row alone costs twice as much, those of half a second hold a cycle up."""


class TruthRecorder(Participant):
    """A silent participant of the bus that notes the plant's state at every SYNC, beside what the nodes measure.

    Args:
        plant: plant whose truth is recorded.
        at_once: whether what is true is computed at each SYNC. In real time it would make the nodes' next answers late,
            and is computed afterwards.
        folder: folder for the blocks, in a file ``truth.npy.gz``; None keeps them in memory.

    Attributes:
        origin_ns: time on the bus's clock that is 0 in the column ``t_s``.
        rows: rows of the states whose truth is computed; None before the first.
    """

    name = "truth recorder"
    hears_every_sync = True
    listens = frozenset((SYNC_ID,))

    def __init__(self, plant: Plant, *, at_once: bool = False, folder: Path | None = None) -> None:
        self._plant = plant
        self._at_once = at_once
        self._file = folder / f"truth{ROWS_SUFFIX}" if folder is not None else None
        self.origin_ns = 0
        self.rows: Rows | None = None
        self._stamps: list[tuple[int, int]] = []
        self._seen: list[Any] = []  # truths where they are computed at once, else states

    def receive(self, can_id: int, data: bytes, t_ns: int) -> list[Frame]:
        if can_id == SYNC_ID:
            self._plant.advance(t_ns)
            self._stamps.append((t_ns, data[0] if data else 0))
            self._seen.append(self._plant.truth_row() if self._at_once else self._plant.state())
            if self._at_once and len(self._seen) >= TRUTH_BLOCK:
                rows = self._compute()
                if len(rows) % BLOCK_ROWS == TRUTH_PHASE:
                    rows.flush()
        return []

    def columns(self) -> LazyColumns:
        """A row for each SYNC: t_s (s), sync_count (0, 1, …), sync_counter (of the frame, 0 without), the truth."""
        rows = self._compute()
        rows.flush()  # they stay there where the columns find no place on the disk
        return rows.columns()

    def remove(self) -> None:
        """Remove the file; its rows are in ``truth.npz`` by now."""
        if self.rows is not None:
            self.rows.remove()

    def _compute(self) -> Rows:
        """Make rows of what waits."""
        if not self._stamps and self.rows is not None:
            return self.rows
        stamps, seen = self._stamps, self._seen
        self._stamps, self._seen = [], []
        model = self._plant.config.model
        found = truth_columns(seen) if self._at_once else self._plant.truths(seen)
        columns: dict[str, NDArray[Any]] = {
            "t_s": np.array([t_ns - self.origin_ns for t_ns, _ in stamps], dtype=np.float64) * 1e-9,
            "sync_count": np.arange(len(stamps), dtype=np.int64) + (0 if self.rows is None else len(self.rows)),
            "sync_counter": np.array([counter for _, counter in stamps], dtype=np.int64),
            **{name: column if column.dtype == bool else np.asarray(column, float) for name, column in found.items()},
        }
        named = with_units(columns, () if model is None else model.chain.prismatic)
        if self.rows is None:
            fields = [(name, column.dtype, column.shape[1:]) for name, column in named.items()]
            self.rows = Rows(fields, self._file, level=0)
        table = np.empty(len(stamps), self.rows.dtype)
        for name in self.rows.dtype.names or ():
            table[name] = named[name]
        self.rows.add(table.tobytes())
        return self.rows


def _set_turn_units(node: SlaveNode, units: float | None) -> None:
    """The factor group of a device that was delivered for this cell, where its EDS has one: units of a motor turn."""
    delivered = node.dictionary.delivered
    ratio = (delivered(GEAR_RATIO, 1) or 1) / (delivered(GEAR_RATIO, 2) or 1)
    for index, value in ((RESOLUTION, units), (FEED, None if units is None else units * ratio)):
        if value is not None and float(value).is_integer() and delivered(index, 1) and delivered(index, 2) in (0, 1):
            node.dictionary.set_default(index, 1, int(value))


@dataclass(frozen=True, slots=True)
class World:
    """The emulated nodes and the plant that they share.

    Attributes:
        nodes: the slaves, ascending by node id.
        plant: arm, probe, object and array.
        recorder: notes the truth at every SYNC; None where it is not wanted, as it grows with time.
        raw_array: an array that is no node; None without one.
        participants: participants of the bus: the nodes, or after `make_faulty` what stands between a node and the bus,
            and the recorder, which listens only.
    """

    nodes: tuple[SlaveNode, ...]
    plant: Plant
    recorder: TruthRecorder | None
    raw_array: RawArray | None = None
    participants: list[Any] = field(init=False)

    def __post_init__(self) -> None:
        others = [one for one in (self.raw_array, self.recorder) if one is not None]
        object.__setattr__(self, "participants", [*self.nodes, *others])

    def make_faulty(self, faults: Iterable[Fault] = ()) -> FaultyNodes:
        """Let the nodes have faults, these and others that are thrown later; called before the buses open."""
        from canprobe.cell.emulated.array_faults import CELL_FAULTS
        from canprobe.fieldbus.tools.faults import FaultyNode, FaultyNodes

        thrown = tuple(faults)
        faulty = [FaultyNode(node, thrown) for node in self.nodes]
        self.participants[: len(faulty)] = faulty
        return FaultyNodes(faulty, CELL_FAULTS)


def make_world(
    plan: Plan,
    node_ids: Collection[int],
    *,
    truth: bool = True,
    at_once: bool = False,
    folder: Path | None = None,
    without_id: Collection[int] = (),
    homed: bool = True,
) -> World:
    """The emulated nodes of a plan, behind one plant.

    Where the scene gives a node no serial number, its node id in the scene is one.

    Args:
        plan: plan of the scene.
        node_ids: ids of the nodes to emulate.
        truth: whether the truth is recorded.
        at_once, folder: as for `TruthRecorder`.
        without_id: ids of the nodes that start without a node id and wait for LSS to give them one.
        homed: drives that have to be homed start with their zeros, and keep them.
    """
    plant = Plant(_plant_config(plan.setup), waits=True)
    nodes = []
    for node in plan.nodes:
        if node.node_id not in node_ids:
            continue
        node_id = UNCONFIGURED_ID if node.node_id in without_id else node.node_id
        nodes.append(_node(plan.setup, node, node_id, plant, homed))
    recorder = TruthRecorder(plant, at_once=at_once, folder=folder) if truth else None
    return World(tuple(nodes), plant, recorder, _raw_array(plan.setup, plant))


def _raw_array(setup: Setup, plant: Plant) -> RawArray | None:
    """The emulated array of a setup where it is no node."""
    array = setup.array
    if array is None or array.raw is None or not array.emulated:
        return None
    return RawArray(array, plant, sync_ratio=max(1, round(setup.rate_hz / array.rate_hz)), seed=setup.seed)


def _node(setup: Setup, planned: NodeConfiguration, node_id: int, plant: Plant, homed: bool) -> SlaveNode:
    dictionary = planned.dictionary
    speaks_lss = node_id == UNCONFIGURED_ID or dictionary.device_information.LSS_supported
    od_of = partial(load_eds, planned.eds) if speaks_lss else None
    if planned.kind == "drive":
        from canprobe.fieldbus.drive.drive import make_drive_node
        from canprobe.fieldbus.drive.units import Delivery

        assert setup.arm is not None
        axis = setup.arm.node_ids.index(planned.node_id)
        drive = setup.arm.drives[axis]
        node = make_drive_node(
            dictionary,
            node_id,
            axis,
            plant,
            od_of,
            delivery=Delivery(drive.turn_units, drive.metre_units, setup.arm.missed_syncs),
            quirks=drive.quirks,
            incremental=drive.zero is not None and not homed,
            seed=setup.seed,
        )
        _set_turn_units(node, drive.turn_units)
    elif planned.kind == "encoder":
        from canprobe.cell.emulated.encoder import EncoderApplication

        assert setup.carrier is not None
        application = EncoderApplication(plant, setup.carrier, planned.counts_range)
        node = SlaveNode(dictionary, node_id, application, od_of=od_of)
    else:
        assert setup.array is not None
        node = SlaveNode(dictionary, node_id, TactileApplication(plant, pad=setup.array.pad), od_of=od_of)
        if has_known(dictionary, FULL_SCALE):
            node.dictionary.set_default(FULL_SCALE, 0, round(setup.array.pad.full_scale_pa))
    serial = planned.identity.serial_number
    set_serial_number(node, planned.node_id if serial is None else serial)
    if node.lss is not None:
        node.lss.bitrate = setup.bus.bitrate
    return node


def _plant_config(setup: Setup) -> PlantConfig:
    truth, array = setup.truth, setup.array
    # an array that takes a tare at the beginning takes it off the object; with a reserve
    tared_s = 0.0 if array is None or array.raw is None else 1.5 * array.raw.tare_images / array.rate_hz
    config = PlantConfig(
        model=truth.model,
        T_flange_probe_centre=truth.T_flange_probe,
        radius_m=setup.probe.radius,
        stiffness_n_m3=truth.stiffness,
        damping_s_m=truth.damping,
        object=truth.object,
        taxels=None
        if array is None
        else TaxelConfig(full_scale_pa=array.pad.full_scale_pa, adc_bits=truth.adc_bits, dead=truth.dead).without(
            *truth.without
        ),
        pad=array.pad if array is not None else Pad(),
        bandwidth_hz=truth.bandwidth_hz,
        press=PressMotion(after_s=tared_s),
        seed=setup.seed,
        carrier=setup.carrier,
    )
    if setup.arm is None or truth.model is None:
        return config
    from canprobe.cell.planning.motion import parked_posture

    q0 = parked_posture(setup, setup.arm)
    return replace(
        config,
        q0=q0,
        fidelity=truth.fidelity,
        dynamics=truth.dynamics,
        bodies=truth.bodies,
        compliance=truth.compliance,
        base_offset_m=_base_offset(setup.arm.model.chain, truth.model.chain, q0, setup.probe.T_flange_probe),
    )


def _base_offset(believed: Chain, real: Chain, q: Floats, T_flange_probe: Floats) -> Floats:
    """Position of the real arm's base in the controller's base frame, (3,), m.

    An experimenter moves the arm to the object and takes that place for what the encoders show: both arms hold the
    probe at one place in the first posture.
    """
    return ((forward(believed, q) - forward(real, q)) @ T_flange_probe)[:3, 3]
