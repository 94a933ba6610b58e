"""Reads an EDS, DCF, XDD or XDC file of any vendor into an object dictionary and a list of findings.

Findings are of two kinds: faults *prevent* serving (it is unknown what the device is, or which PDOs it has), warnings
do not (the meaning is clear, or the rest can be served). What a file lacks or has wrong although the standard fixes it
(mandatory objects, identifiers, mappings) is repaired with a warning.

Source: CiA 306-1, "Device information"; CiA 301, objects 1000h, 1001h, 1018h, "Pre-defined connection set", "PDO
mapping".
"""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable, datatypes

from canprobe.errors import EdsError
from canprobe.fieldbus.eds.description import described_entry, variable_at
from canprobe.fieldbus.eds.device_info import commissioned_node, read_information
from canprobe.fieldbus.eds.findings import EdsFinding, EdsFindings
from canprobe.fieldbus.eds.foreign_files import HEAD_BYTES, XML, file_kind
from canprobe.fieldbus.eds.numbers import parse_sum
from canprobe.fieldbus.eds.object_lists import check_lists
from canprobe.fieldbus.eds.sections import Section, Source, decode, split_sections
from canprobe.fieldbus.eds.structure import build_objects, find_objects
from canprobe.fieldbus.eds.variables import plain_variable
from canprobe.fieldbus.protocol.frames import EFF_MASK, INVALID_FLAG
from canprobe.fieldbus.protocol.pdo import MAX_PDO_BITS, RPDOS, TPDOS, is_mapping

_MAX_U32 = 0xFFFFFFFF
_PROFILE_MASK = 0xFFFF
_DRIVE_PROFILE = 402
_SERVO_DRIVE_TYPE = 0x00020192
"""Device type of a servo drive of CiA 402."""
_DRIVE_OBJECTS = (0x6040, 0x6041)
_FURTHER_CONTROLWORDS = range(0x6840, 0xA000, 0x800)
_MODES_OF_OPERATION = 0x6060
_IDENTITY_NAMES = {1: "vendor", 2: "product", 3: "revision"}
"""Names of the numbers in 1018h, by sub-index, as [DeviceInfo] and canopen have them."""
_PREDEFINED_COB_IDS = (
    (0x1014, 0, 0x80),
    *((RPDOS[n], 1, 0x200 + 0x100 * n) for n in range(4)),
    *((TPDOS[n], 1, 0x180 + 0x100 * n) for n in range(4)),
)
"""Index, sub-index and COB-ID without the node-ID, of the pre-defined connection set."""
_FURTHER_PDOS = frozenset((*RPDOS[4:], *TPDOS[4:]))


@dataclass(frozen=True, slots=True)
class Reading:
    """Result of reading a file.

    Attributes:
        path: path of the file.
        dictionary: object dictionary as far as it could be built; it is complete where nothing prevents serving.
        found: all findings, by line.
    """

    path: Path
    dictionary: ObjectDictionary
    found: tuple[EdsFinding, ...]

    @property
    def faults(self) -> tuple[EdsFinding, ...]:
        """Findings that prevent serving."""
        return tuple(fault for fault in self.found if fault.prevents)

    @property
    def warnings(self) -> tuple[EdsFinding, ...]:
        """Findings that were repaired, or left out."""
        return tuple(fault for fault in self.found if not fault.prevents)

    @property
    def profile(self) -> int:
        """Number of the device profile in 1000h, such as 402; 0 for none."""
        return device_profile(self.dictionary)

    def usable(self) -> ObjectDictionary:
        """The dictionary of a file without faults.

        Raises:
            EdsError: faults prevent its use; the message has one line for each.
        """
        if self.faults:
            raise EdsError("\n".join(f"{self.path}: not a usable EDS file: {fault}" for fault in self.faults))
        return self.dictionary


def read_eds(path: Path, node_id: int | None, *, serving: bool = True) -> Reading:
    """Read a file, whatever is in it.

    Args:
        path: path of an EDS, DCF, XDD or XDC file.
        node_id: node id, 1..127, which replaces $NODEID; None for that of the DCF, or else 1.
        serving: whether to add mandatory objects that are missing, and to take what the default mapping of a PDO holds
            as mappable, whatever PDOMapping states. A master should not rely on either.

    Raises:
        EdsError: the file itself cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise EdsError(f"{path}: {error.strerror}") from error
    faults, od = EdsFindings(), ObjectDictionary()  # type: ignore[no-untyped-call]
    kind = file_kind(data[:HEAD_BYTES])
    if kind not in (None, XML):
        way = f"; {kind.into_eds.format(path=shlex.quote(str(path)))}" if kind.into_eds else ""
        faults.fault(0, "", "", f"{kind.name}, not an EDS file{way}")
        data = b""
    if kind is XML:
        from canprobe.fieldbus.eds.xml_sections import xml_sections

        sections = xml_sections(data, faults)
    else:
        sections = split_sections(decode(data, faults), faults)
    source = Source(sections, commissioned_node(sections) or 1 if node_id is None else node_id, faults)
    read_information(source, od)
    heads, subs = find_objects(source)
    if heads or subs:
        source = replace(source, drive=_describes_drive(heads, set(subs), source.node_id))
        build_objects(source, heads, subs, od)
        if kind is not XML:
            check_lists(source, {**{index: next(iter(members.values())) for index, members in subs.items()}, **heads})
        _Repair(source, heads, od).run(serving)
        if is_drive(od) and (more := [index for index in _FURTHER_CONTROLWORDS if index in heads]):
            words = ", ".join(f"{index:04X}h" for index in more)
            source.warn(
                heads[more[0]], "", f"the device has further axes (controlwords {words}); only the first is driven"
            )
        if device_profile(od) == _DRIVE_PROFILE and not is_drive(od):
            text = "the profile is CiA 402, but controlword or statusword is not described; served, but not as a drive"
            faults.warn(0, "1000", "", text)
    elif not any(fault.prevents for fault in faults.found):
        faults.fault(0, "", "", "no object in it")
    return Reading(path, od, faults.sorted())


def device_profile(od: ObjectDictionary) -> int:
    """Number of the device profile in 1000h, such as 402; 0 for none."""
    return _present(variable_at(od, 0x1000, 0)) & _PROFILE_MASK


def is_drive(od: ObjectDictionary) -> bool:
    """Whether the device profile is CiA 402 and the two objects of its state machine are there."""
    return device_profile(od) == _DRIVE_PROFILE and all(index in od.indices for index in _DRIVE_OBJECTS)


def _describes_drive(heads: dict[int, Section], composites: set[int], node_id: int) -> bool:
    """Whether CiA 402 describes this device: by 1000h, or, without a value there, by the objects of a drive."""
    head = heads.get(0x1000)
    text = (head.value("ParameterValue") or head.value("DefaultValue")) if head is not None else ""
    if not text:
        return heads.keys() - composites >= {*_DRIVE_OBJECTS, _MODES_OF_OPERATION}
    try:
        return parse_sum(text, node_id, lambda _: None)[0] & _PROFILE_MASK == _DRIVE_PROFILE
    except ValueError:  # a fault, which is found where the value is read
        return False


class _Repair:
    """Repairs what the standard fixes, each time with a warning.

    Args:
        source: the file.
        heads: section of each object.
        od: dictionary that was built from them; it is changed.
    """

    def __init__(self, source: Source, heads: dict[int, Section], od: ObjectDictionary) -> None:
        self._source, self._heads, self._od = source, heads, od
        stated = {sub: getattr(od.device_information, f"{name}_number") for sub, name in _IDENTITY_NAMES.items()}
        self._identity = {sub: number for sub, number in stated.items() if number and 0 < number <= _MAX_U32}
        """Numbers in [DeviceInfo] for 1018h, by sub-index; a 0 there is an empty field."""

    def run(self, serving: bool) -> None:
        """Make every repair; `serving` is that of `read_eds`."""
        if serving:
            self._add_mandatory()
        if self._source.drive:
            text = f"missing; {_SERVO_DRIVE_TYPE:#010x} taken, a CiA 402 drive: 6040h, 6041h and 6060h are there"
            self._fill((0x1000, 0), _SERVO_DRIVE_TYPE, text)
        for subindex, number in self._identity.items():
            self._fill((0x1018, subindex), number, f"missing; {number:#x} taken, as [DeviceInfo] has it")
        for subindex, name in _IDENTITY_NAMES.items():
            variable = variable_at(self._od, 0x1018, subindex)
            if variable is not None and _present(variable) == 0 and _text(variable)[0] != "empty":
                text = f"0, as where nobody has filled it in; bring-up does not compare the {name}"
                self._warn((0x1018, subindex), text, _text(variable)[1])
        self._repair_sdo_server()
        self._repair_identifiers()
        for index in self._od:
            if is_mapping(index):
                self._check_mapping(index, serving)
        self._check_pdo_counts()

    def _add_mandatory(self) -> None:
        source, od = self._source, self._od
        for index, name, data_type in ((0x1000, "Device type", 0x07), (0x1001, "Error register", 0x05)):
            if index not in od.indices:
                value = _SERVO_DRIVE_TYPE if index == 0x1000 and source.drive else 0
                source.faults.warn(0, f"{index:04X}", "", f"{name} is mandatory, but not there; served as {value:#x}")
                od.add_object(plain_variable(name, (index, 0), data_type, "ro", value))
        if 0x1018 not in od.indices:
            numbers = {1: 0, **self._identity}
            text = ", ".join(f"{_IDENTITY_NAMES[subindex]} {number:#x}" for subindex, number in numbers.items())
            source.faults.warn(0, "1018", "", f"Identity object is mandatory, but not there; served with {text}")
            identity = ODRecord("Identity object", 0x1018)
            highest = "Highest sub-index supported"
            identity.add_member(plain_variable(highest, (0x1018, 0), datatypes.UNSIGNED8, "ro", max(numbers)))
            for subindex, number in numbers.items():
                name = _IDENTITY_NAMES[subindex].capitalize()
                identity.add_member(plain_variable(name, (0x1018, subindex), datatypes.UNSIGNED32, "ro", number))
            od.add_object(identity)

    def _fill(self, place: tuple[int, int], value: int, text: str) -> None:
        """Give a described object without a value this one."""
        variable = variable_at(self._od, *place)
        if variable is not None and variable.default is None and variable.value is None:
            self._warn(place, text)
            variable.default = value

    def _repair_sdo_server(self) -> None:
        """Give the first SDO server the COB-IDs of the pre-defined connection set."""
        node_id = self._source.node_id
        for subindex, base in ((1, 0x600), (2, 0x580)):
            variable = variable_at(self._od, 0x1200, subindex)
            if variable is not None and _present(variable) != base + node_id:
                written, key = _text(variable)
                text = f"{written}, but the first SDO server has {base:X}h + $NODEID; taken"
                self._warn((0x1200, subindex), text, key)
                variable.default, variable.value, variable.relative = base + node_id, None, True

    def _repair_identifiers(self) -> None:
        """Repair COB-IDs of the pre-defined connection set without the node-ID, or with that for which a DCF was made.

        Any other COB-ID was chosen by somebody and stays.
        """
        node_id = self._source.node_id
        made_for = commissioned_node(self._source.sections) or node_id
        for index, subindex, base in _PREDEFINED_COB_IDS:
            variable = variable_at(self._od, index, subindex)
            if variable is None:
                continue
            if variable.default is None and variable.value is None:
                self._warn(
                    (index, subindex), f"missing; {base:#x} + $NODEID taken, that of the pre-defined connection set"
                )
                variable.default, variable.relative = base + node_id, True
                continue
            written, key = _text(variable)
            default, cob_id = variable.default, _present(variable)
            forgotten = isinstance(default, int) and not variable.relative and default & ~INVALID_FLAG == base
            if variable.value is None and forgotten:
                self._warn((index, subindex), f"{written} without $NODEID, which is added")
                variable.default, variable.relative = cob_id + node_id, True
            elif made_for != node_id and cob_id & EFF_MASK == base + made_for:
                cob_id += node_id - made_for
                self._warn((index, subindex), f"{written} is of node {made_for}; {cob_id:#x} taken", key)
                setattr(variable, "value" if key == "ParameterValue" else "default", cob_id)
        others = {index for index in self._od if index in _FURTHER_PDOS}
        for place, cob_id, what in (
            ((0x1005, 0), 0x80, "that of SYNC"),
            *(((index, 1), INVALID_FLAG, "the PDO is off until somebody names one") for index in sorted(others)),
        ):
            self._fill(place, cob_id, f"missing; {cob_id:#x} taken, {what}")

    def _check_mapping(self, index: int, serving: bool) -> None:
        """Check the default mapping of a PDO."""
        bits = 0
        for subindex, word in _words(self._od, index):
            name, length = f"{word >> 16:04X}h:{word >> 8 & 0xFF:02X}", word & 0xFF
            bits += length
            target = variable_at(self._od, word >> 16, word >> 8 & 0xFF)
            if target is None:
                self._warn((index, subindex), f"maps {name}, which is not described; the PDO is served empty")
            elif not (entry := described_entry(target)).fits_pdo(length):
                has = str(entry.bits) if entry.bits else "no fixed length"
                text = f"maps {length} bits of {name}, which has {has}; the PDO is served empty"
                self._warn((index, subindex), text)
            elif not target.pdo_mappable and target.index > 7:
                self._warn((target.index, target.subindex), f"is mapped in {index:04X}h, so 1", "PDOMapping")
                target.pdo_mappable = serving
        if bits > MAX_PDO_BITS:
            self._warn((index, 0), f"maps {bits} bits, but a frame has {MAX_PDO_BITS}; the PDO is served empty")

    def _check_pdo_counts(self) -> None:
        section = self._source.sections.get("deviceinfo")
        for key, area, name in (("NrOfRXPDO", RPDOS, "RPDOs"), ("NrOfTXPDO", TPDOS, "TPDOs")):
            described = sum(index in area for index in self._od)
            if (
                section is not None
                and section.value(key)
                and (stated := self._source.number(section, key)) != described
            ):
                self._source.warn(section, key, f"{stated}, but {described} {name} are described; those are served")

    def _warn(self, place: tuple[int, int], text: str, key: str = "DefaultValue") -> None:
        """Add a warning at the section of a sub-object (index, sub-index), or else of its object."""
        index, subindex = place
        section = self._source.sections.get(f"{index:04x}sub{subindex:x}") or self._heads.get(index)
        if section is None:
            self._source.faults.warn(0, f"{index:04X}sub{subindex:X}", "DefaultValue", text)
        else:
            self._source.warn(section, key, text)


def _text(variable: ODVariable) -> tuple[str, str]:
    """Text in the file of the value that counts, and its key."""
    field, key = ("default_raw", "DefaultValue") if variable.value is None else ("value_raw", "ParameterValue")
    return str(getattr(variable, field, "")) or "empty", key


def _words(od: ObjectDictionary, index: int) -> Iterator[tuple[int, int]]:
    """Sub-index and mapping word of each mapped entry."""
    count = _present(variable_at(od, index, 0))
    for subindex in range(1, min(count, MAX_PDO_BITS) + 1):
        if word := _present(variable_at(od, index, subindex)):
            yield subindex, word


def _present(variable: ODVariable | None) -> int:
    """Integer value at boot; 0 for none."""
    value = None if variable is None else variable.default if variable.value is None else variable.value
    return value if isinstance(value, int) else 0
