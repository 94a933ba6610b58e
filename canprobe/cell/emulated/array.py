"""Emulated arrays: the tactile node, with window, full image or features, and an array of raw frames.

A raw image is processed before it is sent: tare, gain, threshold, the window that follows the contact, features.

The node sends one whole frame a trigger, which is a SYNC at which the header's TPDO is due. The array is sampled there;
what goes out is the image of an earlier trigger, because a real sensor needs a frame to process it. The header carries
the sample's age.
Source: objects 2000h–2130h of `tactile_array.eds`; wire form in `protocol.tactile`.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Container, Sequence
from functools import cache
from itertools import count, takewhile

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.plant.plant import Plant
from canprobe.cell.scene.setup import Array
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.eds.packaged import WINDOW_SIZE
from canprobe.fieldbus.node.dictionary import Dictionary, Value, key_of
from canprobe.fieldbus.node.slave_node import Application, SlaveNode
from canprobe.fieldbus.protocol.frames import SYNC_ID, Frame, NmtState
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort
from canprobe.fieldbus.protocol.tactile import (
    DEFAULT_WINDOW,
    MAX_SIDE,
    WINDOW_SIZES,
    Features,
    Shape,
    TactileHeader,
    TactileMode,
    pack_whole,
)
from canprobe.mechanics.touch.pad import COUNTS_MAX, Pad
from canprobe.mechanics.types import Floats

Image = NDArray[np.uint8]
Raw = NDArray[np.uint8] | Floats
"""Counts of 255 at full scale: whole ones of an ADC of 8 bits, parts of counts of a finer one."""
UNIT_GAIN_PERMILLE = 1000
_HYSTERESIS = 0.75  # taxels the ideal origin must be away before the window moves; 0.5 would flicker


def is_overloaded(raw: Raw) -> bool:
    """Whether a taxel has reached full scale."""
    if raw.dtype == np.uint8:
        return COUNTS_MAX in raw.tobytes()
    return bool(raw.max() == COUNTS_MAX)


def correct(raw: Raw, tare: Floats | None, gain_permille: int, threshold: int) -> Image:
    """Raw counts → whole counts, tare subtracted, times the gain, saturated, zero below the threshold."""
    as_sampled = tare is None and gain_permille == UNIT_GAIN_PERMILLE and raw.dtype == np.uint8
    counts = raw if as_sampled else np.rint(_scaled(raw, tare, gain_permille))
    return _kept(threshold).take(counts.astype(np.intp), mode="clip")


@cache
def _kept(threshold: int) -> Image:
    """(256,) what remains of each count."""
    counts = np.arange(COUNTS_MAX + 1, dtype=np.uint8)
    counts[: max(threshold, 0)] = 0
    return counts


def correct_finely(raw: Raw, tare: Floats | None, gain_permille: int, threshold: int) -> Floats:
    """As ``correct``, with the parts of counts that a finer ADC sees and an image on the bus cannot carry."""
    counts = np.minimum(_scaled(raw, tare, gain_permille), COUNTS_MAX)
    counts[counts < max(threshold, 0)] = 0.0
    return counts


def _scaled(raw: Raw, tare: Floats | None, gain_permille: int) -> Floats:
    counts = raw.astype(np.float64)
    if tare is not None:
        counts -= tare
    if gain_permille != UNIT_GAIN_PERMILLE:
        counts *= gain_permille / UNIT_GAIN_PERMILLE
    return counts


@cache
def _sums(rows: int, columns: int) -> Floats:
    """(3, rows · columns): 1, row and column of each taxel."""
    row, column = np.indices((rows, columns), dtype=np.float64)
    return np.stack((np.ones(rows * columns), row.reshape(-1), column.reshape(-1)))


def _moments(image: Raw) -> tuple[float, float, float]:
    """Sum, centroid row, centroid column; the centre of the pad without a contact."""
    total, rows, columns = _sums(*image.shape).dot(image.reshape(-1)).tolist()
    if total == 0.0:
        return 0.0, (image.shape[0] - 1) / 2, (image.shape[1] - 1) / 2
    return total, rows / total, columns / total


def middle(window: int = DEFAULT_WINDOW, shape: Shape = (MAX_SIDE, MAX_SIDE)) -> tuple[int, int]:
    """First taxel (row, column) of a window in the middle of the pad."""
    return max(shape[0] - window, 0) // 2, max(shape[1] - window, 0) // 2


def follow(image: Raw, origin: tuple[int, int], window: int = DEFAULT_WINDOW) -> tuple[int, int]:
    """First taxel (row, column) of the window of so many taxels a side round the contact.

    The window stays while the contact's centroid is near its middle, and where it is without a contact.
    """
    total, row, column = _moments(image)
    if total == 0.0:
        return origin
    rows, columns = image.shape
    return _shift(origin[0], row, window, rows), _shift(origin[1], column, window, columns)


def _shift(origin: int, centroid: float, window: int, taxels: int) -> int:
    ideal = centroid - (window - 1) / 2
    if abs(ideal - origin) <= _HYSTERESIS:
        return origin
    return max(min(round(ideal), taxels - window), 0)


def compute_features(image: Raw, full_scale_pa: float, pitch_m: float) -> Features:
    """Force, centroid and central second moments of the whole pad.

    Args:
        image: corrected counts, (rows, columns), whole or not.
        full_scale_pa: pressure at 255 counts, Pa.
        pitch_m: pitch of the taxels.
    """
    total, row, column = _moments(image)
    if total == 0.0:
        return Features(0.0, row, column, 0.0, 0.0, 0.0, 0)
    weights = image / total
    rows, columns = image.shape
    d_row, d_column = np.arange(rows) - row, np.arange(columns) - column
    return Features(
        force_n=total / COUNTS_MAX * full_scale_pa * pitch_m**2,
        row=row,
        col=column,
        var_rr=float(d_row**2 @ weights.sum(axis=1)),
        var_rc=float(d_row @ weights @ d_column),
        var_cc=float(d_column**2 @ weights.sum(axis=0)),
        peak=round(float(image.max())),
    )


TARE = int.from_bytes(b"tare", "little")
MODE, THRESHOLD, GAIN, TARE_COMMAND, FULL_SCALE_PA, OVERLOAD, ORIGIN = range(0x2000, 0x2007)
IMAGE_ROWS, WINDOW_ROWS, HEADER, FEATURES = 0x2100, 0x2110, 0x2120, 0x2130
_CONTENT = {TactileMode.FEATURES: FEATURES, TactileMode.WINDOW: WINDOW_ROWS, TactileMode.IMAGE: IMAGE_ROWS}
_MAX_AGE_US = 0xFFFF


class TactileApplication(Application):
    """The sensor function of one node. A tare command takes the mean of the next images as zero.

    Attributes:
        distortions: functions that make the sampled image of the true one and its time; faults of the array.
        publish: called with header and content of each frame; it puts them into the objects that the TPDOs carry.
    """

    def __init__(self, plant: Plant, latency_frames: int = 1, tare_images: int = 16, pad: Pad | None = None) -> None:
        """Make the sensor.

        Args:
            plant: shared with the other nodes.
            latency_frames: triggers between sampling an image and sending it.
            tare_images: images averaged by one tare command.
            pad: its taxels; None: 16×16 over one inch.
        """
        self._plant = plant
        self._pad = pad or Pad()
        self._latency, self._tare_images = latency_frames, tare_images
        self._pipeline: deque[tuple[int, Raw]] = deque()
        self.distortions: list[Callable[[Raw, int], Raw]] = []
        self._tare: Floats | None = None
        self._taring: list[Raw] | None = None
        self._frames = 0
        self._origin = middle(shape=self._pad.shape)
        self._counter = 0
        self._triggered_ns: int | None = None
        self.publish: Callable[[TactileHeader, Image | Features], None] = self._put

    def attach(self, node: SlaveNode) -> None:
        self._node = node
        for index in (HEADER, FEATURES, IMAGE_ROWS, WINDOW_ROWS):
            node.pdos.on_trigger(index, self._trigger)
        node.dictionary.on_check(TARE_COMMAND, _check_tare)
        node.dictionary.on_write(TARE_COMMAND, self._begin_tare)
        node.dictionary.on_change(self._read_settings, MODE, THRESHOLD, GAIN, FULL_SCALE_PA)
        self._content = {mode: _members(node.dictionary, index) for mode, index in _CONTENT.items()}
        self._sized = node.dictionary.has_known(WINDOW_SIZE)
        if self._sized:
            node.dictionary.on_check(WINDOW_SIZE, self._check_window)
            node.dictionary.on_write(WINDOW_SIZE, self._begin_window)
        self._read_settings()

    def _read_settings(self) -> None:
        """Take the present values of the dictionary; an array without a window size has 8 taxels along the window."""
        number = self._node.dictionary.number
        self._mode = TactileMode(number(MODE, 0, TactileMode.WINDOW))
        self._gain, self._threshold = number(GAIN, 0, 1000), number(THRESHOLD)
        self._full_scale = number(FULL_SCALE_PA, 0, 100_000)
        self._window = number(WINDOW_SIZE, 0, DEFAULT_WINDOW) if self._sized else DEFAULT_WINDOW

    def keep(self) -> bytes:
        return b"" if self._tare is None else self._tare.tobytes()

    def recall(self, kept: bytes) -> None:
        """The tare as it was stored, if any."""
        needed = 8 * self._pad.taxels
        if len(kept) not in (0, needed):
            raise UsageError(f"{self._node.name}: stored tare: expected {needed} bytes, got {len(kept)}")
        self._tare = np.frombuffer(kept).reshape(self._pad.shape) if kept else None

    def reset(self, t_ns: int) -> None:
        self._pipeline.clear()
        self._taring = None
        self._frames = 0
        self._read_settings()
        self._origin = middle(self._window, self._pad.shape)

    def entered(self, t_ns: int) -> None:
        """Sample at once on entering operational, so that the first frame shows something real."""
        self._pipeline.clear()
        self._triggered_ns = None
        if self._node.state is NmtState.OPERATIONAL:
            self._sample(t_ns)

    def advance(self, t_ns: int) -> None:
        self._plant.advance(t_ns)

    def sync(self, t_ns: int, counter: int) -> None:
        """Remember the counter; the trigger, if there is one, follows."""
        self._counter = counter

    def _sample(self, t_ns: int) -> None:
        self._plant.advance(t_ns)
        raw = self._plant.sample_image(t_ns)
        for distort in self.distortions:
            raw = distort(raw, t_ns)
        self._pipeline.append((t_ns, raw))
        if self._taring is not None:
            self._taring.append(raw)
            if len(self._taring) == self._tare_images:
                self._tare, self._taring = np.mean(self._taring, axis=0), None

    def _trigger(self, t_ns: int) -> None:
        if t_ns == self._triggered_ns:
            return  # PDOs of one frame in different groups
        self._triggered_ns = t_ns
        self._plant.begin(t_ns)
        self._sample(t_ns)
        pipeline = self._pipeline
        while len(pipeline) > self._latency + 1:
            pipeline.popleft()
        sampled_ns, raw = pipeline.popleft() if len(pipeline) > self._latency else pipeline[0]
        self._show(raw, min(max(t_ns - sampled_ns, 0) // 1000, _MAX_AGE_US))

    def _show(self, raw: Raw, age_us: int) -> None:
        """Make one frame, and publish it."""
        mode, window = self._mode, self._window
        settings = self._tare, self._gain, self._threshold
        image = correct(raw, *settings)
        overload = is_overloaded(raw) or is_overloaded(image)
        self._origin = follow(image, self._origin, window)
        row, column = self._origin if mode is TactileMode.WINDOW else (0, 0)
        header = TactileHeader(self._frames, self._counter, row, column, mode, overload, age_us, window=window)
        self._frames = (self._frames + 1) % 256
        content: Image | Features = image
        if mode is TactileMode.FEATURES:
            seen = image if raw.dtype == np.uint8 else correct_finely(raw, *settings)
            content = compute_features(seen, self._full_scale, self._pad.pitch_m)
        self.publish(header, content)

    def _put(self, header: TactileHeader, content: Image | Features) -> None:
        """Put one frame into the objects that the TPDOs carry."""
        dictionary, mode = self._node.dictionary, self._mode
        whole = pack_whole(header, content if isinstance(content, Features) else _sent(header, content))
        words = struct.unpack(f"<{len(whole) // 8}Q", whole)
        dictionary.put(OVERLOAD, 0, int(header.overload))
        dictionary.put(ORIGIN, 0, self._origin[0] << 4 | self._origin[1])
        content_words = words if mode is TactileMode.FEATURES else words[1:]
        dictionary.values.update(zip(self._content[mode], content_words, strict=False))
        dictionary.put(HEADER, 0, words[0])

    def _check_window(self, subindex: int, value: Value) -> None:
        if value not in WINDOW_SIZES or int(value) > min(self._pad.shape):
            raise SdoAbort(Abort.VALUE)
        if self._node.state is NmtState.OPERATIONAL and value != self._window:
            raise SdoAbort(Abort.DEVICE_STATE)

    def _begin_window(self, subindex: int, value: Value) -> None:
        self._read_settings()
        self._origin = middle(self._window, self._pad.shape)

    def _begin_tare(self, subindex: int, value: Value) -> None:
        self._tare, self._taring = None, []


def _sent(header: TactileHeader, image: Image) -> bytes:
    """The taxels that a frame carries: those of its window, or all."""
    if header.mode is TactileMode.WINDOW:
        row, column = header.origin_row, header.origin_col
        image = image[row : row + header.window, column : column + header.window]
    return image.tobytes()


def _members(dictionary: Dictionary, index: int) -> tuple[int, ...]:
    """Keys of sub-index 1, 2, … of an object, as many as there are."""
    return tuple(takewhile(dictionary.__contains__, (key_of(index, subindex) for subindex in count(1))))


def _check_tare(subindex: int, value: Value) -> None:
    if value != TARE:
        raise SdoAbort(Abort.CANNOT_STORE)


OFFSET_SHARE = 0.02
"""Half-width of the unloaded values' spread, as a share of the full scale."""


class RawArray(Participant):
    """The emulated device.

    Args:
        array: an array that sends raw frames.
        plant: shared with the nodes.
        sync_ratio: SYNCs between two images of a device that samples at SYNC.
        seed: seed of its unloaded values.

    Attributes:
        running: whether it was started; a device without a start frame always runs.
    """

    def __init__(self, array: Array, plant: Plant, *, sync_ratio: int, seed: int) -> None:
        assert array.raw is not None
        self._wire = wire = array.raw
        self._plant = plant
        self._period_ns = round(1e9 / array.rate_hz)
        self._latency_ns = round(1e9 * wire.latency_s)
        self._ratio, self._syncs = sync_ratio, 0
        self.running = not wire.start
        self._due_ns: int | None = None
        self._span = wire.full_scale - wire.unloaded
        spread = OFFSET_SHARE * abs(self._span) if wire.tare_images else 0.0
        offsets = np.random.default_rng(seed).uniform(-spread, spread, array.pad.shape) if spread else 0.0
        self._unloaded = np.rint(wire.unloaded + np.zeros(array.pad.shape) + offsets)
        self._waiting: list[tuple[int, list[Frame]]] = []

    @property
    def listens(self) -> Container[int]:
        """Identifiers of its commands, and of SYNC where a SYNC triggers its images."""
        commands = {can_id for can_id, _ in (*self._wire.start, *self._wire.stop, *self._wire.poll)}
        return frozenset(commands | {SYNC_ID} if self._wire.sampling == "sync" else commands)

    @property
    def next_deadline_ns(self) -> int | None:
        dues = [due for due, _ in self._waiting]
        return min([*dues, self._due_ns]) if self._due_ns is not None else min(dues, default=None)

    def start(self, t_ns: int) -> Sequence[Frame]:
        if self.running and self._wire.sampling == "free":
            self._due_ns = t_ns + self._period_ns
        return ()

    def receive(self, can_id: int, data: bytes, t_ns: int) -> Sequence[Frame]:
        wire, frame = self._wire, (can_id, data)
        if wire.start and frame == wire.start[-1]:
            self.running = True
            if wire.sampling == "free" and self._due_ns is None:
                self._due_ns = t_ns + self._period_ns
        elif frame in wire.stop:
            self.running, self._due_ns = False, None
        elif wire.poll and frame == wire.poll[-1] and self.running:
            self._sample(t_ns)
        elif can_id == SYNC_ID and wire.sampling == "sync" and self.running:
            self._syncs += 1
            if self._syncs % self._ratio == 0:
                self._sample(t_ns)
        return self._ready(t_ns)

    def advance(self, t_ns: int) -> Sequence[Frame]:
        if self._due_ns is not None and self._due_ns <= t_ns:
            self._sample(self._due_ns)
            self._due_ns += self._period_ns * (1 + (t_ns - self._due_ns) // self._period_ns)
        return self._ready(t_ns)

    def _sample(self, t_ns: int) -> None:
        self._plant.begin(t_ns)
        self._plant.advance(t_ns)
        loads = self._plant.sample_image(t_ns).astype(np.float64) / COUNTS_MAX
        image = self._wire.image
        counts = np.empty((image.rows, image.columns, image.axes), dtype=np.int64)
        counts[:] = self._unloaded[:, :, None]
        counts[:, :, self._wire.normal] = np.rint(self._unloaded + self._span * loads)
        self._waiting.append(
            (t_ns + self._latency_ns, image.encode(np.clip(counts, *image.range).reshape(-1).tolist()))
        )

    def _ready(self, t_ns: int) -> list[Frame]:
        """The frames of the images that have waited for the latency."""
        ready = [frame for due, frames in self._waiting if due <= t_ns for frame in frames]
        self._waiting = [one for one in self._waiting if one[0] > t_ns]
        return ready
