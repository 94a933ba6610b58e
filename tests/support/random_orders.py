"""Random orders to a drive: objects, controlwords, modes, RPDOs and time."""

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
