"""Any vendor's EDS or DCF file → an object dictionary and the list of what is wrong with the file.

Faults are told apart: what *prevents* serving (the answer of the device cannot be known from the file) and
warnings (the meaning is clear, or the rest can be served).
Source: CiA 306-1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary

from canprobe.eds.faults import Fault, Faults
from canprobe.eds.information import commissioned_node, read_information
from canprobe.eds.lines import Section, decode, split_sections
from canprobe.eds.lists import check_lists
from canprobe.eds.numbers import parse_sum
from canprobe.eds.objects import build_objects, find_objects
from canprobe.eds.repairs import repair, variable_at
from canprobe.eds.source import Source
from canprobe.errors import EdsError

_PROFILE = 0xFFFF
_DRIVE_PROFILE = 402
_DRIVE_OBJECTS = (0x6040, 0x6041)
_MODES_OF_OPERATION = 0x6060


@dataclass(frozen=True, slots=True)
class Reading:
    """What came of a file.

    Attributes:
        path: of the file.
        dictionary: as far as it could be built; complete where nothing prevents serving.
        found: everything wrong, by line.
    """

    path: Path
    dictionary: ObjectDictionary
    found: tuple[Fault, ...]

    @property
    def faults(self) -> tuple[Fault, ...]:
        """What prevents serving."""
        return tuple(fault for fault in self.found if fault.prevents)

    @property
    def warnings(self) -> tuple[Fault, ...]:
        """What was put right, or left out."""
        return tuple(fault for fault in self.found if not fault.prevents)

    @property
    def profile(self) -> int:
        """Number of the device profile in 1000h, such as 402; 0 for none."""
        return device_profile(self.dictionary)

    def usable(self) -> ObjectDictionary:
        """The dictionary.

        Raises:
            EdsError: a fault prevents its use; one line a fault.
        """
        if self.faults:
            raise EdsError("\n".join(f"{self.path}: not a usable EDS file: {fault}" for fault in self.faults))
        return self.dictionary


def device_profile(od: ObjectDictionary) -> int:
    """Number of the device profile in 1000h, such as 402; 0 for none."""
    variable = variable_at(od, 0x1000, 0)
    value = None if variable is None else variable.default if variable.value is None else variable.value
    return value & _PROFILE if isinstance(value, int) else 0


def is_drive(od: ObjectDictionary) -> bool:
    """Whether the device profile is CiA 402 and the two objects of its state machine are there."""
    return device_profile(od) == _DRIVE_PROFILE and all(index in od.indices for index in _DRIVE_OBJECTS)


def _describes_drive(heads: dict[int, Section], composites: set[int], node_id: int) -> bool:
    """Whether CiA 402 speaks of this device: by 1000h, or, where the file gives it no value, by what a drive has."""
    head = heads.get(0x1000)
    text = (head.value("ParameterValue") or head.value("DefaultValue")) if head is not None else ""
    if not text:
        return heads.keys() - composites >= {*_DRIVE_OBJECTS, _MODES_OF_OPERATION}
    try:
        return parse_sum(text, node_id, lambda _: None)[0] & _PROFILE == _DRIVE_PROFILE
    except ValueError:  # a fault, found where the value is read
        return False


def read_eds(path: Path, node_id: int | None, *, serving: bool = True) -> Reading:
    """Read a file, whatever is in it.

    Args:
        path: of an EDS or DCF file.
        node_id: 1..127, for $NODEID; None for that of the DCF, or else 1.
        serving: add the mandatory objects that are missing, and take what the default mapping of a PDO carries as
            mappable, whatever PDOMapping says. A master had better not rely on either.

    Raises:
        EdsError: the file itself cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise EdsError(f"{path}: {error.strerror}") from error
    faults, od = Faults(), ObjectDictionary()  # type: ignore[no-untyped-call]
    sections = split_sections(decode(data, faults), faults)
    source = Source(sections, commissioned_node(sections) or 1 if node_id is None else node_id, faults)
    read_information(source, od)
    heads, subs = find_objects(source)
    if heads or subs:
        source = replace(source, drive=_describes_drive(heads, set(subs), source.node_id))
        build_objects(source, heads, subs, od)
        check_lists(source, {**{index: next(iter(members.values())) for index, members in subs.items()}, **heads})
        repair(source, heads, od, serving)
        if device_profile(od) == _DRIVE_PROFILE and not is_drive(od):
            text = "the profile is CiA 402, but controlword or statusword is not described; served, but not as a drive"
            faults.warn(0, "1000", "", text)
    elif not any(fault.prevents for fault in faults.found):
        faults.fault(0, "", "", "no object in it")
    return Reading(path, od, faults.sorted())
