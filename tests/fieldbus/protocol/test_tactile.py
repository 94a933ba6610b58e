"""Tactile frames: bytes written out by hand, an own bitwise CRC, and a lossy wire that must never fool the receiver."""

import contextlib
import dataclasses
import re
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from canprobe.errors import ProtocolError
from canprobe.fieldbus.protocol.tactile import (
    WINDOW_SIZES,
    Features,
    FrameAssembler,
    TactileHeader,
    TactileMode,
    crc16_ccitt,
    pack_whole,
)

FEATURES, WINDOW, IMAGE = TactileMode
DEADLINE = 5_000_000
PDO_COUNT = {FEATURES: 2, WINDOW: 9, IMAGE: 33}  # header included; with a window of 8×8 taxels


def crc_by_bits(data, crc=0):
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


def header(counter=0, mode=WINDOW, row=0, col=0, overload=False):
    return TactileHeader(counter, 2, row, col, mode, overload, sample_age_us=5000)


def cob_ids(mode):
    return range(0x511, 0x511 + PDO_COUNT[mode])


def inside(pad, row, col, side=8):
    """The bytes of a window of a pad of 16×16."""
    return b"".join(pad[16 * r + col : 16 * r + col + side] for r in range(row, row + side))


def pack_frame(header, content):
    if header.mode is WINDOW and isinstance(content, bytes) and len(content) == 256:
        content = inside(content, header.origin_row, header.origin_col, header.window)
    whole = pack_whole(header, content)
    return [whole[i : i + 8] for i in range(0, len(whole), 8)]


def push_all(assembler, payloads, mode=WINDOW, t_ns=0):
    published = [assembler.push(c, d, t_ns + n) for n, (c, d) in enumerate(zip(cob_ids(mode), payloads, strict=True))]
    assert published[:-1] == [None] * (len(payloads) - 1)
    return published[-1]


def image(seed=0):
    return Random(seed).randbytes(256)


# --- CRC ----------------------------------------------------------------------------------------------------------


def test_crc_check_value():
    assert crc16_ccitt(b"123456789") == 0x31C3


@given(st.binary(max_size=40), st.binary(max_size=40))
def test_crc_against_its_definition_bit_by_bit_and_in_parts(first, second):
    assert crc16_ccitt(first + second) == crc_by_bits(first + second) == crc16_ccitt(second, crc16_ccitt(first))


def test_crc_finds_every_error_of_up_to_three_bits_in_a_full_image():
    """By linearity: syndromes of single bits are all different (1, 2 bits) and of odd weight (3 bits)."""
    length = 6 + 32 * 8
    syndromes = [1 << n for n in range(16)]
    for bit in range(length * 8):
        error = bytearray(length)
        error[bit // 8] = 1 << bit % 8
        syndromes.append(crc16_ccitt(bytes(error)))
    assert len(set(syndromes)) == len(syndromes)
    assert all(s.bit_count() % 2 == 1 for s in syndromes)


# --- header -------------------------------------------------------------------------------------------------------

HEADERS = [
    (TactileHeader(0x12, 0xF0, 3, 4, WINDOW, False, 5000, 0xBEEF), "12f034018813efbe"),
    (TactileHeader(255, 1, 8, 8, WINDOW, True, 0xFFFF, 0), "ff018805ffff0000"),
    (TactileHeader(0, 0, 0, 0, IMAGE, True, 1, 1), "0000000601000100"),
    (TactileHeader(7, 2, 0xC, 8, FEATURES, False, 0, 0x1234), "0702c80000003412"),
]


@pytest.mark.parametrize("fields, wire", HEADERS)
def test_header_both_ways(fields, wire):
    data = bytes.fromhex(wire)
    assert fields.pack() == data
    assert TactileHeader.unpack(data) == fields
    for broken in (data[:-1], data + b"\x00", b""):
        with pytest.raises(ProtocolError, match=f"got {len(broken)}"):
            TactileHeader.unpack(broken)


def test_header_of_features_carries_the_peak():
    assert TactileHeader.unpack(bytes.fromhex("0702c80000003412")).peak == 0xC8


@pytest.mark.parametrize(
    "start, why",
    [
        ("00000003", "flags"),  # no such mode
        ("00000009", "flags"),  # reserved flag
        ("00000081", "flags"),
        ("00009001", "(9, 0)"),  # the window leaves the pad
        ("00000901", "(0, 9)"),
        ("00000102", "(0, 1)"),  # an image begins at the first taxel
    ],
)
def test_headers_that_mean_nothing_are_refused(start, why):
    with pytest.raises(ProtocolError, match=re.escape(why)):
        TactileHeader.unpack(bytes.fromhex(start + "00000000"))


@pytest.mark.parametrize("change", [{"frame_counter": 256}, {"sync_counter": -1}, {"sample_age_us": 65536}, {"crc": -1},
                                    {"origin_row": 16}, {"origin_col": -1}])  # fmt: skip
def test_header_fields_that_do_not_fit_are_refused(change):
    with pytest.raises(ProtocolError):
        dataclasses.replace(header(), **change).pack()


@given(st.binary(max_size=9))
def test_any_bytes_raise_only_protocol_errors(data):
    for unpack in (TactileHeader.unpack, Features.unpack):
        with contextlib.suppress(ProtocolError):
            unpack(data)


# --- taxels -------------------------------------------------------------------------------------------------------


def test_window_frame_byte_by_byte():
    pad = bytes(range(256))
    payloads = pack_frame(header(9, row=2, col=5), pad)
    assert len(payloads) == 9
    assert payloads[1] == bytes([0x25, 0x26, 0x27, 0x28, 0x29, 0x2A, 0x2B, 0x2C])  # row 2, columns 5..12
    assert payloads[8] == bytes(range(0x95, 0x9D))  # row 9
    assert payloads[0][:6] == bytes.fromhex("090225018813")
    assert int.from_bytes(payloads[0][6:], "little") == crc_by_bits(payloads[0][:6] + b"".join(payloads[1:]))


def test_image_frame_row_by_row_left_half_then_right():
    pad = bytes(range(256))
    payloads = pack_frame(header(mode=IMAGE), pad)
    assert len(payloads) == 33
    for row in range(16):
        assert payloads[2 * row + 1] == bytes(range(16 * row, 16 * row + 8))
        assert payloads[2 * row + 2] == bytes(range(16 * row + 8, 16 * row + 16))


@pytest.mark.parametrize("mode, row, col", [(WINDOW, 0, 0), (WINDOW, 8, 8), (WINDOW, 1, 7), (IMAGE, 0, 0)])
def test_taxels_arrive_where_they_were(mode, row, col):
    pad = image(row + 10 * col)
    assembler = FrameAssembler(cob_ids(mode), mode, DEADLINE)
    frame = push_all(assembler, pack_frame(header(4, mode, row, col, overload=True), pad), mode, t_ns=1000)
    assert frame.body == (inside(pad, row, col) if mode is WINDOW else pad)
    assert (frame.header.origin_row, frame.header.origin_col) == (row, col)
    assert frame.t_ns == 1000  # the header's arrival
    assert frame.features is None
    assert (frame.header.frame_counter, frame.header.overload, frame.header.sample_age_us) == (4, True, 5000)


@pytest.mark.parametrize(
    "head, content",
    [
        (header(row=9), bytes(64)),
        (header(col=9), bytes(64)),
        (header(mode=IMAGE, row=1), image()),
        (header(mode=IMAGE), b""),
        (header(), bytes(56)),
        (header(mode=FEATURES), image()),
        (header(), Features(1, 7, 7, 1, 0, 1)),
        (header(mode=FEATURES), Features(1, 7, 7, 1, 0, 1, peak=256)),
        (header(mode=FEATURES), Features(float("nan"), 7, 7, 1, 0, 1)),
    ],
)
def test_content_that_does_not_belong_to_the_mode_is_refused(head, content):
    with pytest.raises(ProtocolError):
        pack_frame(head, content)


# --- features -----------------------------------------------------------------------------------------------------


def test_features_bit_by_bit():
    """2 N, row 7.5, column 8.25, variances 2.5 and 3.25, covariance −0.75; least significant field first."""
    fields = [(800, 12), (960, 11), (1056, 11), (160, 10), (-48 % 1024, 10), (208, 10)]
    text = "".join(format(value, f"0{bits}b") for value, bits in reversed(fields))
    assert Features(2.0, 7.5, 8.25, 2.5, -0.75, 3.25).pack() == int(text, 2).to_bytes(8, "little")


def test_features_frame_is_two_pdos_and_comes_back():
    sent = Features(2.0, 7.5, 8.25, 2.5, -0.75, 3.25, peak=201)
    payloads = pack_frame(header(3, FEATURES), sent)
    assert len(payloads) == 2 and all(len(p) == 8 for p in payloads)
    assert payloads[0][2] == 201
    frame = push_all(FrameAssembler(cob_ids(FEATURES), FEATURES, DEADLINE), payloads, FEATURES)
    assert frame.features == sent


STEPS = {"force_n": 1 / 400, "row": 1 / 128, "col": 1 / 128, "var_rr": 1 / 64, "var_rc": 1 / 64, "var_cc": 1 / 64}
RANGES = {"force_n": (0, 4095 / 400), "row": (0, 2047 / 128), "col": (0, 2047 / 128), "var_rr": (0, 1023 / 64),
          "var_rc": (-8, 511 / 64), "var_cc": (0, 1023 / 64)}  # fmt: skip


@given(st.fixed_dictionaries({name: st.floats(-30, 30) for name in STEPS}))
def test_features_are_within_half_a_step_or_at_the_end_of_the_range(values):
    received = Features.unpack(Features(**values).pack())
    for name, value in values.items():
        low, high = RANGES[name]
        assert abs(getattr(received, name) - min(max(value, low), high)) <= STEPS[name] / 2 + 1e-12


@given(st.binary(min_size=8, max_size=8))
def test_features_bytes_survive_both_ways(data):
    assert Features.unpack(data).pack() == data


# --- assembler ----------------------------------------------------------------------------------------------------


def stream(count, mode=WINDOW, start=0):
    """Frames of different content as (payloads, image)."""
    pads = [image(100 + n) for n in range(count)]
    return [
        (pack_frame(header((start + n) % 256, mode, *((n % 9, 3) if mode is WINDOW else ())), p), p)
        for n, p in enumerate(pads)
    ]


def counters(assembler):
    names = ("frames", "torn", "crc_errors", "duplicates", "lost", "orphans", "malformed")
    return {name: getattr(assembler, name) for name in names if getattr(assembler, name)}


@pytest.fixture
def assembler():
    return FrameAssembler(cob_ids(WINDOW), WINDOW, DEADLINE)


def test_an_undisturbed_stream_is_published_whole(assembler):
    for n, (payloads, _) in enumerate(stream(300)):
        assert push_all(assembler, payloads, t_ns=n * 5_000_000).header.frame_counter == n % 256
    assert counters(assembler) == {"frames": 300}


def test_taxel_pdos_may_come_in_any_order(assembler):
    payloads = stream(1)[0][0]
    assert assembler.push(0x511, payloads[0], 0) is None
    results = [assembler.push(0x511 + n, payloads[n], n) for n in (8, 1, 7, 2, 6, 3, 5, 4)]
    assert results[-1] is not None and results[:-1] == [None] * 7


@pytest.mark.parametrize("missing", range(1, 9))
def test_a_lost_pdo_tears_its_frame_only(assembler, missing):
    (first, _), (second, _), (third, _) = stream(3)
    push_all(assembler, first)
    for n, data in enumerate(second):
        if n != missing:
            assert assembler.push(0x511 + n, data, 5_000_000) is None
    assert push_all(assembler, third, t_ns=10_000_000).header.frame_counter == 2
    assert counters(assembler) == {"frames": 2, "torn": 1, "lost": 1}


def test_a_lost_header_leaves_orphans(assembler):
    (first, _), (second, _), (third, _) = stream(3)
    push_all(assembler, first)
    for n, data in enumerate(second[1:], 1):
        assert assembler.push(0x511 + n, data, 1) is None
    push_all(assembler, third)
    assert counters(assembler) == {"frames": 2, "orphans": 8, "lost": 1}


def test_a_duplicate_drops_the_frame_and_the_rest_are_orphans(assembler):
    payloads = stream(1)[0][0]
    for n in (0, 1, 2, 2, 3, 4, 5, 6, 7, 8):
        assert assembler.push(0x511 + n, payloads[n], n) is None
    assert counters(assembler) == {"torn": 1, "duplicates": 1, "orphans": 6}


def test_halves_of_two_triggers_are_never_one_frame(assembler):
    """Header and rows of one, then (its rest and the next header lost) the rows of the next: only the CRC can tell."""
    (first, _), (second, _) = stream(2)
    for n in range(5):
        assembler.push(0x511 + n, first[n], n)
    for n in range(5, 9):
        assert assembler.push(0x511 + n, second[n], n) is None
    assert counters(assembler) == {"crc_errors": 1}


@pytest.mark.parametrize("late_ns, published", [(DEADLINE, True), (DEADLINE + 1, False)])
def test_deadline_when_the_last_pdo_comes(assembler, late_ns, published):
    payloads = stream(1)[0][0]
    for n in range(8):
        assembler.push(0x511 + n, payloads[n], 7)
    assert (assembler.push(0x519, payloads[8], 7 + late_ns) is not None) == published
    assert counters(assembler) == ({"frames": 1} if published else {"torn": 1, "orphans": 1})


def test_expire_drops_an_open_frame_once(assembler):
    assembler.push(0x511, stream(1)[0][0][0], 0)
    for t_ns in (DEADLINE, DEADLINE + 1, DEADLINE + 2):
        assembler.expire(t_ns)
    assert counters(assembler) == {"torn": 1}


def test_a_frame_sent_twice_is_published_once(assembler):
    payloads = stream(1)[0][0]
    assert push_all(assembler, payloads) is not None
    assert push_all(assembler, payloads) is None
    assert counters(assembler) == {"frames": 1, "duplicates": 1}


def test_after_reset_a_restarted_sensor_is_heard_at_once(assembler):
    payloads = stream(1)[0][0]
    push_all(assembler, payloads)
    assembler.push(0x511, payloads[0], 0)
    assembler.reset()
    assert push_all(assembler, payloads) is not None
    assert counters(assembler) == {"frames": 2}


@pytest.mark.parametrize("gap", [0, 1, 2, 254])
def test_lost_frames_from_counter_gaps_across_the_wrap(assembler, gap):
    push_all(assembler, pack_frame(header(250), image()))
    push_all(assembler, pack_frame(header((251 + gap) % 256), image()))
    assert assembler.lost == gap


@pytest.mark.parametrize("data", [b"", bytes(7), bytes(9)])
def test_pdos_of_wrong_length_tear(assembler, data):
    payloads = stream(1)[0][0]
    assembler.push(0x511, payloads[0], 0)
    assert assembler.push(0x512, data, 0) is None
    assert counters(assembler) == {"torn": 1, "malformed": 1}


def test_frames_of_another_mode_are_not_taken():
    """Nine PDOs whose header announces an image."""
    payloads = pack_frame(header(), image())
    start = bytearray(payloads[0][:6])
    start[3] = IMAGE
    crc = crc_by_bits(bytes(start) + b"".join(payloads[1:]))
    payloads[0] = bytes(start) + crc.to_bytes(2, "little")
    assembler = FrameAssembler(cob_ids(WINDOW), WINDOW, DEADLINE)
    assert push_all(assembler, payloads) is None
    assert counters(assembler) == {"malformed": 1}


def test_other_identifiers_are_ignored(assembler):
    assert assembler.push(0x51A, bytes(8), 0) is None and assembler.push(0x181, b"", 0) is None
    assert counters(assembler) == {}


@pytest.mark.parametrize(
    "ids, mode", [(range(0x511, 0x519), WINDOW), ([0x511] * 2, FEATURES), (range(0x511, 0x51A), IMAGE)]
)
def test_identifiers_must_fit_the_mode(ids, mode):
    with pytest.raises(ProtocolError):
        FrameAssembler(list(ids), mode, DEADLINE)


fault = st.sampled_from(["lose", "twice", "late", "swap"])


@settings(deadline=None, max_examples=400, derandomize=True)
@given(
    faults=st.dictionaries(st.integers(0, 6 * 9 - 1), fault, max_size=12),
    flips=st.lists(st.tuples(st.integers(0, 6 * 9 - 1), st.integers(0, 63)), max_size=3, unique=True),
    spacing_ns=st.sampled_from([0, 10_000, 300_000, 700_000]),
)
def test_no_fault_publishes_wrong_content(faults, flips, spacing_ns):
    """Loss, duplication, delay, exchange and up to three flipped bits, in six frames of different triggers."""
    sent = stream(6, start=253)
    wire = [(0x511 + n, payload) for payloads, _ in sent for n, payload in enumerate(payloads)]
    for place, bit in flips:
        can_id, data = wire[place]
        wire[place] = can_id, (int.from_bytes(data, "little") ^ 1 << bit).to_bytes(8, "little")
    arriving = []
    for place, frame in enumerate(wire):
        kind = faults.get(place)
        moved = {"late": 4.5, "swap": 1.5}.get(kind, 0)
        arriving += [] if kind == "lose" else [(place + moved, frame)]
        arriving += [(place + 0.25, frame)] if kind == "twice" else []
    arriving.sort(key=lambda item: item[0])

    assembler = FrameAssembler(cob_ids(WINDOW), WINDOW, DEADLINE)
    published = [assembler.push(*frame, n * spacing_ns) for n, (_, frame) in enumerate(arriving)]
    published = [frame for frame in published if frame is not None]
    by_counter = {(253 + n) % 256: (TactileHeader.unpack(p[0]), pad) for n, (p, pad) in enumerate(sent)}
    for frame in published:
        expected, pad = by_counter.pop(frame.header.frame_counter)  # and none twice
        assert frame.header == expected
        assert frame.body == inside(pad, expected.origin_row, expected.origin_col)
    assert assembler.frames == len(published)
    touched = {place // 9 for place in [*faults, *(p for p, _ in flips)]}
    late = {(place + 5) // 9 for place, kind in faults.items() if kind in ("late", "swap")}
    untouched = set(range(6)) - touched - late
    if spacing_ns * 9 <= DEADLINE:
        assert {(253 + n) % 256 for n in untouched} <= {frame.header.frame_counter for frame in published}


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0x50F, 0x51B), st.binary(max_size=9), st.integers(-5, 10**8)), max_size=60))
def test_any_traffic_never_raises(traffic):
    assembler = FrameAssembler(cob_ids(WINDOW), WINDOW, DEADLINE)
    for can_id, data, t_ns in traffic:
        assembler.push(can_id, data, t_ns)


# Windows of every size on the wire: each taxel where it was, nothing else, and a length that their number settles.

MODE = TactileMode.WINDOW
PDOS = {4: 3, 6: 6, 8: 9, 10: 14, 12: 19}  # header and side² / 8 payloads, rounded up: by hand


def window_header(side, row=0, col=0):
    return TactileHeader(7, 200, row, col, MODE, False, 5000, window=side)


def ids(side):
    return range(0x511, 0x511 + PDOS[side])


def assemble(side, payloads, expected=None):
    assembler = FrameAssembler(ids(side), MODE, 10**7, window=side if expected is None else expected)
    frames = [assembler.push(can_id, data, 0) for can_id, data in zip(ids(side), payloads, strict=True)]
    return assembler, frames[-1]


@given(st.sampled_from(WINDOW_SIZES), st.data())
def test_every_taxel_comes_back_to_its_place(side, data):
    row, col = (data.draw(st.integers(0, 16 - side), label=name) for name in ("row", "column"))
    pad = data.draw(st.binary(min_size=256, max_size=256))
    payloads = pack_frame(window_header(side, row, col), pad)
    assert len(payloads) == PDOS[side]
    assert {len(payload) for payload in payloads} == {8}
    _, frame = assemble(side, payloads)
    assert (frame.header.origin_row, frame.header.origin_col, frame.header.window) == (row, col, side)
    filled = bytes(-(side * side) % 8)
    assert frame.body == inside(pad, row, col, side) + filled


@pytest.mark.parametrize("side", WINDOW_SIZES)
def test_the_flags_tell_the_size_and_8_is_as_it_always_was(side):
    start = pack_frame(window_header(side), bytes(side * side))[0]
    assert start[3] == 1 + (0 if side == 8 else side << 4)
    assert TactileHeader.unpack(start).window == side


@pytest.mark.parametrize("flags", [0x51, 0x81, 0xF1, 0x40, 0x42, 0x09])
def test_sizes_that_no_sensor_has_and_sizes_in_other_modes_are_refused(flags):
    with pytest.raises(ProtocolError, match="reserved flags"):
        TactileHeader.unpack(bytes([1, 1, 0, flags, 0, 0, 0, 0]))


def test_a_window_that_leaves_the_pad_is_refused():
    assert pack_frame(window_header(4, 12, 12), bytes(256))
    with pytest.raises(ProtocolError, match=r"cannot begin at taxel \(5, 0\)"):
        pack_whole(window_header(12, 5, 0), bytes(144))
    with pytest.raises(ProtocolError, match="not 7"):
        pack_whole(window_header(7), bytes(49))


def test_a_frame_of_another_window_is_malformed_even_with_the_right_length_and_crc():
    """Four payloads more or fewer cannot come; the same number with another size in the header can."""
    payloads = pack_frame(window_header(6), bytes([9] * 36))
    start = bytearray(payloads[0])
    start[3] = 1 | 4 << 4
    crc = crc16_ccitt(b"".join(payloads[1:]), crc16_ccitt(bytes(start[:6])))
    assembler, frame = assemble(6, [bytes(start[:6]) + crc.to_bytes(2, "little"), *payloads[1:]])
    assert frame is None and assembler.malformed == 1 and assembler.crc_errors == 0


def test_the_identifiers_must_be_those_of_the_window():
    with pytest.raises(ProtocolError, match="window frames need"):
        FrameAssembler(ids(8), MODE, 10**7, window=10)
