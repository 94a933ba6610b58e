"""Any vendor's EDS or DCF file → an object dictionary and the list of what is wrong with the file.

Faults are told apart: what *prevents* serving (the answer of the device cannot be known from the file) and
warnings (the meaning is clear, or the rest can be served).
Source: CiA 306-1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes

from canprobe.eds.sections import Fault, Faults, Section, Source, decode, parse_sum, split_sections
from canprobe.eds.structure import build_objects, check_lists, commissioned_node, find_objects, read_information
from canprobe.errors import EdsError

# What a file leaves out or gets wrong although the standard fixes it: mandatory objects, identifiers, mappings.
#
# Source: CiA 301, objects 1000h, 1001h, 1018h, "Pre-defined connection set", "PDO mapping"; CiA 306-1, "Device
# information".

_INVALID = 1 << 31
_CAN_ID = 0x1FFFFFFF
_MOST = 0xFFFFFFFF
_SERVO_DRIVE = 0x00020192
"""Device type of a servo drive of CiA 402."""
_IDENTITY = {1: "vendor", 2: "product", 3: "revision"}
"""Whose number is at which sub-index of 1018h, as [DeviceInfo] and canopen call it."""
_MOST_BITS = 64
_PDO_BASES = {
    **{0x1400 + n: 0x200 + 0x100 * n for n in range(4)},
    **{0x1800 + n: 0x180 + 0x100 * n for n in range(4)},
}


def repair(source: Source, heads: dict[int, Section], od: ObjectDictionary, serving: bool) -> None:
    """Put right what the standard fixes, each time with a warning; `serving` as in `read_eds`."""
    if serving:
        _add_mandatory(source, od)
    _name_drive(source, heads, od)
    _identify(source, heads, od)
    _repair_identifiers(source, heads, od)
    for index in od:
        if 0x1600 <= index < 0x1800 or 0x1A00 <= index < 0x1C00:
            _check_mapping(source, heads, od, index, serving)
    _check_pdo_counts(source, od)


def variable_at(od: ObjectDictionary, index: int, subindex: int) -> ODVariable | None:
    """What the dictionary has there itself; canopen makes up members of an array."""
    entry = od.indices.get(index)
    if isinstance(entry, ODVariable):
        return entry if subindex == 0 else None
    found: ODVariable | None = entry.subindices.get(subindex) if entry is not None else None
    return found


def _add_mandatory(source: Source, od: ObjectDictionary) -> None:
    for index, name, data_type in ((0x1000, "Device type", 0x07), (0x1001, "Error register", 0x05)):
        if index not in od.indices:
            value = _SERVO_DRIVE if index == 0x1000 and source.drive else 0
            source.faults.warn(0, f"{index:04X}", "", f"{name} is mandatory, but not there; served as {value:#x}")
            od.add_object(_variable(name, index, 0, data_type, value))
    if 0x1018 not in od.indices:
        numbers = {1: 0, **_stated_identity(od)}
        told = ", ".join(f"{_IDENTITY[subindex]} {number:#x}" for subindex, number in numbers.items())
        source.faults.warn(0, "1018", "", f"Identity object is mandatory, but not there; served with {told}")
        identity = ODRecord("Identity object", 0x1018)
        identity.add_member(_variable("Highest sub-index supported", 0x1018, 0, datatypes.UNSIGNED8, max(numbers)))
        for subindex, number in numbers.items():
            name = _IDENTITY[subindex].capitalize()
            identity.add_member(_variable(name, 0x1018, subindex, datatypes.UNSIGNED32, number))
        od.add_object(identity)


def _variable(name: str, index: int, subindex: int, data_type: int, default: int) -> ODVariable:
    variable = ODVariable(name, index, subindex)
    variable.data_type, variable.access_type, variable.default = data_type, "ro", default
    return variable


def _name_drive(source: Source, heads: dict[int, Section], od: ObjectDictionary) -> None:
    """The device type of a drive that is known by its objects alone."""
    variable = variable_at(od, 0x1000, 0)
    if source.drive and variable is not None and variable.default is None and variable.value is None:
        text = f"missing; {_SERVO_DRIVE:#010x} taken, a CiA 402 drive: 6040h, 6041h and 6060h are there"
        _tell(source, heads, (0x1000, 0), text)
        variable.default = _SERVO_DRIVE


def _identify(source: Source, heads: dict[int, Section], od: ObjectDictionary) -> None:
    """The numbers of 1018h that stand in [DeviceInfo] alone; a 0 there is an empty field."""
    for subindex, number in _stated_identity(od).items():
        variable = variable_at(od, 0x1018, subindex)
        if variable is not None and variable.default is None and variable.value is None:
            _tell(source, heads, (0x1018, subindex), f"missing; {number:#x} taken, as [DeviceInfo] has it")
            variable.default = number


def _stated_identity(od: ObjectDictionary) -> dict[int, int]:
    """What [DeviceInfo] tells of 1018h, by sub-index."""
    stated = {sub: getattr(od.device_information, f"{name}_number") for sub, name in _IDENTITY.items()}
    return {subindex: number for subindex, number in stated.items() if number and 0 < number <= _MOST}


def _repair_identifiers(source: Source, heads: dict[int, Section], od: ObjectDictionary) -> None:
    """COB-IDs of the pre-defined connection set that forget the node-ID, or are of the node that a DCF is made for.

    Any other COB-ID was chosen by somebody and stays.
    """
    node_id, made_for = source.node_id, commissioned_node(source.sections) or source.node_id
    for index, subindex, base in ((0x1200, 1, 0x600), (0x1200, 2, 0x580)):
        variable = variable_at(od, index, subindex)
        if variable is not None and _present(variable) != base + node_id:
            told, key = _text(variable)
            text = f"{told}, but the first SDO server has {base:X}h + $NODEID; taken"
            _tell(source, heads, (index, subindex), text, key)
            variable.default, variable.value, variable.relative = base + node_id, None, True
    for index, subindex, base in ((0x1014, 0, 0x80), *((index, 1, base) for index, base in _PDO_BASES.items())):
        variable = variable_at(od, index, subindex)
        if variable is None:
            continue
        told, key = _text(variable)
        if variable.value is None and _forgets_node(variable, base):
            _tell(source, heads, (index, subindex), f"{told} without $NODEID, which is added")
            assert isinstance(variable.default, int)
            variable.default, variable.relative = variable.default + node_id, True
        elif made_for != node_id and (cob_id := _present(variable)) & _CAN_ID == base + made_for:
            cob_id += node_id - made_for
            _tell(source, heads, (index, subindex), f"{told} is of node {made_for}; {cob_id:#x} taken", key)
            setattr(variable, "value" if key == "ParameterValue" else "default", cob_id)


def _forgets_node(variable: ODVariable, base: int) -> bool:
    return isinstance(variable.default, int) and not variable.relative and variable.default & ~_INVALID == base


def _text(variable: ODVariable) -> tuple[str, str]:
    """The value that counts, as the file writes it, and its key."""
    field, key = ("default_raw", "DefaultValue") if variable.value is None else ("value_raw", "ParameterValue")
    return str(getattr(variable, field, "")) or "empty", key


def _tell(
    source: Source, heads: dict[int, Section], place: tuple[int, int], text: str, key: str = "DefaultValue"
) -> None:
    """A warning at the section of a sub-object (index, subindex), or else of its object."""
    index, subindex = place
    section = source.sections.get(f"{index:04x}sub{subindex:x}") or heads.get(index)
    if section is None:
        source.faults.warn(0, f"{index:04X}sub{subindex:X}", "DefaultValue", text)
    else:
        source.warn(section, key, text)


def _check_pdo_counts(source: Source, od: ObjectDictionary) -> None:
    section = source.sections.get("deviceinfo")
    for key, first, name in (("NrOfRXPDO", 0x1400, "RPDOs"), ("NrOfTXPDO", 0x1800, "TPDOs")):
        described = sum(first <= index < first + 0x200 for index in od)
        if section is not None and section.value(key) and (stated := source.number(section, key)) != described:
            source.warn(section, key, f"{stated}, but {described} {name} are described; those are served")


def _check_mapping(source: Source, heads: dict[int, Section], od: ObjectDictionary, index: int, serving: bool) -> None:
    """The default mapping of a PDO."""
    bits = 0
    for subindex, word in _words(od, index):
        name, length = f"{word >> 16:04X}h:{word >> 8 & 0xFF:02X}", word & 0xFF
        bits += length
        target = variable_at(od, word >> 16, word >> 8 & 0xFF)
        if target is None:
            _tell(source, heads, (index, subindex), f"maps {name}, which is not described; the PDO is served empty")
        elif len(target) != length:
            text = f"maps {length} bits of {name}, which has {len(target)}; the PDO is served empty"
            _tell(source, heads, (index, subindex), text)
        elif not target.pdo_mappable and target.index > 7:
            _tell(source, heads, (target.index, target.subindex), f"is mapped in {index:04X}h, so 1", "PDOMapping")
            target.pdo_mappable = serving
    if bits > _MOST_BITS:
        _tell(source, heads, (index, 0), f"maps {bits} bits, but a frame has {_MOST_BITS}; the PDO is served empty")


def _words(od: ObjectDictionary, index: int) -> Iterator[tuple[int, int]]:
    """Subindex and word of each entry that is mapped."""
    count = _present(variable_at(od, index, 0))
    for subindex in range(1, min(count, _MOST_BITS) + 1):
        if word := _present(variable_at(od, index, subindex)):
            yield subindex, word


def _present(variable: ODVariable | None) -> int:
    value = None if variable is None else variable.default if variable.value is None else variable.value
    return value if isinstance(value, int) else 0


# Any vendor's EDS or DCF file → an object dictionary and the list of what is wrong with the file.

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
