"""Faults of the tactile array: rows, images and frames that are wrong; and the registry with them."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import numpy as np

from canprobe.cell.emulated.array import Raw, TactileApplication
from canprobe.errors import UsageError
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.tools.faults.fault import Effect, Fault, FaultKind, Host
from canprobe.fieldbus.tools.faults.frame_faults import tactile_ids
from canprobe.fieldbus.tools.faults.registry import BUS_FAULTS, kinds_of
from canprobe.mechanics.touch.pad import COUNTS_MAX
from canprobe.mechanics.types import Floats

_CRC_BYTE = 6
"""First byte of the CRC in a tactile header."""


class ArrayEffect(Effect):
    """Base class of the faults of a tactile array."""

    needs = "array"


class ImageFault(ArrayEffect):
    """Base class of faults of the image that the array samples."""

    def __init__(self, fault: Fault, host: Host) -> None:
        super().__init__(fault, host)
        if not isinstance(self.node.application, TactileApplication):
            raise UsageError(f"{self.node.name}: fault {fault.kind.name} needs a CANopen array")
        self._array = self.node.application
        self._begun_ns = 0

    def begin(self, t_ns: int) -> None:
        self._begun_ns = t_ns
        self._array.distortions.append(self._sampled)

    def end(self, t_ns: int) -> None:
        self._array.distortions.remove(self._sampled)

    def _sampled(self, raw: Raw, t_ns: int) -> Raw:
        self.host.hits += 1
        image = raw.copy()
        self.change(image, (t_ns - self._begun_ns) * 1e-9)
        return image

    def change(self, image: Raw, held_s: float) -> None:
        """Change the image that is sampled, of counts; `held_s`: time since the beginning, s."""

    def rows(self) -> slice:
        """The rows of taxels that it hits."""
        first = int(self.fault.value("first"))
        return slice(first, first + int(self.fault.value("rows")))


class DeadRows(ImageFault):
    """Some rows of taxels measure nothing."""

    name = "dead-rows"

    def change(self, image: Raw, held_s: float) -> None:
        image[self.rows()] = 0


class StuckImage(ImageFault):
    """The array samples the same image again and again; its counters go on."""

    name = "stuck-image"
    _kept: Raw | None = None

    def change(self, image: Raw, held_s: float) -> None:
        self._kept = image.copy() if self._kept is None else self._kept
        image[...] = self._kept


class ReplayedImage(ImageFault):
    """The array records a stretch of its own images, then replays it without an end, with noise of its own.

    One image with fresh noise looks alive, and so does a recorded stretch: no image of it equals the one before.
    """

    name = "replayed-image"

    def begin(self, t_ns: int) -> None:
        self._recorded: list[Raw] = []
        self._replayed = 0
        self._noise = np.random.default_rng(self.fault.seed)
        super().begin(t_ns)

    def change(self, image: Raw, held_s: float) -> None:
        if len(self._recorded) < int(self.fault.value("images")):
            self._recorded.append(image.copy())
            return
        shown = self._recorded[self._replayed % len(self._recorded)]
        self._replayed += 1
        noise = self.fault.value("noise") * self._noise.standard_normal(shown.shape)
        _set(image, np.where(shown > 0, shown + noise, 0.0))  # what is below the threshold reads zero with noise, too


class GainLost(ImageFault):
    """Every taxel measures a share of its load."""

    name = "gain-lost"

    def change(self, image: Raw, held_s: float) -> None:
        _set(image, self.fault.value("gain") * image.astype(np.float64))


class StuckRows(ImageFault):
    """Some rows of taxels keep their last values; the others go on."""

    name = "stuck-rows"
    _kept: Raw | None = None

    def change(self, image: Raw, held_s: float) -> None:
        self._kept = image.copy() if self._kept is None else self._kept
        image[self.rows()] = self._kept[self.rows()]


class Drift(ImageFault):
    """All taxels drift, up or down, in whole counts where the array has such."""

    name = "drift"

    def change(self, image: Raw, held_s: float) -> None:
        image[...] = np.clip(image + self.fault.value("counts_s") * held_s, 0, COUNTS_MAX)


class Saturation(ImageFault):
    """Every taxel that is pressed is at full scale."""

    name = "saturation"

    def change(self, image: Raw, held_s: float) -> None:
        image[image > 0] = COUNTS_MAX


def _set(image: Raw, counts: Floats) -> None:
    """Set an image to counts within the scale, and whole where its own are."""
    image[...] = np.clip(np.rint(counts) if image.dtype == np.uint8 else counts, 0, COUNTS_MAX)


class Torn(ArrayEffect):
    """One PDO of each tactile frame is lost, the header never."""

    name = "torn"

    def batch(self, frames: list[Frame], t_ns: int) -> list[Frame]:
        taxels = tactile_ids(self.node)[1:]
        there = [frame for frame in frames if frame[0] in taxels]
        if not there or self.rng.random() >= self.fault.share:
            return frames
        self.host.hits += 1
        lost = self.rng.choice(there)
        return [frame for frame in frames if frame is not lost]


class HeaderCrc(ArrayEffect):
    """A bit of the CRC of each tactile header is wrong."""

    name = "header-crc"

    def frame(self, frame: Frame, t_ns: int) -> Sequence[Frame] | None:
        can_id, data = frame
        if can_id not in tactile_ids(self.node)[:1] or len(data) <= _CRC_BYTE:
            return None
        return ((can_id, data[:_CRC_BYTE] + bytes((data[_CRC_BYTE] ^ 1,)) + data[_CRC_BYTE + 1 :]),)


CELL_FAULTS: Mapping[str, FaultKind] = {**BUS_FAULTS, **kinds_of(sys.modules[__name__])}
"""Kinds of faults of the nodes of a cell by name."""
