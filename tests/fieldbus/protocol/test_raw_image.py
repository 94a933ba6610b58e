"""Images in raw CAN frames: the test frames of four makers' drivers, both ways; loss, mixtures, and what is refused."""

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from raw_formats import FORMATS

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.raw_image import FramePattern, ImageAssembler, ImageFormat

MS = 1_000_000


def count_at(image, counts, row, column, axis):
    return counts[(row * image.columns + column) * image.axes + axis]


# (array, frame, {(row, column, axis): value}): values decoded by hand from the makers' drivers
FRAMES = [
    ("uskin4x4", "712#007E31800546A000", {(2, 0, 0): 32305, (2, 0, 1): 32773, (2, 0, 2): 18080}),
    ("uskin4x4", "710#000102FFFE800000", {(0, 0, 0): 258, (0, 0, 1): 65534, (0, 0, 2): 32768}),
    ("uskin4x4", "71F#0000FF00000100", {(3, 3, 0): 255, (3, 3, 1): 0, (3, 3, 2): 256}),
    ("uskin4x6", "727#0000FF00000100", {(3, 5, 0): 255, (3, 5, 1): 0, (3, 5, 2): 256}),
    ("linker12x6", "027#B130000005122A00", {(3, column, 0): v for column, v in enumerate((0, 0, 5, 18, 42, 0))}),
    ("poweron6x6", "300#9601E25504", {(0, column, 0): v for column, v in enumerate((1430, 1281, 1250))}),
    ("poweron6x6", "302#B2DCF34504", {(1, column, 0): v for column, v in enumerate((1458, 1244, 1267))}),
    ("poweron6x6", "30B#B1CFC15505", {(5, 3 + column, 0): v for column, v in enumerate((1457, 1487, 1473))}),
    # the triangle on row 1; the pads t6 = 110 and t10 = 106 are not read
    ("icub-triangles", "4D1#40F0EFD280F0F06E", {(1, c, 0): v for c, v in enumerate((240, 239, 210, 128, 240, 240))}),
    ("icub-triangles", "4D1#C0F0F1F06AF00000", {(1, 6 + c, 0): v for c, v in enumerate((240, 241, 240, 240))}),
    ("icub-triangles", "4D1#C0F0F1F06AF00081", {(1, 6 + c, 0): v for c, v in enumerate((240, 241, 240, 240))}),
]


@pytest.mark.parametrize(("name", "frame", "values"), FRAMES)
def test_frames_of_the_makers_are_read_exactly(name, frame, values):
    image = FORMATS[name]
    can_id, data = int(frame[:3], 16), bytes.fromhex(frame[4:])
    part = image.part_of(can_id, data)
    parts = [one for _, one in image.encode([0] * (image.rows * image.columns * image.axes))]
    parts[part] = data
    counts = image.decode(parts)
    assert {place: count_at(image, counts, *place) for place in values} == values
    assert sum(v != 0 for v in counts) == sum(v != 0 for v in values.values())  # and nowhere else
    sent_id, sent = image.encode(counts)[part]
    read = image.values_of(part, data)
    assert sent_id == can_id and image.values_of(part, sent) == read


def test_frames_of_others_on_the_same_identifier_are_no_part():
    thumb, triangles = FORMATS["linker12x6"], FORMATS["icub-triangles"]
    assert thumb.part_of(0x027, bytes.fromhex("B2B0FF0100000000")) is None  # index row 11
    assert thumb.part_of(0x027, bytes.fromhex("B10102")) is None  # an answer of 3 bytes
    assert triangles.part_of(0x4D0, bytes.fromhex("40F0F0F0")) is None
    other = ImageFormat((0x27,), tuple(FramePattern.parse(f"B1{r:X}0 ww xx yy zz") for r in range(10)), 10, 4)
    assert other.values_of(9, bytes.fromhex("B19001020304")) == [1, 2, 3, 4]  # the O6 hand, thumb row 9


def test_frames_may_differ_in_length_and_in_the_place_of_their_tag():
    frames = tuple(map(FramePattern.parse, ("A1 ww xx", "B. ww xx yy zz", "0C ww xx", "AA 77 ww")))
    image = ImageFormat((0x27,), frames, 3, 3)
    sent = ("A10102", "B501020304", "0C0102", "AA7702")
    assert [image.part_of(0x27, bytes.fromhex(text)) for text in sent] == [0, 1, 2, 3]
    assert image.part_of(0x27, bytes.fromhex("A1010299")) == 0  # what follows is not read
    assert [image.part_of(0x27, bytes.fromhex(text)) for text in ("A101", "B5010203", "AA7802", "")] == [None] * 4


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(FORMATS)), st.integers(0, 2**32), st.randoms(use_true_random=False))
def test_an_image_comes_back_from_its_frames_in_any_order(name, seed, order):
    image = FORMATS[name]
    rng = Random(seed)
    counts = tuple(rng.randrange(1 << image.bits) for _ in range(image.rows * image.columns * image.axes))
    frames = image.encode(counts)
    order.shuffle(frames)
    assembler = ImageAssembler(image, 8 * MS)
    found = [assembler.push(can_id, data, i) for i, (can_id, data) in enumerate(frames)]
    assert found[:-1] == [None] * (image.parts - 1)
    assert found[-1].counts == counts and found[-1].t_ns == 0
    assert (assembler.frames, assembler.torn) == (1, 0)


@pytest.mark.parametrize("name", sorted(FORMATS))
@pytest.mark.parametrize("lost", [0, 1, -1])
def test_a_lost_frame_costs_its_image_and_no_other(name, lost):
    image = FORMATS[name]
    assembler = ImageAssembler(image, 8 * MS)
    numbers = []
    for k in range(5):
        frames = image.encode([k] * (image.rows * image.columns * image.axes))
        if k == 2:
            del frames[lost]
        for i, (can_id, data) in enumerate(frames):
            whole = assembler.push(can_id, data, k * 10 * MS + i * 100_000)
            if whole is not None:
                assert len(set(whole.counts)) == 1  # never a mixture
                numbers.append(whole.counts[0])
    assert numbers == [0, 1, 3, 4] and assembler.torn == 1


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(FORMATS)), st.lists(st.tuples(st.integers(0, 0x7FF), st.binary(max_size=8)), max_size=60))
def test_no_bytes_make_it_fail(name, frames):
    assembler = ImageAssembler(FORMATS[name], 8 * MS)
    for t_ns, (can_id, data) in enumerate(frames):
        assembler.push(can_id, data, t_ns)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: FramePattern.parse("40 tt u"), "two characters"),
        (lambda: FramePattern.parse("tt" * 9), "1 to 8 bytes"),
        (lambda: FramePattern.parse("G0 tt"), "two characters"),
        (lambda: ImageFormat((1, 1), (FramePattern.parse("tt"),), 1, 2), "twice"),
        (lambda: ImageFormat((1,), (FramePattern.parse("B1 tt"), FramePattern.parse(".. tt")), 1, 2), "own tag"),
        (lambda: ImageFormat((1,), (FramePattern.parse("tt uu"),), 1, 3), "carry 2 values"),
        (lambda: FramePattern.parse("t").pack([16]), "two characters"),
        (lambda: FramePattern.parse(".t").pack([16]), "does not fit 4 bits, 0 to 15"),
        (lambda: FORMATS["uskin4x4"].encode([0] * 16), "expected 48 counts, got 16"),
    ],
)
def test_what_contradicts_itself_is_refused(build, words):
    with pytest.raises(ProtocolError, match=words):
        build()


@pytest.mark.parametrize(
    ("text", "order", "data", "values"),
    [
        ("xxxx yyyy", "big", "ff88 0078", [-120, 120]),
        ("xxxx yyyy", "little", "88ff ff7f", [-120, 32767]),
        ("xxxx yyyy", "big", "8000 7fff", [-32768, 32767]),
        ("aa bb", "big", "80 7f", [-128, 127]),
        ("aab bb", "big", "800 7ff", [-2048, 2047]),
        ("xxxxxx ..", "little", "ffffff 00", [-1]),
    ],
)
def test_signed_values_are_in_twos_complement(text, order, data, values):
    pattern = FramePattern.parse(text.replace("aab bb", "aa ab bb"), order, signed=True)
    raw = bytes.fromhex(data.replace(" ", ""))
    assert pattern.unpack(raw) == values
    assert pattern.unpack(pattern.pack(values)) == values
    width = 4 * len(pattern.values[0])
    for beyond in (1 << width - 1, -(1 << width - 1) - 1):
        with pytest.raises(ProtocolError, match=f"does not fit {width} bits"):
            pattern.pack([beyond, *values[1:]])
