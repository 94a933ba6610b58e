"""What a device can, read from its EDS: objects, PDOs, mapping, dummies, identity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from canprobe.eds import has_long_pdos, load_eds
from canprobe.planning.model import Direction, Identity
from canprobe.protocol.pdo import PdoEntry

_COMMUNICATION: dict[Direction, int] = {"rpdo": 0x1400, "tpdo": 0x1800}
_MAPPING: dict[Direction, int] = {"rpdo": 0x1600, "tpdo": 0x1A00}
_SIGNED_TYPES = (0x02, 0x03, 0x04, 0x10, 0x12, 0x13, 0x14, 0x15)
_INVALID_BIT = 1 << 31


@dataclass(frozen=True, slots=True)
class Abilities:
    """One device as its EDS describes it.

    Attributes:
        eds: name or path, for messages.
        od: canopen's object dictionary.
    """

    eds: str
    od: Any

    @classmethod
    def of(cls, eds: str, node_id: int) -> Abilities:
        """Read an EDS.

        Raises:
            EdsError: when it is missing or not usable.
        """
        return cls(eds, load_eds(eds, node_id))

    @property
    def identity(self) -> Identity:
        """Vendor, product and revision of 1018h."""
        return Identity(*(self._default(0x1018, subindex) for subindex in (1, 2, 3)))

    @property
    def has_long_pdos(self) -> bool:
        """Whether it can send PDOs of up to 64 bytes."""
        return has_long_pdos(self.od)

    @property
    def bitrates(self) -> tuple[int, ...]:
        """Bit rates that it has, bit/s; empty where its EDS tells none."""
        return tuple(sorted(self.od.device_information.allowed_baudrates))

    def has(self, index: int, subindex: int = 0) -> bool:
        """Whether the object exists."""
        return self._variable(index, subindex) is not None

    def entry(self, index: int, subindex: int, direction: Direction) -> PdoEntry | None:
        """The object as a mapping entry, None where the device cannot map it in this direction."""
        variable = self._variable(index, subindex)
        if variable is None or not variable.pdo_mappable:
            return None
        allowed = ("ro", "rw", "rwr", "const") if direction == "tpdo" else ("wo", "rw", "rww")
        if variable.access_type not in allowed:
            return None
        return PdoEntry(index, subindex, len(variable), variable.data_type in _SIGNED_TYPES, variable.name)

    def dummy(self, data_type: int, bits: int) -> PdoEntry | None:
        """A dummy entry, None where DummyUsage does not allow it."""
        return PdoEntry(data_type, 0, bits, name="dummy") if data_type in self.od else None

    def pdo_numbers(self, direction: Direction) -> tuple[int, ...]:
        """Numbers of the PDOs that the device has, 1 for 1400h or 1800h."""
        base = _COMMUNICATION[direction]
        return tuple(number for number in range(1, 513) if base + number - 1 in self.od)

    def mapping_problem(self, direction: Direction, number: int, words: tuple[int, ...]) -> str | None:
        """Why this PDO cannot carry this mapping, None where it can."""
        index = _MAPPING[direction] + number - 1
        if number not in self.pdo_numbers(direction) or not self.has(index):
            return f"has no {direction.upper()}{number}"
        if self._variable(index, 0).access_type == "rw":
            capacity = self._highest(index)
            return None if len(words) <= capacity else f"{direction.upper()}{number} maps at most {capacity} objects"
        if self.fixed_mapping(direction, number) != words:
            fixed = ", ".join(f"{word:08X}h" for word in self.fixed_mapping(direction, number))
            return f"{direction.upper()}{number} has the fixed mapping {fixed or 'none'}"
        return None

    def fixed_mapping(self, direction: Direction, number: int) -> tuple[int, ...]:
        """The mapping that the EDS gives as default."""
        index = _MAPPING[direction] + number - 1
        return tuple(self._default(index, sub) or 0 for sub in range(1, (self._default(index, 0) or 0) + 1))

    def active_by_default(self, direction: Direction, number: int) -> bool:
        """Whether the PDO is valid when the device boots."""
        cob_id = self._default(_COMMUNICATION[direction] + number - 1, 1)
        return cob_id is None or not cob_id & _INVALID_BIT

    def _default(self, index: int, subindex: int) -> int | None:
        variable = self._variable(index, subindex)
        value = None if variable is None else variable.default
        return value if isinstance(value, int) else None

    def _variable(self, index: int, subindex: int) -> Any:
        if index not in self.od:
            return None
        found = self.od[index]
        if not hasattr(found, "subindices"):
            return found if subindex == 0 else None
        return found[subindex] if subindex in found.subindices or 0 < subindex <= self._highest(index) else None

    def _highest(self, index: int) -> int:
        """Highest sub-index; an array may list only its first member and stand for all (CiA 306, CompactSubObj)."""
        found = self.od[index]
        listed: int = max(found.subindices, default=0)
        if type(found).__name__ != "ODArray" or 0 not in found.subindices:
            return listed
        return max(listed, min(found.subindices[0].default or 0, 254))
