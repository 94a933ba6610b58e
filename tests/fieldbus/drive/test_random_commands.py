"""A drive under random orders: it answers, its state is one of the table's, and after a reset it works."""

from __future__ import annotations

import random

import pytest
from makes import MAKES, write_eds
from random_orders import WORDS

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import IdealAxis, make_drive_node
from canprobe.fieldbus.protocol.cia402 import state_of


@pytest.mark.parametrize("make", [*MAKES, "prbt_joint"])
def test_random_orders_to_other_makes(rig, make, tmp_path):
    od = load_eds(make if make not in MAKES else write_eds(make, tmp_path), 1)
    rig.drive.node = node = make_drive_node(od, 1, 0, IdealAxis(), incremental=True, seed=1)
    node.start(0)
    rng, dictionary = random.Random(make), node.dictionary
    places = [key for key, entry in dictionary.entries.items() if key >> 8 >= 0x1000 and entry.writable]
    shown = [index for index in (0x6061, 0x6064, 0x606C, 0x6077, 0x60F4) if dictionary.has_index(index)]
    rig.drive.nmt(0x01)
    for _ in range(300):
        choice = rng.random()
        if choice < 0.3:
            entry = dictionary.entries[rng.choice(places)]
            low, high = rng.choice([(-10, 10), (0, 3), (-(10**4), 10**4), (-(2**31), 2**32 - 1)])
            value = rng.randint(low, high) & (1 << entry.bits) - 1
            rig.drive.write(entry.key >> 8, entry.key & 0xFF, value, entry.bits // 8)
            rig.drive.nmt(0x01)
        elif choice < 0.55:
            rig.drive.write(0x6040, 0, rng.choice(WORDS), 2)
        elif choice < 0.65:
            rig.drive.write(0x6060, 0, rng.choice((0, 1, 6, 7, 7, 8, 8)), 1)
        elif choice < 0.8:
            rig.drive.advance(rig.drive.t_ns + 2_500_000)
            rig.drive.send(0x80, "")
        else:
            rig.drive.advance(rig.drive.t_ns + rng.randint(0, 30_000_000))
        assert state_of(rig.drive.read(0x6041)) is node.application.state
        for index in shown:
            rig.drive.read(index)
    rig.drive.nmt(0x81)
    for word in (0x00, 0x80, 0x06, 0x07, 0x0F):
        rig.word(word)
    assert rig.drive.read(0x6041) & 0x6F == 0x27
