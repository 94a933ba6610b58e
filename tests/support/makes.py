"""EDS files of CiA 402 drives as different makers write them: the standard's objects, and what each make changes.

Each make is what public manuals and driver sources report of a drive on the market: which modes it has, what it lacks,
what is read-only or limited, and how it expresses the interpolation time. None is a maker's file. `write_eds(make,
folder)` writes one; `MAKES` lists them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

TYPES = {
    "BOOL": 1, "I8": 2, "I16": 3, "I32": 4, "U8": 5, "U16": 6, "U32": 7, "R32": 8, "STR": 9, "DOMAIN": 15, "U64": 27,
}  # fmt: skip
SIZES = {"BOOL": 8, "I8": 8, "I16": 16, "I32": 32, "U8": 8, "U16": 16, "U32": 32}
Place = tuple[int, int]


@dataclass(frozen=True)
class Entry:
    """One variable of an EDS: its default is written as it stands, so that it may hold $NODEID."""

    name: str
    type: str
    access: str
    default: int | str = 0
    low: int | None = None
    high: int | None = None
    mappable: bool = False


@dataclass(frozen=True)
class Make:
    """One make of drive.

    Attributes:
        name: file name without suffix.
        product: product code.
        revision: of 1018h.
        objects: variables by (index, subindex).
        dummies: data types that DummyUsage allows.
        bitrates: kbit/s.
        lss: LSS is supported.
    """

    name: str
    product: int
    revision: int = 0x0001_0000
    objects: dict[Place, Entry] = field(default_factory=dict)
    dummies: tuple[int, ...] = (2, 3, 4, 5, 6, 7)
    bitrates: tuple[int, ...] = (125, 250, 500, 1000)
    lss: bool = False


def word(index: int, subindex: int, bits: int) -> int:
    """An object as a mapping entry."""
    return index << 16 | subindex << 8 | bits


def pdo(
    direction: str,
    number: int,
    mapped: Iterable[int] = (),
    *,
    places: int = 8,
    cob_id: str | None = None,
    fixed: bool = False,
    transmission_type: int = 1,
) -> dict[Place, Entry]:
    """Communication and mapping parameters of one PDO; `fixed` makes mapping and COB-ID read-only."""
    base = {"rpdo": (0x1400, 0x1600, 0x200), "tpdo": (0x1800, 0x1A00, 0x180)}[direction]
    communication, mapping, access = base[0] + number - 1, base[1] + number - 1, "ro" if fixed else "rw"
    default = cob_id or (f"$NODEID+{base[2] + 0x100 * (number - 1):#x}" if number <= 4 else "0x80000000")
    words = list(mapped)
    found = {
        (communication, 0): Entry("Highest sub-index supported", "U8", "ro", 5),
        (communication, 1): Entry("COB-ID", "U32", access, default),
        (communication, 2): Entry("Transmission type", "U8", "rw", transmission_type),
        (communication, 3): Entry("Inhibit time", "U16", "rw", 0),
        (communication, 5): Entry("Event timer", "U16", "rw", 0),
        (mapping, 0): Entry("Number of mapped objects", "U8", access, len(words)),
    }
    for subindex in range(1, (len(words) if fixed else places) + 1):
        value = words[subindex - 1] if subindex <= len(words) else 0
        found[mapping, subindex] = Entry(f"Mapped object {subindex}", "U32", access, f"{value:#010x}")
    return found


def communication(device_type: str, name: str, *, errors: int, consumers: int) -> dict[Place, Entry]:
    """The objects of CiA 301 that nearly every device has; `errors` and `consumers` are entries of 1003h and 1016h."""
    numbers = ("Vendor-ID", "Product code", "Revision number", "Serial number")
    return {
        (0x1000, 0): Entry("Device type", "U32", "ro", device_type),
        (0x1001, 0): Entry("Error register", "U8", "ro", 0, mappable=True),
        (0x1003, 0): Entry("Number of errors", "U8", "rw", 0),
        **{(0x1003, n): Entry(f"Error {n}", "U32", "ro", 0) for n in range(1, errors + 1)},
        (0x1005, 0): Entry("COB-ID SYNC", "U32", "rw", "0x80"),
        (0x1006, 0): Entry("Communication cycle period", "U32", "rw", 0),
        (0x1008, 0): Entry("Manufacturer device name", "STR", "const", name),
        (0x1014, 0): Entry("COB-ID EMCY", "U32", "rw", "$NODEID+0x80"),
        (0x1015, 0): Entry("Inhibit time EMCY", "U16", "rw", 0),
        (0x1016, 0): Entry("Number of consumers", "U8", "ro", consumers),
        **{(0x1016, n): Entry("Consumer heartbeat time", "U32", "rw", 0) for n in range(1, consumers + 1)},
        (0x1017, 0): Entry("Producer heartbeat time", "U16", "rw", 0),
        (0x1018, 0): Entry("Highest sub-index supported", "U8", "ro", 4),
        **{(0x1018, n): Entry(number, "U32", "ro", 0) for n, number in enumerate(numbers, start=1)},
        (0x1019, 0): Entry("Synchronous counter overflow value", "U8", "rw", 0),
    }


def standard_drive(modes: int = 0x81) -> dict[Place, Entry]:
    """The objects that nearly every servo drive has, with four PDOs each way; `modes` is 6502h."""
    objects = communication("0x00020192", "drive", errors=4, consumers=1) | {
        (0x6007, 0): Entry("Abort connection option code", "I16", "rw", 3),
        (0x603F, 0): Entry("Error code", "U16", "ro", 0, mappable=True),
        (0x6040, 0): Entry("Controlword", "U16", "rww", 0, mappable=True),
        (0x6041, 0): Entry("Statusword", "U16", "ro", 0, mappable=True),
        (0x605A, 0): Entry("Quick stop option code", "I16", "rw", 2),
        (0x6060, 0): Entry("Modes of operation", "I8", "rww", 0, mappable=True),
        (0x6061, 0): Entry("Modes of operation display", "I8", "ro", 0, mappable=True),
        (0x6064, 0): Entry("Position actual value", "I32", "ro", 0, mappable=True),
        (0x6065, 0): Entry("Following error window", "U32", "rw", 4000),
        (0x6066, 0): Entry("Following error time out", "U16", "rw", 50),
        (0x606C, 0): Entry("Velocity actual value", "I32", "ro", 0, mappable=True),
        (0x6077, 0): Entry("Torque actual value", "I16", "ro", 0, mappable=True),
        (0x607A, 0): Entry("Target position", "I32", "rww", 0, mappable=True),
        (0x607C, 0): Entry("Home offset", "I32", "rw", 0),
        (0x607D, 0): Entry("Highest sub-index supported", "U8", "ro", 2),
        (0x607D, 1): Entry("Minimal position limit", "I32", "rw", "-2147483648"),
        (0x607D, 2): Entry("Maximal position limit", "I32", "rw", 2147483647),
        (0x607F, 0): Entry("Max profile velocity", "U32", "rw", 10_000_000),
        (0x6081, 0): Entry("Profile velocity", "U32", "rww", 100_000, mappable=True),
        (0x6083, 0): Entry("Profile acceleration", "U32", "rw", 1_000_000),
        (0x6084, 0): Entry("Profile deceleration", "U32", "rw", 1_000_000),
        (0x6085, 0): Entry("Quick stop deceleration", "U32", "rw", 10_000_000),
        (0x6098, 0): Entry("Homing method", "I8", "rw", 0),
        (0x6099, 0): Entry("Highest sub-index supported", "U8", "ro", 2),
        (0x6099, 1): Entry("Speed during search for switch", "U32", "rw", 10_000),
        (0x6099, 2): Entry("Speed during search for zero", "U32", "rw", 1_000),
        (0x609A, 0): Entry("Homing acceleration", "U32", "rw", 100_000),
        (0x60C2, 0): Entry("Highest sub-index supported", "U8", "ro", 2),
        (0x60C2, 1): Entry("Interpolation time period value", "U8", "rw", 1),
        (0x60C2, 2): Entry("Interpolation time index", "I8", "rw", -3),
        (0x60F4, 0): Entry("Following error actual value", "I32", "ro", 0, mappable=True),
        (0x6502, 0): Entry("Supported drive modes", "U32", "ro", f"{modes:#x}"),
    }
    feedback = (word(0x6041, 0, 16), word(0x6064, 0, 32))
    for number in (1, 2, 3, 4):
        objects |= pdo("rpdo", number, (word(0x6040, 0, 16),) if number == 1 else ())
        objects |= pdo("tpdo", number, feedback if number == 1 else ())
    return objects


def changed(objects: dict[Place, Entry], *place: int, **values: object) -> None:
    """Change one variable in place."""
    index, subindex = (*place, 0)[:2]
    objects[index, subindex] = replace(objects[index, subindex], **values)  # type: ignore[arg-type]


def without(objects: dict[Place, Entry], *indices: int) -> None:
    """Remove whole objects in place."""
    for place in [place for place in objects if place[0] in indices]:
        del objects[place]


def milliseconds_only() -> Make:
    """60C2h:02 is always -3; :01 is 0 as delivered; no 1006h, 1019h or 607Fh; 1005h constant.

    Source: as maxon EPOS4; units are fixed increments.
    """
    objects = standard_drive(modes=0x3A5)
    without(objects, 0x1006, 0x1019, 0x607F)
    changed(objects, 0x1005, access="const")
    changed(objects, 0x60C2, 1, default=0, low=0, high=100)
    changed(objects, 0x60C2, 2, access="const")
    changed(objects, 0x605A, default=6, low=0, high=6)
    return Make("milliseconds_only", 0x0101, objects=objects, dummies=())


def microsecond_index() -> Make:
    """60C2h:02 from -6 to -2, one heartbeat consumer, 605Ah read-only, dummies of one byte alone.

    Source: as Elmo Gold.
    """
    objects = standard_drive(modes=0x3E1)
    changed(objects, 0x60C2, 2, low=-6, high=-2)
    changed(objects, 0x605A, access="ro")
    changed(objects, 0x6077, mappable=False)
    return Make("microsecond_index", 0x0102, objects=objects, dummies=(5,))


def late_target() -> Make:
    """607Ah is 4000 as delivered, 60C2h:02 takes -3 only, eight PDOs each way, 6065h with a high limit.

    Source: as Nanotec C5-E.
    """
    objects = standard_drive(modes=0x3EF)
    changed(objects, 0x607A, default=4000)
    changed(objects, 0x60C2, 2, low=-3, high=-3)
    changed(objects, 0x6065, high=2000)
    for number in range(5, 9):
        objects |= pdo("rpdo", number) | pdo("tpdo", number)
    return Make("late_target", 0x0103, objects=objects)


def bare() -> Make:
    """Neither 1016h nor 605Ah, 6007h, 6065h, 6066h, 607Dh, 607Fh; 6502h missing; 60C2h in tenths of milliseconds.

    Source: what the smallest drives leave out (Faulhaber, Engel).
    """
    objects = standard_drive()
    without(objects, 0x1016, 0x1003, 0x6007, 0x605A, 0x6065, 0x6066, 0x607D, 0x607F, 0x6502, 0x6098, 0x6099, 0x609A)
    changed(objects, 0x60C2, 1, high=255)
    changed(objects, 0x60C2, 2, low=-4, high=-3)
    return Make("bare", 0x0104, objects=objects)


def fixed_mapping() -> Make:
    """PDOs that cannot be mapped: feedback in TPDO3 with the velocity behind it, commands in RPDO3 with a speed.

    Source: as MCBL-CF and as many compact drives.
    """
    objects = standard_drive(modes=0x81)
    command = (word(0x6040, 0, 16), word(0x607A, 0, 32))
    feedback = (word(0x6041, 0, 16), word(0x6064, 0, 32), word(0x6077, 0, 16))
    for index in range(1, 5):
        without(objects, 0x1400 + index - 1, 0x1600 + index - 1, 0x1800 + index - 1, 0x1A00 + index - 1)
    objects |= pdo("rpdo", 1, (word(0x6040, 0, 16),), fixed=True, transmission_type=255)
    objects |= pdo("rpdo", 3, command, fixed=True)
    objects |= pdo("tpdo", 1, (word(0x6041, 0, 16),), fixed=True, transmission_type=255)
    objects |= pdo("tpdo", 3, feedback, fixed=True)
    changed(objects, 0x60C2, 2, access="ro", default=-4)
    return Make("fixed_mapping", 0x0105, objects=objects)


def interpolated() -> Make:
    """No cyclic position: interpolated position (7) with 60C1h, two RPDOs, unit 1/1000 degree, no homing.

    Source: as the Schunk LWA4P and Pilz PRBT drives.
    """
    objects = standard_drive(modes=0x43)
    without(objects, 0x1006, 0x1007, 0x1010, 0x1019, 0x605A, 0x6007, 0x6066, 0x1402, 0x1602, 0x1403, 0x1603)
    without(objects, 0x6084, 0x6099, 0x609A, 0x1016)
    changed(objects, 0x6098, access="const")
    changed(objects, 0x60C2, 1, default=8)
    objects |= {
        (0x1016, 0): Entry("Number of consumers", "U8", "ro", 1),
        (0x1016, 1): Entry("Consumer heartbeat time", "U32", "rw", 0),
        (0x2000 + 0xE, 0): Entry("SYNC time-out factor", "U16", "rw", 6),
        (0x6042, 0): Entry("vl target velocity", "I16", "rww", 0, mappable=True),
        (0x60C0, 0): Entry("Interpolation sub mode select", "I16", "rw", 0, low=-1, high=0),
        (0x60C1, 0): Entry("Highest sub-index supported", "U8", "ro", 1),
        (0x60C1, 1): Entry("Interpolation data record", "I32", "rww", 0, mappable=True),
    }
    return Make("interpolated", 0x0106, objects=objects)


def tpdo_without_rtr() -> Make:
    """COB-IDs of TPDOs with bit 30 set (no RTR) that must stay; 60C2h:02 read-only -3; 1018h with a newer minor.

    Source: as Eyou.
    """
    objects = standard_drive(modes=0x3CD)
    for number in (1, 2, 3, 4):
        changed(objects, 0x1800 + number - 1, 1, default=f"$NODEID+{0x40000000 + 0x80 + 0x100 * number:#x}")
    changed(objects, 0x60C2, 2, access="ro")
    without(objects, 0x6098, 0x6099, 0x609A)
    return Make("tpdo_without_rtr", 0x0107, revision=0x0001_0004, objects=objects)


def no_cyclic_mode() -> Make:
    """Profile modes and homing alone: such a drive is moved by hand, and holds no contact.

    Source: as Faulhaber MCDC V2.
    """
    objects = standard_drive(modes=0x25)
    without(objects, 0x60C2)
    return Make("no_cyclic_mode", 0x0108, objects=objects)


MAKES: dict[str, Callable[[], Make]] = {
    make.__name__: make
    for make in (
        milliseconds_only,
        microsecond_index,
        late_target,
        bare,
        fixed_mapping,
        interpolated,
        tpdo_without_rtr,
        no_cyclic_mode,
    )
}


def write_eds(make: Make | str, folder: Path) -> Path:
    """Write a make's EDS into a folder and return its path."""
    make = MAKES[make]() if isinstance(make, str) else make
    path = folder / f"{make.name}.eds"
    path.write_text(eds_text(make), encoding="ascii")
    return path


def eds_text(make: Make) -> str:
    """The EDS of a make."""
    return "\n".join(_lines(make))


def _lines(make: Make) -> Iterator[str]:
    objects = dict(make.objects)
    for subindex, value in ((1, 0xCA5E), (2, make.product), (3, make.revision)):
        changed(objects, 0x1018, subindex, default=f"{value:#010x}")
    indices = sorted({index for index, _ in objects})
    yield from ("[FileInfo]", f"FileName={make.name}.eds", "FileVersion=1", "FileRevision=0", "EDSVersion=4.0", "")
    yield from ("[DeviceInfo]", "VendorName=test", "VendorNumber=0xCA5E", f"ProductName={make.name}")
    yield from (f"ProductNumber={make.product:#x}", f"RevisionNumber={make.revision:#x}", "Granularity=8")
    yield from (f"BaudRate_{rate}={int(rate in make.bitrates)}" for rate in (10, 20, 50, 125, 250, 500, 800, 1000))
    yield f"NrOfRXPDO={sum(0x1400 <= index < 0x1600 for index in indices)}"
    yield from (f"NrOfTXPDO={sum(0x1800 <= index < 0x1A00 for index in indices)}", f"LSS_Supported={int(make.lss)}", "")
    yield from ("[DummyUsage]", *(f"Dummy000{n}={int(n in make.dummies)}" for n in range(1, 8)), "")
    mandatory = (0x1000, 0x1001, 0x1018)
    groups = {
        "MandatoryObjects": [index for index in indices if index in mandatory],
        "OptionalObjects": [i for i in indices if i not in mandatory and not 0x2000 <= i < 0x6000],
        "ManufacturerObjects": [index for index in indices if 0x2000 <= index < 0x6000],
    }
    for name, listed in groups.items():
        yield from (f"[{name}]", f"SupportedObjects={len(listed)}")
        yield from (f"{n}={index:#06x}" for n, index in enumerate(listed, start=1))
        yield ""
    for index in indices:
        subindices = sorted(sub for other, sub in objects if other == index)
        if subindices == [0]:
            yield from _variable(f"{index:04X}", objects[index, 0])
            continue
        yield from (f"[{index:04X}]", f"ParameterName=Object {index:04X}h", "ObjectType=0x9")
        yield from (f"SubNumber={len(subindices)}", "")
        for subindex in subindices:
            yield from _variable(f"{index:04X}sub{subindex:X}", objects[index, subindex])


def _variable(section: str, entry: Entry) -> Iterator[str]:
    yield from (f"[{section}]", f"ParameterName={entry.name}", "ObjectType=0x7")
    yield from (f"DataType={TYPES[entry.type]:#06x}", f"AccessType={entry.access}")
    if entry.low is not None:
        yield f"LowLimit={entry.low}"
    if entry.high is not None:
        yield f"HighLimit={entry.high}"
    if entry.default != "":
        yield f"DefaultValue={entry.default}"
    yield from (f"PDOMapping={int(entry.mappable)}", "")
