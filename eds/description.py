"""Statements of an EDS file on a device: a `DescribedEntry` per (index, subindex), and the features of [DeviceInfo].

`load_eds` gives the dictionary, `Description(od)` reads it. The entry of an object or sub-index that the file does not
describe is None. Source: CiA 306-1, "Object description", "Dummy usage", "Device information"; CiA 402-2, 6502h.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from canopen.objectdictionary import ObjectDictionary, ODArray, ODVariable, datatypes

from canprobe.fieldbus.eds import values
from canprobe.fieldbus.eds.values import Value
from canprobe.fieldbus.protocol.pdo import RPDOS, TPDOS

LAST_DUMMY = 0x0007
"""Last index of a data type; DummyUsage lists those that an RPDO may map to fill room."""
_MODES_INDEX = 0x6502


@dataclass(frozen=True, slots=True)
class DescribedEntry:
    """One value of the object dictionary, as the file describes it for one node.

    Attributes:
        index, subindex: place of the entry; an index up to `LAST_DUMMY` is a dummy type.
        name: name, ParameterName.
        data_type: data type of CiA 301, such as 7 for UNSIGNED32.
        bits: length of a value, 8 for a BOOLEAN; 0 for texts, octets and domains, which have no fixed one.
        signed: whether it is an integer in two's complement.
        access: access, AccessType: ro, wo, rw, rwr, rww or const.
        mappable: whether a PDO may map it, PDOMapping.
        low, high: limits, LowLimit and HighLimit; None: not stated.
        default: value after a reset, DefaultValue with $NODEID put in; None: not stated.
        configured: value of a DCF, ParameterValue; None: not stated.
    """

    index: int
    subindex: int
    name: str
    data_type: int
    bits: int
    signed: bool
    access: str
    mappable: bool
    low: int | float | None
    high: int | float | None
    default: Value | None
    configured: Value | None

    @property
    def place(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.subindex

    @property
    def initial(self) -> Value | None:
        """Value at boot: ParameterValue, or else DefaultValue."""
        return self.default if self.configured is None else self.configured

    @property
    def is_integer(self) -> bool:
        """Whether it holds an integer, and not a real number, text or octets."""
        return self.data_type in values.SIGNED_BITS or self.data_type in values.UNSIGNED_BITS

    @property
    def readable(self) -> bool:
        """Whether SDO may read it."""
        return self.access != "wo"

    @property
    def writable(self) -> bool:
        """Whether SDO may write it."""
        return self.access not in {"ro", "const"}

    @property
    def in_tpdo(self) -> bool:
        """Whether a TPDO may map it."""
        return self.index > LAST_DUMMY and self.mappable and self.access not in {"wo", "rww"}

    @property
    def in_rpdo(self) -> bool:
        """Whether an RPDO may map it: it can be written and mapped, or is a dummy."""
        return self.index <= LAST_DUMMY or (self.mappable and self.access in {"wo", "rw", "rww"})

    @property
    def pdo_bits(self) -> int:
        """Length in a PDO: that of a value over SDO, but one bit of a BOOLEAN."""
        return 1 if self.data_type == datatypes.BOOLEAN else self.bits

    def fits_pdo(self, bits: int) -> bool:
        """Whether a PDO may carry it in so many bits; some devices map a BOOLEAN as a byte."""
        return bits > 0 and bits in (self.bits, self.pdo_bits)

    def allows(self, value: float) -> bool:
        """Whether a number lies within LowLimit and HighLimit, and within the range of an integer type."""
        low, high = self.low, self.high
        if self.is_integer:
            least = -(1 << self.bits - 1) if self.signed else 0
            most = least + (1 << self.bits) - 1
            low, high = least if low is None else max(low, least), most if high is None else min(high, most)
        return (low is None or value >= low) and (high is None or value <= high)


@dataclass(frozen=True, slots=True)
class Description:
    """A device as its EDS file describes it.

    Attributes:
        od: object dictionary from `load_eds`.
    """

    od: ObjectDictionary

    def entry(self, index: int, subindex: int = 0) -> DescribedEntry | None:
        """Entry at a place; None where the object or the sub-index is missing."""
        found = variable_at(self.od, index, subindex)
        if found is not None:
            return described_entry(found)
        array = self.od.indices.get(index)
        if not isinstance(array, ODArray) or not 0 < subindex <= _array_length(array):
            return None
        first = described_entry(array.subindices[1])  # the first member is described and stands for all
        return replace(first, subindex=subindex, name=f"{first.name}_{subindex:x}")

    def entries(self) -> Iterator[DescribedEntry]:
        """All entries that are described, with the dummy types."""
        for found in self.od.indices.values():
            for variable in (found,) if isinstance(found, ODVariable) else found.subindices.values():
                yield described_entry(variable)

    @property
    def dummies(self) -> frozenset[int]:
        """Data types that DummyUsage allows in an RPDO."""
        return frozenset(index for index in self.od.indices if index <= LAST_DUMMY)

    @property
    def rpdos(self) -> tuple[int, ...]:
        """Numbers of the RPDOs, 1 for 1400h."""
        return _numbers(self.od, RPDOS)

    @property
    def tpdos(self) -> tuple[int, ...]:
        """Numbers of the TPDOs, 1 for 1800h."""
        return _numbers(self.od, TPDOS)

    @property
    def modes(self) -> frozenset[int] | None:
        """Modes of operation that the default of 6502h lists, as 6060h numbers them; None where it is not stated."""
        entry = self.entry(_MODES_INDEX)
        if entry is None or not isinstance(entry.initial, int):
            return None
        return frozenset(bit + 1 for bit in range(32) if entry.initial >> bit & 1)

    @property
    def bitrates(self) -> tuple[int, ...]:
        """Bit rates, bit/s; empty where the file lists none."""
        return tuple(sorted(self.od.device_information.allowed_baudrates))


def variable_at(od: ObjectDictionary, index: int, subindex: int) -> ODVariable | None:
    """Variable that the dictionary itself has at a place, without the array members that canopen makes up."""
    found = od.indices.get(index)
    if isinstance(found, ODVariable):
        return found if subindex == 0 else None
    return found.subindices.get(subindex) if found is not None else None


def _numbers(od: ObjectDictionary, area: range) -> tuple[int, ...]:
    return tuple(sorted(area.index(index) + 1 for index in od.indices if index in area))


def _array_length(array: ODArray) -> int:
    """Highest sub-index by the default of sub-index 0."""
    count = array.subindices[0].default if 0 in array.subindices and 1 in array.subindices else 0
    return min(count, 254) if isinstance(count, int) else 0


def described_entry(variable: ODVariable) -> DescribedEntry:
    """What a variable of a dictionary states."""
    data_type = variable.data_type or int(datatypes.DOMAIN)
    unfixed = data_type in values.TEXT_TYPES | values.OCTET_TYPES
    bits = 0 if unfixed else values.TIME_BITS if data_type in values.TIME_TYPES else len(variable)
    return DescribedEntry(
        index=variable.index,
        subindex=variable.subindex,
        name=variable.name,
        data_type=data_type,
        bits=bits,
        signed=data_type in values.SIGNED_BITS,
        access=variable.access_type,
        mappable=variable.pdo_mappable,
        low=variable.min,
        high=variable.max,
        default=variable.default,
        configured=variable.value,
    )
