"""The array as the cell receives it: whole frames placed in time, and the patch that they show."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from canprobe.cell.controller import TactileSample
from canprobe.planning.model import Plan
from canprobe.protocol.tactile import FrameAssembler, TactileFrame, TactileMode
from canprobe.scene.setup import Setup
from canprobe.touch.patch.image import Patch, PatchCalibration, compute_patch, patch_from_features

DEADLINE_CYCLES = 2
"""From the first PDO of a frame to its last."""
JITTER_NS = 300_000
"""By how much the stamps of a SYNC and a header may contradict each other: other loggers do not keep order."""
LATEST_CYCLES = 4
"""SYNCs after its trigger up to which a header is believed; the bus is planned for two."""


class TactileReceiver:
    """Collects tactile PDOs into frames and hands each out one cycle after its trigger.

    Args:
        assembler: puts the frames together.
        cob_ids: of its PDOs.
        sync_overflow: at which the SYNC counter starts again.

    Attributes:
        newest_cycle: trigger of the newest sample.
        stale: frames dropped because they name no SYNC that they can have followed.
    """

    def __init__(self, assembler: FrameAssembler, cob_ids: Sequence[int], sync_overflow: int) -> None:
        self.assembler = assembler
        self.cob_ids = tuple(cob_ids)
        self.newest_cycle: int | None = None
        self.stale = 0
        self._overflow = sync_overflow
        self._complete: list[TactileFrame] = []

    def push(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take one tactile PDO."""
        frame = self.assembler.push(can_id, data, t_ns)
        if frame is not None:
            self.put(frame)

    def put(self, frame: TactileFrame) -> None:
        """Take a whole frame."""
        self._complete.append(frame)

    def take(
        self, cycle: int, sync_counter: int, sync_times: Sequence[int], sync_stamps: Sequence[int] = ()
    ) -> TactileSample | None:
        """The frame that becomes usable in ``cycle``, or None.

        Args:
            cycle: the present cycle; its SYNC has not been answered by this frame.
            sync_counter: counter of the present cycle's SYNC; 0 where it has none.
            sync_times: times of the last SYNCs (ns), the present one last.
            sync_stamps: when they went out, on the clock of the frames. Without a counter a frame belongs to the last
                SYNC before its header.
        """
        if not self._complete:
            return None
        sample, early = None, []
        for frame in self._complete:
            cycles_ago = self._cycles_ago(frame, sync_counter, sync_stamps)
            if cycles_ago == 0 and not self._misplaced(frame, 0, sync_stamps):
                early.append(frame)
            elif cycles_ago >= len(sync_times) or self._misplaced(frame, cycles_ago, sync_stamps):
                self.stale += 1
            else:
                t_sample = sync_times[-1 - cycles_ago] - frame.header.sample_age_us * 1000
                sample = TactileSample(frame, t_sample, cycle - cycles_ago)
                self.newest_cycle = sample.cycle
        self._complete = early
        return sample

    def _misplaced(self, frame: TactileFrame, cycles_ago: int, sync_stamps: Sequence[int]) -> bool:
        """The frame names a SYNC that it did not follow: one after its header, or one too long before it."""
        if not sync_stamps:
            return False
        if frame.t_ns + JITTER_NS < sync_stamps[-1 - cycles_ago]:
            return True
        later = cycles_ago - LATEST_CYCLES
        return later > 0 and sync_stamps[-later] <= frame.t_ns

    def _cycles_ago(self, frame: TactileFrame, sync_counter: int, sync_stamps: Sequence[int]) -> int:
        if sync_counter and frame.header.sync_counter:
            return (sync_counter - frame.header.sync_counter) % self._overflow
        return next((i for i, stamp in enumerate(reversed(sync_stamps)) if stamp <= frame.t_ns), len(sync_stamps))


def make_tactile(plan: Plan, sync_overflow: int | None = None) -> TactileReceiver | None:
    """The receiver of the plan's array, None without one; `sync_overflow` where it is not the plan's."""
    array = plan.setup.array
    if array is None:
        return None
    pdos = plan.pdos_of(array.node_id, "tpdo")
    cob_ids = [pdo.cob_id for pdo in pdos]
    assembler = FrameAssembler(
        cob_ids,
        TactileMode[array.mode.upper()],
        DEADLINE_CYCLES * plan.sync.period_ns,
        [pdo.layout.length for pdo in pdos],
        window=int(array.window),
    )
    return TactileReceiver(assembler, cob_ids, sync_overflow or plan.sync.overflow)


def patch_of(sample: TactileSample, calibration: PatchCalibration) -> Patch:
    """Patch of a tactile sample, in every mode of the array."""
    frame = sample.frame
    if frame.features is not None:
        return patch_from_features(frame.features, calibration)
    return compute_patch(frame.taxels, calibration, window=frame.window)


def patch_from(setup: Setup) -> Callable[[TactileSample], Patch] | None:
    """The patch of a sample of the setup's array; None without one."""
    if setup.array is None:
        return None
    from canprobe.touch.patch.array_model import array_calibration

    calibration = array_calibration(setup.array.full_scale, setup.probe.radius)
    return lambda sample: patch_of(sample, calibration)
