"""A drive under random orders: it answers, its state is one of the table's, and after a reset it works."""

from __future__ import annotations

import random

import pytest
from makes import MAKES, write_eds
from puma_arm import ELBOW_FORM, UPENN

from canprobe.cell.plant.config import PlantConfig
from canprobe.cell.plant.plant import Plant
from canprobe.fieldbus.drive.drive import make_drive_node
from canprobe.fieldbus.eds.packaged import load_eds
from canprobe.fieldbus.protocol.cia402 import state_of

WRITES = (
    *(0x6007, 0x605A, 0x605B, 0x605C, 0x605D, 0x605E, 0x6065, 0x6066, 0x6067, 0x6068, 0x6071, 0x6072, 0x607A, 0x607C),
    *(0x607F, 0x6081, 0x6083, 0x6084, 0x6085, 0x6098, 0x609A, 0x60B0, 0x60B1, 0x60B2, 0x60FF),
)
PARTS = (
    *((0x607D, 1), (0x607D, 2), (0x608F, 1), (0x6091, 2), (0x6092, 1), (0x6099, 1), (0x6099, 2), (0x60C2, 1)),
    (0x60C2, 2),
)
WORDS = (*[0x0F] * 4, 0x1F, 0x3F, 0x5F, 0x7F, 0x10F, 0x11F, 0x02, 0x06, 0x07, 0x00, 0x80)


def write_anything(rig, rng):
    index, sub = rng.choice([(index, 0) for index in WRITES] + list(PARTS))
    entry = rig.drive.node.dictionary.find(index, sub)
    low, high = rng.choice([(-10, 10), (0, 3), (-(10**4), 10**4), (-(2**31), 2**32 - 1)])
    rig.drive.write(index, sub, rng.randint(low, high) & (1 << entry.bits) - 1, entry.bits // 8)


def live(rig, rng):
    choice = rng.random()
    if choice < 0.3:
        write_anything(rig, rng)
    elif choice < 0.5:
        rig.drive.write(0x6040, 0, rng.choice(WORDS), 2)
    elif choice < 0.6:
        rig.drive.write(0x6060, 0, rng.choice((0, 1, 6, 8, 9, 10)), 1)
    elif choice < 0.8:
        rig.cycles(
            rng.randint(1, 4), rpdo=rng.choice(WORDS).to_bytes(2, "little").hex() + rng.randbytes(2).hex() + "0000"
        )
    else:
        rig.drive.advance(rig.drive.t_ns + rng.randint(0, 30_000_000))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("arm", [False, True])
def test_random_orders(rig, seed, arm):
    if arm:
        rig.drive.node = make_drive_node(
            load_eds("puma260_joint", 1), 1, 0, Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None))
        )
        rig.drive.node.start(0)
        rig.put(_1019=240, _1006=2500)
    rng = random.Random(seed)
    rig.drive.nmt(0x01)
    for _ in range(250):
        live(rig, rng)
        assert state_of(rig.drive.read(0x6041)) is rig.drive.node.application.state
        for index in (0x6061, 0x6062, 0x6064, 0x606B, 0x606C, 0x6077, 0x60F4):
            rig.drive.read(index)
    rig.drive.nmt(0x81)
    rig.put(_6060=6, _6098=37)
    for word in (0x00, 0x80, 0x06, 0x07, 0x0F, 0x1F, 0x0F):
        rig.word(word)
    rig.put(_6060=1, _607A=200).word(0x1F).run(400)  # from the new zero, wherever it is
    assert rig.bits(10, 11) == (1, 0)
    assert abs(rig.signed(0x6064) - 200) <= 10


@pytest.mark.parametrize("make", [*MAKES, "prbt_joint"])
def test_random_orders_to_other_makes(rig, make, tmp_path):
    od = load_eds(make if make not in MAKES else write_eds(make, tmp_path), 1)
    rig.plant = Plant(PlantConfig(UPENN, ELBOW_FORM, taxels=None))
    rig.drive.node = node = make_drive_node(od, 1, 0, rig.plant, incremental=True, seed=1)
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
