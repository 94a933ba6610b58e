"""Images in raw CAN frames, of arrays that know no CANopen: one description for both ways, and reassembly.

A frame of such a device is described as a text of two characters a byte, spaces between them ignored: `0`–`9` and
`A`–`F` must stand there (the tag that names the frame), `.` is not read, and a small letter is part of a value.
All places with one letter are one value of 4 bits each, in the byte order of the format; the values of a frame are in
the order of the alphabet. So `"..xxxxyyyyzzzz"` has three words behind an unused byte, `"B130uuvvwwxxyyzz"` six bytes
behind a tag of two, and `"ttuuvvut.v"`, little-endian, three values of 12 bits whose high nibbles come last.

An image is every frame of `frames` from every identifier, once each. The values are in the order identifier, frame,
letter; `axes` values in a row are those of one taxel.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.frames import CLASSIC_BYTES, Frame

Counts = tuple[int, ...]
"""Counts of an image: row by row, in a row column by column, in a taxel axis by axis."""
_TAG_CHARACTERS = "0123456789ABCDEF"


@dataclass(frozen=True, slots=True)
class FramePattern:
    """One frame of an image.

    Attributes:
        length: fewest bytes of the frame; what follows them is not read.
        mask, tag: bits that name the frame, and their values, in these bytes as one big-endian number.
        values: shifts of the nibbles of each value in that number, the most significant nibble first.
        signed: whether values are in two's complement.
    """

    length: int
    mask: int
    tag: int
    values: tuple[tuple[int, ...], ...]
    signed: bool = False

    @classmethod
    def parse(cls, text: str, byte_order: str = "big", *, signed: bool = False) -> FramePattern:
        """Read a pattern from its text, as the module describes it.

        Raises:
            ProtocolError: the text is no pattern, or longer than 8 bytes.
        """
        characters = text.replace(" ", "")
        if not re.fullmatch(r"([0-9A-Za-z.]{2}){1,8}", characters) or re.search(r"[G-Z]", characters):
            raise ProtocolError(
                f'frame "{text}": expected 1 to {CLASSIC_BYTES} bytes of two characters each: 0-9 and A-F for a tag,'
                " small letters for values, '.' for what is not read"
            )
        length, mask, tag = len(characters) // 2, 0, 0
        places: dict[str, list[int]] = {}
        for place, character in enumerate(characters):
            shift = 4 * (2 * length - 1 - place)
            if character in _TAG_CHARACTERS:
                mask |= 0xF << shift
                tag |= int(character, 16) << shift
            elif character != ".":
                places.setdefault(character, []).append(place)
        values = []
        for letter in sorted(places):
            ordered = places[letter]  # big-endian: from the left to the right
            if byte_order == "little":
                ordered = sorted(ordered, key=lambda place: (-(place // 2), place % 2))
            values.append(tuple(4 * (2 * length - 1 - place) for place in ordered))
        return cls(length, mask, tag, tuple(values), signed)

    def resembles(self, other: FramePattern) -> bool:
        """Whether there are bytes that match both frames."""
        length = max(self.length, other.length)
        mine, its = 8 * (length - self.length), 8 * (length - other.length)
        common = (self.mask << mine) & (other.mask << its)
        return (self.tag << mine) & common == (other.tag << its) & common

    def unpack(self, data: bytes) -> list[int]:
        """The values in a frame that matches."""
        number, values = int.from_bytes(data[: self.length], "big"), []
        for shifts in self.values:
            value = 0
            for shift in shifts:
                value = value << 4 | number >> shift & 0xF
            sign = 1 << 4 * len(shifts) - 1 if self.signed else 0
            values.append((value ^ sign) - sign)
        return values

    def pack(self, values: Sequence[int]) -> bytes:
        """Pack values into the frame; what is not read is 0.

        Raises:
            ProtocolError: a value does not fit.
        """
        number = self.tag
        for value, shifts in zip(values, self.values, strict=True):
            low, high = value_range(4 * len(shifts), signed=self.signed)
            if not low <= value <= high:
                raise ProtocolError(f"value {value} does not fit {4 * len(shifts)} bits, {low} to {high}")
            for place, shift in enumerate(reversed(shifts)):
                number |= (value >> 4 * place & 0xF) << shift
        return number.to_bytes(self.length, "big")


def value_range(bits: int, *, signed: bool) -> tuple[int, int]:
    """Least and greatest value of so many bits."""
    low = -(1 << bits - 1) if signed else 0
    return low, low + (1 << bits) - 1


@dataclass(frozen=True)
class ImageFormat:
    """How a device puts an image into frames.

    Attributes:
        ids: 11-bit identifiers of its frames.
        frames: frames that each identifier sends for one image.
        rows, columns: numbers of rows and columns of the image.
        axes: number of values of a taxel.
        by_columns: whether taxels come column by column; else they come row by row.
    """

    ids: tuple[int, ...]
    frames: tuple[FramePattern, ...]
    rows: int
    columns: int
    axes: int = 1
    by_columns: bool = False

    def __post_init__(self) -> None:
        """Check the format.

        Raises:
            ProtocolError: an identifier is there twice, two frames look alike, or the number of values is wrong.
        """
        if len(set(self.ids)) != len(self.ids):
            raise ProtocolError("an identifier of the image is there twice; give each frame its own")
        for number, frame in enumerate(self.frames):
            if any(frame.resembles(other) for other in self.frames[:number]):
                raise ProtocolError(f"frame {number + 1} cannot be told from one before it: give each its own tag")
        carried, taxels = len(self.ids) * sum(len(frame.values) for frame in self.frames), self.rows * self.columns
        if carried != taxels * self.axes:
            each = f" of {self.axes} values" if self.axes > 1 else ""
            raise ProtocolError(
                f"{len(self.ids)} identifiers with {len(self.frames)} frames each carry {carried} values, and"
                f" {self.rows} × {self.columns} taxels{each} have {taxels * self.axes}"
            )

    @property
    def parts(self) -> int:
        """Number of frames of an image."""
        return len(self.ids) * len(self.frames)

    @property
    def bits(self) -> int:
        """Number of bits of the narrowest value."""
        return min(4 * len(shifts) for frame in self.frames for shifts in frame.values)

    @property
    def range(self) -> tuple[int, int]:
        """Least and greatest count that every value can have."""
        return value_range(self.bits, signed=any(frame.signed for frame in self.frames))

    @cached_property
    def _places(self) -> tuple[int, ...]:
        """Place of each count, in the order of `Counts`, among the values of the frames."""
        by_row = self.columns * self.axes, self.axes
        by_column = self.axes, self.rows * self.axes
        row_step, column_step = by_column if self.by_columns else by_row
        return tuple(
            row * row_step + column * column_step + axis
            for row in range(self.rows)
            for column in range(self.columns)
            for axis in range(self.axes)
        )

    @cached_property
    def _id_numbers(self) -> dict[int, int]:
        return {can_id: number for number, can_id in enumerate(self.ids)}

    @cached_property
    def _tags(self) -> dict[tuple[int, int], dict[int, int]]:
        """Places of the frames by their tags, for each length and mask: one look, however many frames there are."""
        found: dict[tuple[int, int], dict[int, int]] = {}
        for place, frame in enumerate(self.frames):
            found.setdefault((frame.length, frame.mask), {})[frame.tag] = place
        return found

    def part_of(self, can_id: int, data: bytes) -> int | None:
        """Number of this frame in the image, from 0; None for a frame of something else."""
        number = self._id_numbers.get(can_id)
        if number is None:
            return None
        for (length, mask), places in self._tags.items():
            place = places.get(int.from_bytes(data[:length], "big") & mask)
            if place is not None and len(data) >= length:
                return number * len(self.frames) + place
        return None

    def values_of(self, part: int, data: bytes) -> list[int]:
        """Values in a frame of the image."""
        return self.frames[part % len(self.frames)].unpack(data)

    def decode(self, parts: Sequence[bytes]) -> Counts:
        """Counts of an image from all its frames, in the order of identifiers and frames."""
        values = [value for part, data in enumerate(parts) for value in self.values_of(part, data)]
        return tuple(values[place] for place in self._places)

    def encode(self, counts: Sequence[int]) -> list[Frame]:
        """Frames of an image, in the order of identifiers and frames.

        Raises:
            ProtocolError: the number of counts is wrong, or a count does not fit.
        """
        if len(counts) != len(self._places):
            raise ProtocolError(f"image: expected {len(self._places)} counts, got {len(counts)}")
        values = [0] * len(counts)
        for count, place in zip(counts, self._places, strict=True):
            values[place] = count
        sent, start = [], 0
        for can_id in self.ids:
            for frame in self.frames:
                end = start + len(frame.values)
                sent.append((can_id, frame.pack(values[start:end])))
                start = end
        return sent


@dataclass(frozen=True, slots=True)
class RawImage:
    """One complete image.

    Attributes:
        counts: counts as the device sent them.
        t_ns: arrival of the first frame.
        number: number of the image among the complete ones, from 0.
    """

    counts: Counts
    t_ns: int
    number: int


class ImageAssembler:
    """Collects the frames of images; `push` returns an image when the last of its distinct frames arrives.

    An image opens at any of its frames. A frame that it has already begins the next one: the open image was torn. So a
    lost frame costs its image and no other. The formats have no counter and no checksum: neither a changed bit nor a
    lost image is noticed. Two images are mixed unnoticed where the last frames of one and the first of the next
    are lost and the rest comes within the deadline.

    Args:
        image: format of the images.
        deadline_ns: longest time from the first frame to the last.

    Attributes:
        frames: number of images that were returned.
        torn: number of images that were opened and dropped incomplete.
    """

    def __init__(self, image: ImageFormat, deadline_ns: int) -> None:
        self.image = image
        self.frames = self.torn = 0
        self._deadline_ns = deadline_ns
        self._parts: dict[int, bytes] = {}
        self._opened_ns = 0

    def push(self, can_id: int, data: bytes, t_ns: int) -> RawImage | None:
        """Take one received frame; a frame that is no part of an image is ignored. No bytes make it raise."""
        part = self.image.part_of(can_id, data)
        if part is None:
            return None
        if self._parts and (part in self._parts or t_ns - self._opened_ns > self._deadline_ns):
            self.torn += 1
            self._parts.clear()
        if not self._parts:
            self._opened_ns = t_ns
        self._parts[part] = data
        if len(self._parts) < self.image.parts:
            return None
        counts = self.image.decode([self._parts[one] for one in range(self.image.parts)])
        self._parts.clear()
        self.frames += 1
        return RawImage(counts, self._opened_ns, self.frames - 1)

    def reset(self) -> None:
        """Forget the open image; counters stay."""
        self._parts.clear()
