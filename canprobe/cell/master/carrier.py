"""The position of the object's carrier, as its encoder reports it at every SYNC."""

from __future__ import annotations

from canprobe.cell.planning.model import Plan
from canprobe.cell.planning.pdos import ENCODER_POSITION
from canprobe.cell.scene.setup import Carrier
from canprobe.errors import NodeError
from canprobe.fieldbus.protocol.pdo import PdoLayout

MAX_SPEED_SHARE = 1.5
"""Share of the stated speed above which a motion is not believed, from the last SYNC to the answer to this one."""
TOLERANCE_COUNTS = 2
"""Counts by which two readings may differ at rest."""


class CarrierReceiver:
    """Takes the TPDO of the encoder, whose counts begin again at 0 after their range.

    Args:
        layout: layout of the TPDO.
        carrier: the carrier.
        counts_range: range of the counts.
        period_ns: period of the cycle.
        silent_cycles: cycles without a position after which the carrier is lost: until then its motion is carried on.

    Attributes:
        cob_id: COB-ID of the TPDO.
    """

    def __init__(
        self, layout: PdoLayout, carrier: Carrier, counts_range: int, period_ns: int, silent_cycles: int
    ) -> None:
        self.cob_id, self._layout, self._carrier = layout.cob_id, layout, carrier
        self._silent_ns = silent_cycles * period_ns
        self._place = [(entry.index, entry.subindex) for entry in layout.signals].index(ENCODER_POSITION)
        self._range, self._period_ns = counts_range, period_ns
        self._sync_ns = self._heard_sync_ns = self._t_ns = self._total = 0
        self._counts: int | None = None
        self._heard_ns: int | None = None  # the first SYNC until it is heard
        self._jump: str | None = None

    def begin(self, t_ns: int, sync_ns: int) -> None:
        """Begin the cycle of a SYNC that was due at ``t_ns`` and sent at ``sync_ns``, on the clock of the frames."""
        self._t_ns, self._sync_ns = t_ns, sync_ns
        self._heard_ns = t_ns - self._period_ns if self._heard_ns is None else self._heard_ns

    def push(self, data: bytes, t_ns: int) -> None:
        """Take a TPDO that arrived at ``t_ns``; one from before the SYNC, or of another length, is not used."""
        if t_ns >= self._sync_ns and len(data) == self._layout.length:
            self.take(self.cob_id, self._layout.raw_unpack(data), t_ns)

    def take(self, cob_id: int, values: tuple[int, ...], t_ns: int) -> None:
        """Take the values of the TPDO; a position that the carrier cannot have reached is not believed."""
        counts, half, carrier = values[self._place], self._range // 2, self._carrier
        step = (counts - (carrier.zero if self._counts is None else self._counts) + half) % self._range - half
        passed_s = 1e-9 * (t_ns - self._heard_sync_ns + self._period_ns)  # a held-up machine sends its SYNC late
        most = MAX_SPEED_SHARE * carrier.units * carrier.speed * passed_s + TOLERANCE_COUNTS
        if self._counts is not None and abs(step) > most:
            self._jump = carrier.text(step / carrier.units)
            return
        self._total += step
        self._counts, self._heard_ns, self._heard_sync_ns = counts, self._t_ns, self._sync_ns

    @property
    def complete(self) -> bool:
        """The position of this cycle is in."""
        return self._heard_ns == self._t_ns

    @property
    def position(self) -> float | None:
        """Position at this SYNC, rad or m; None where none came that can be believed."""
        return self._total / self._carrier.units if self.complete else None

    @property
    def lost(self) -> NodeError | None:
        """Why the carrier's position is not known any more; None while it is."""
        carrier, silent_ns = self._carrier, self._t_ns - (self._heard_ns or 0)
        if self._jump is not None:
            most = f"{MAX_SPEED_SHARE:g} × {carrier.text(carrier.speed)}/s, its speed in [carrier]"
            return NodeError(carrier.node_id, f"(carrier) reports a jump by {self._jump}, faster than {most}")
        if silent_ns < self._silent_ns:
            return None
        return NodeError(carrier.node_id, f"(carrier) lost: no usable position for {silent_ns * 1e-6:g} ms")


def make_carrier(plan: Plan) -> CarrierReceiver | None:
    """The receiver of a plan; None where the object stands still."""
    if (carrier := plan.setup.carrier) is None:
        return None
    node = next(node for node in plan.nodes if node.node_id == carrier.node_id)
    (layout,) = [pdo.layout for pdo in plan.pdos_of(carrier.node_id, "tpdo")]
    missed = plan.setup.needed_arm().missed_syncs  # nothing else feels a moving object
    return CarrierReceiver(layout, carrier, node.counts_range, plan.sync.period_ns, missed + 1)
