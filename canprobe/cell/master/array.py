"""The array as the cell receives it: whole images placed in time."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from canprobe.cell.master.tactile_frame import TactileFrame, TactileSample, decode
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Array, RawWire, Setup
from canprobe.errors import BusError, UsageError
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.period import PeriodFit
from canprobe.fieldbus.protocol.raw_image import ImageAssembler, RawImage
from canprobe.fieldbus.protocol.tactile import FrameAssembler, TactileHeader, TactileMode
from canprobe.mechanics.touch.pad import COUNTS_MAX
from canprobe.mechanics.types import Floats

if TYPE_CHECKING:
    from canprobe.cell.master.patch_reader import PatchReader

DEADLINE_CYCLES = 2
"""Longest time from the first PDO of a frame to its last, in cycles."""
JITTER_NS = 300_000
"""Largest contradiction between the stamps of a SYNC and a header: other loggers do not keep order."""
MAX_HEADER_AGE_CYCLES = 4
"""SYNCs after its trigger within which a header is accepted; the bus is planned for two."""
IMAGE_SPREAD_PERIODS = 0.75
"""Share of the period of raw images within which the frames of one come; so the next ones are not mixed with it."""


class ArrayReceiver(ABC):
    """Collects the frames of an array into images and hands each out with its place in time.

    Args:
        cob_ids: identifiers of its frames.
        channel: channel of their bus.

    Attributes:
        newest_cycle: cycle whose SYNC triggered the newest sample.
        stale: images dropped because they name no SYNC that they can have followed.
    """

    def __init__(self, cob_ids: Sequence[int], channel: str) -> None:
        self.cob_ids = tuple(cob_ids)
        self.channel = channel
        self.newest_cycle: int | None = None
        self.stale = 0

    @abstractmethod
    def assemble(self, can_id: int, data: bytes, t_ns: int) -> TactileFrame | None:
        """Take one frame; the image that it completes."""

    @abstractmethod
    def push(self, can_id: int, data: bytes, t_ns: int) -> None:
        """Take one frame, for `take`."""

    @abstractmethod
    def take(
        self, cycle: int, sync_counter: int, sync_times: Sequence[int], sync_stamps: Sequence[int] = ()
    ) -> TactileSample | None:
        """The image that becomes usable in ``cycle``, or None.

        Args:
            cycle: the present cycle; its SYNC has not been answered by this image.
            sync_counter: counter of the present cycle's SYNC; 0 where it has none.
            sync_times: times of the last SYNCs (ns), the present one last.
            sync_stamps: times at which they were sent, on the clock of the frames.
        """

    def requests(self, cycle: int) -> tuple[Frame, ...]:
        """Frames to send in a cycle so that an image comes."""
        return ()

    @property
    @abstractmethod
    def torn(self) -> int:
        """Count of images that were not whole."""

    @property
    def unusable(self) -> int:
        """Count of images and frames of images that could not be used."""
        return self.torn

    @property
    def lost(self) -> int:
        """Count of images that were sent and did not come, as far as the array counts them."""
        return 0


class TactileReceiver(ArrayReceiver):
    """Collects the PDOs of a CANopen node; each frame is handed out one cycle after its trigger.

    Args:
        assembler: puts the frames together.
        cob_ids: COB-IDs of its PDOs.
        sync_overflow: highest SYNC counter; after it comes 1.
        channel: channel of their bus.
    """

    def __init__(
        self, assembler: FrameAssembler, cob_ids: Sequence[int], sync_overflow: int, channel: str = ""
    ) -> None:
        super().__init__(cob_ids, channel)
        self.assembler = assembler
        self._overflow = sync_overflow
        self._complete: list[TactileFrame] = []

    def assemble(self, can_id: int, data: bytes, t_ns: int) -> TactileFrame | None:
        message = self.assembler.push(can_id, data, t_ns)
        return decode(message, self.assembler.shape) if message is not None else None

    def push(self, can_id: int, data: bytes, t_ns: int) -> None:
        frame = self.assemble(can_id, data, t_ns)
        if frame is not None:
            self.put(frame)

    def put(self, frame: TactileFrame) -> None:
        """Take a whole frame."""
        self._complete.append(frame)

    def take(
        self, cycle: int, sync_counter: int, sync_times: Sequence[int], sync_stamps: Sequence[int] = ()
    ) -> TactileSample | None:
        """The frame that becomes usable in ``cycle``.

        Without a SYNC counter a frame belongs to the last SYNC before its header.
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

    @property
    def torn(self) -> int:
        return self.assembler.torn + self.assembler.crc_errors + self.assembler.orphans

    @property
    def unusable(self) -> int:
        """Count of frames that were torn, malformed or sent twice."""
        return self.torn + self.assembler.malformed + self.assembler.duplicates

    @property
    def lost(self) -> int:
        return self.assembler.lost

    def _misplaced(self, frame: TactileFrame, cycles_ago: int, sync_stamps: Sequence[int]) -> bool:
        """The frame names a SYNC that it did not follow: one after its header, or one too long before it."""
        if not sync_stamps:
            return False
        if frame.t_ns + JITTER_NS < sync_stamps[-1 - cycles_ago]:
            return True
        # at -later stands the fifth SYNC behind its trigger (at -1 - cycles_ago); the header has to come before that
        later = cycles_ago - MAX_HEADER_AGE_CYCLES
        return later > 0 and sync_stamps[-later] <= frame.t_ns

    def _cycles_ago(self, frame: TactileFrame, sync_counter: int, sync_stamps: Sequence[int]) -> int:
        if sync_counter and frame.header.sync_counter:
            return (sync_counter - frame.header.sync_counter) % self._overflow
        return next((i for i, stamp in enumerate(reversed(sync_stamps)) if stamp <= frame.t_ns), len(sync_stamps))


class RawReceiver(ArrayReceiver):
    """Starts a device of raw frames, which knows no CANopen and has no NMT state, and collects its frames.

    The normal pressure of each taxel becomes a count as a CANopen array sends it: 0 without load, 255 at full scale.
    An image was sampled at the arrival of its first frame less the latency, as stated and as calibrated; the arrivals
    of a free-running device are fitted (`PeriodFit`).

    Args:
        array: an array that sends raw frames.
        ratio: cycles between two images of a polled device.

    Attributes:
        wire: description of the raw frames of the array.
        rate_hz: rate of its images.
    """

    def __init__(self, array: Array, ratio: int) -> None:
        assert array.raw is not None
        super().__init__(array.raw.image.ids, array.channel)
        self.wire: RawWire = array.raw
        self.rate_hz = array.rate_hz
        period_ns = 1e9 / array.rate_hz
        self.assembler = ImageAssembler(self.wire.image, round(IMAGE_SPREAD_PERIODS * period_ns))
        self._fit = PeriodFit(period_ns) if self.wire.sampling == "free" else None
        self._ratio = ratio
        self._unloaded: Floats | None = None
        if not self.wire.tare_images:
            self._unloaded = np.full(array.pad.shape, float(self.wire.unloaded))
        self._taring: list[Floats] = []
        self._complete: list[tuple[TactileFrame, int, float]] = []
        self._started = False

    def tare(self) -> None:
        """Take the mean of the next images for the unloaded value of each taxel.

        Raises:
            UsageError: the array file states that value.
        """
        if not self.wire.tare_images:
            raise UsageError("tare: the array file states wire.unloaded_counts; give it wire.tare_images instead")
        self._unloaded, self._taring = None, []

    def start(self, network: PumpedNetwork, boot_up_s: float, say: Callable[[str], None]) -> None:
        """Start the array, and wait for as many images as its tare takes, at least one.

        Args:
            network: network by which its frames arrive.
            boot_up_s: time for it to start.
            say: called with each step.

        Raises:
            BusError: they do not come.
        """
        wire, port, clock = self.wire, network.port, network.port.clock
        say(f"start the array on {self.channel}")
        self._started = True
        port.send_on(self.channel, wire.start)
        if wire.sampling == "sync":
            return  # its images begin with the cycle
        if wire.tare_images:
            say(f"tare the array: {wire.tare_images} images, with nothing on it")
        needed, period_s = max(1, wire.tare_images), 1.0 / self.rate_hz
        end_ns = clock.now_ns() + round(1e9 * (boot_up_s + 2.0 * needed * period_s))
        while (came := self.assembler.frames) < needed:
            if clock.now_ns() >= end_ns:
                first, last = min(self.cob_ids), max(self.cob_ids)
                ids = f"{first:03X}h" if first == last else f"{first:03X}h-{last:03X}h"
                raise BusError(
                    f"{self.channel}: the array sent {came} of {needed} images of its frames {ids} in time"
                    f" ({self.torn} were not whole); check its power, its channel (sensor.channel), and wire.ids,"
                    " wire.frames and wire.start of its array file"
                )
            if wire.poll:
                port.send_on(self.channel, wire.poll)
            network.pump_until(lambda: self.assembler.frames > came, 1.5 * period_s)

    def stop(self, port: Port) -> None:
        """Stop the array if it was started."""
        if self._started:
            self._started = False
            port.send_on(self.channel, self.wire.stop)

    def assemble(self, can_id: int, data: bytes, t_ns: int) -> TactileFrame | None:
        """Take one frame; the image that it completes, once the array is tared."""
        image = self.assembler.push(can_id, data, t_ns)
        return self._frame(image) if image is not None else None

    def push(self, can_id: int, data: bytes, t_ns: int) -> None:
        image = self.assembler.push(can_id, data, t_ns)
        if image is None:
            return
        instant, sigma = self._fit.step(image.t_ns) if self._fit is not None else (image.t_ns, 0.0)
        frame = self._frame(image)
        if frame is not None:
            wire = self.wire
            spread = math.hypot(sigma, wire.latency_sigma_s, wire.found_sigma_s)
            self._complete.append((frame, instant - round(1e9 * (wire.latency_s + wire.found_s)), spread))

    def take(
        self, cycle: int, sync_counter: int, sync_times: Sequence[int], sync_stamps: Sequence[int] = ()
    ) -> TactileSample | None:
        sample, early = None, []
        for frame, instant, sigma in self._complete:
            if instant > sync_stamps[-1]:
                early.append((frame, instant, sigma))
                continue
            ago = next((i for i, stamp in enumerate(reversed(sync_stamps)) if stamp <= instant), len(sync_stamps) - 1)
            sample = TactileSample(frame, sync_times[-1] + instant - sync_stamps[-1], cycle - ago, sigma)
            self.newest_cycle = sample.cycle
        self._complete = early
        return sample

    def requests(self, cycle: int) -> tuple[Frame, ...]:
        """Frames that poll a polled device in a cycle."""
        return self.wire.poll if self.wire.poll and cycle % self._ratio == 0 else ()

    @property
    def torn(self) -> int:
        return self.assembler.torn

    def _frame(self, image: RawImage) -> TactileFrame | None:
        """The image as a CANopen array would send it; None while it is taken for the tare."""
        wire = self.wire
        raw = np.array(image.counts).reshape(wire.image.rows, wire.image.columns, wire.image.axes)
        values = raw[:, :, wire.normal].astype(np.float64)
        if self._unloaded is None:
            self._taring.append(values)
            if len(self._taring) == wire.tare_images:
                self._unloaded = np.mean(self._taring, axis=0)
            return None
        loads = (values - self._unloaded) * (COUNTS_MAX / (wire.full_scale - wire.unloaded))
        taxels = np.clip(np.rint(loads), 0, COUNTS_MAX).astype(np.uint8)
        taxels.flags.writeable = False
        overload = bool(taxels.max() == COUNTS_MAX)
        header = TactileHeader(image.number % 256, 0, 0, 0, TactileMode.IMAGE, overload, 0)
        return TactileFrame(header, taxels, (0, 0, *taxels.shape), None, image.t_ns, raw)


def make_tactile(plan: Plan, sync_overflow: int | None = None) -> ArrayReceiver | None:
    """The receiver of the plan's array, None without one; `sync_overflow` where it is not the plan's."""
    array = plan.setup.array
    if array is None:
        return None
    if array.raw is not None:
        return RawReceiver(array, max(1, round(plan.setup.rate_hz / array.rate_hz)))
    pdos = plan.pdos_of(array.node_id, "tpdo")
    cob_ids = [pdo.cob_id for pdo in pdos]
    assembler = FrameAssembler(
        cob_ids,
        TactileMode[array.mode.upper()],
        DEADLINE_CYCLES * plan.sync.period_ns,
        [pdo.layout.length for pdo in pdos],
        window=int(array.window),
        shape=array.pad.shape,
    )
    return TactileReceiver(assembler, cob_ids, sync_overflow or plan.sync.overflow, array.channel)


def make_patch_reader(setup: Setup) -> PatchReader | None:
    """The reader of the setup's array; None without one."""
    if setup.array is None:
        return None
    from canprobe.cell.master.patch_reader import PatchReader
    from canprobe.mechanics.touch import make_patch_calibration

    return PatchReader(make_patch_calibration(setup.array.calibration, setup.array.pad))
