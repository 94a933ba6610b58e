"""No frame, however broken, makes a node raise or fall silent for good."""

from __future__ import annotations

import random

import pytest

from canprobe.eds import load_eds
from canprobe.emulator.drive import make_drive_node
from canprobe.emulator.tactile import make_tactile_node


def make_node(kind, bench, plant):
    if kind == "tiny":
        return bench.node
    if kind == "drive":
        return make_drive_node(load_eds("puma260_joint", 5), 5, 0, plant)
    return make_tactile_node(load_eds("tactile_array", 5), 5, plant)


@pytest.mark.parametrize("kind", ["tiny", "drive", "tactile"])
def test_20000_random_frames(kind, bench, plant):
    node = make_node(kind, bench, plant)
    seed = 20260
    rng = random.Random(seed)
    node.start(0)
    indices = sorted({key >> 8 for key in node.dictionary.entries})
    ids = [0x000, 0x080, 0x605, 0x605, 0x605, 0x605, 0x205, 0x305, 0x77F]
    t_ns = 0
    for _ in range(20_000):
        t_ns += rng.choice((0, 1, 10**5, 10**6, 10**8, 10**11 if rng.random() < 0.01 else 3))
        can_id = rng.choice(ids) if rng.random() < 0.95 else rng.randrange(0x800)
        data = bytearray(rng.randbytes(rng.choice((0, 1, 2, 5, 6, 7, 8, 8, 8, 8))))
        if can_id == 0x605 and len(data) == 8 and rng.random() < 0.8:
            data[0] = rng.choice(
                (0x40, 0x2F, 0x2B, 0x23, 0x22, 0x21, 0x60, 0x70, 0x00, 0x11, 0xA4, 0xC6, 0xA3, 0xA2, 0xC1)
            )
            data[1:3] = rng.choice(indices).to_bytes(2, "little")
            data[3] = rng.randrange(4)
        if can_id == 0 and len(data) == 2:
            data[:] = bytes((rng.choice((1, 1, 1, 1, 2, 0x80, 0x81, 0x82, 7)), rng.choice((0, 5, 5, 6))))
        frames = node.receive(can_id, bytes(data), t_ns) + node.advance(t_ns)
        for answer_id, answer in frames:
            assert 0 <= answer_id <= 0x7FF and len(answer) <= 8, f"seed {seed}"
        assert node.next_deadline_ns is None or node.next_deadline_ns > t_ns
    node.receive(0, b"\x81\x05", t_ns)
    answers = node.receive(0x605, bytes.fromhex("4018100100000000"), t_ns)
    kinds = [data[0] for can_id, data in answers if can_id == 0x585]
    assert kinds, f"seed {seed}: the server does not answer any more"
