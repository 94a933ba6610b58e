"""Sections → objects of the dictionary: variables, arrays, records, dummy types, the device's own information.

Source: CiA 306-1, "Object description", "Dummy usage".
"""

from __future__ import annotations

import copy
import re

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

from canprobe.fieldbus.eds.sections import Section, Sections, Source, parse_integer
from canprobe.fieldbus.eds.variables import COUNTING, build_variable, is_variable, set_value

# Sections → arrays and records, also in the compact form, with their counts checked.
#
# Source: CiA 306-1, "Object description", "CompactSubObj".

ARRAY, RECORD = 8, 9
"""Object codes."""
Subs = dict[int, Section]
"""Sections of an object's sub-objects by subindex."""
_MOST_COMPACT = 254


def build_composite(source: Source, index: int, head: Section, subs: Subs, kind: int) -> ODArray | ODRecord | None:
    """The array or record that sections describe, or None where nothing of it can be served.

    Args:
        source: the file.
        index: of the object.
        head: its own section.
        subs: the sections of its sub-objects.
        kind: `ARRAY` or `RECORD`.
    """
    if is_variable(index, source.drive):
        source.fault(head, "", "the standard has a variable at this index, not an array or record")
        return None
    name = head.value("ParameterName")
    if not name:
        name = f"Object {index:04X}h"
        if head.items:
            source.warn(head, "ParameterName", f"missing; named {name!r}")
    built = (ODArray if kind == ARRAY else ODRecord)(name, index)
    members = _compact_members(source, index, head)
    for subindex in subs:
        members[subindex] = build_variable(source, subs[subindex], index, subindex, composite=True)
    if not members:
        source.warn(head, "", "no section describes a sub-object of it; left out")
        return None
    _check_count(source, head, subs)
    _check_highest(source, index, head, subs, members)
    for subindex in sorted(members):
        built.add_member(members[subindex])
    return built


def _compact_members(source: Source, index: int, head: Section) -> dict[int, ODVariable]:
    """Members of an object with CompactSubObj; names and values from [indexName] and [indexValue]."""
    count = source.number(head, "CompactSubObj")
    if not 0 < count <= _MOST_COMPACT:
        if count:
            source.warn(head, "CompactSubObj", f"{count} is not 1..{_MOST_COMPACT}; ignored")
        return {}
    template = build_variable(source, head, index, 1, composite=True)
    members = {0: _count_of(index, 0 if index in COUNTING else count)}
    names = source.sections.get(f"{index:04x}name")
    values = source.sections.get(f"{index:04x}value")
    for subindex in range(1, count + 1):
        members[subindex] = variable = copy.copy(template)
        named = names.value(str(subindex)) if names is not None else ""
        variable.subindex, variable.name = subindex, named or f"{template.name}_{subindex:x}"
        if values is not None:
            set_value(source, values, "DefaultValue", variable, str(subindex))
    return members


def _count_of(index: int, count: int) -> ODVariable:
    variable = ODVariable("Number of entries", index, 0)
    variable.data_type = datatypes.UNSIGNED8
    variable.access_type = "rw" if index in COUNTING else "ro"
    variable.default = count
    return variable


def _check_count(source: Source, head: Section, subs: Subs) -> None:
    text = head.value("SubNumber")
    if not subs or head.value("CompactSubObj"):
        return
    if not text:
        source.warn(head, "SubNumber", f"missing; {len(subs)} sub-objects are described")
    elif (stated := source.number(head, "SubNumber", -1)) != len(subs):
        source.warn(head, "SubNumber", f"{stated}, but {len(subs)} sub-objects are described; those are taken")


def _check_highest(source: Source, index: int, head: Section, subs: Subs, members: dict[int, ODVariable]) -> None:
    highest = max(members)
    if 0 not in members:
        source.warn(head, "", f"subindex 0 is not described; taken for {highest}")
        members[0] = _count_of(index, highest)
    elif index not in COUNTING and members[0].default != highest and 0 in subs:
        default = members[0].default
        if default is None:
            source.warn(subs[0], "DefaultValue", f"missing, but the highest subindex is {highest}; taken")
            members[0].default = highest
        else:
            source.warn(subs[0], "DefaultValue", f"{default}, but the highest subindex described is {highest}")


# Sections → objects of the dictionary, and the dummy types.

_OBJECT = re.compile(r"(?:0x)?([0-9a-f]{4})")
_SUB_OBJECT = re.compile(r"(?:0x)?([0-9a-f]{4})\s*sub\s*(?:0x)?([0-9a-f]{1,2})")
_NULL, _DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR = 0, 2, 5, 6, 7
_KINDS = frozenset({_NULL, _DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR, ARRAY, RECORD})


def find_objects(source: Source) -> tuple[dict[int, Section], dict[int, Subs]]:
    """The sections of objects by index, and those of their sub-objects by index and subindex."""
    heads: dict[int, Section] = {}
    subs: dict[int, Subs] = {}
    for name, section in source.sections.items():
        if match := _OBJECT.fullmatch(name):
            heads.setdefault(int(match[1], 16), section)
        elif match := _SUB_OBJECT.fullmatch(name):
            members = subs.setdefault(int(match[1], 16), {})
            if members.setdefault(int(match[2], 16), section) is not section:
                source.warn(section, "", f"is described in line {members[int(match[2], 16)].line} already")
    return heads, subs


def build_objects(source: Source, heads: dict[int, Section], subs: dict[int, Subs], od: ObjectDictionary) -> None:
    """Put every object that can be served into the dictionary."""
    _add_dummies(source, od)
    for index in [*heads, *(index for index in subs if index not in heads)]:
        built = _build(source, index, heads.get(index), subs.get(index, {}))
        if built is not None:
            od.add_object(built)


def _build(source: Source, index: int, head: Section | None, subs: Subs) -> ODVariable | ODArray | ODRecord | None:
    if head is None:
        first = next(iter(subs.values()))
        head = Section(f"{index:04X}", first.line)
        source.warn(head, "", "no section for the object itself, only for its sub-objects; taken for a record")
        return build_composite(source, index, head, subs, RECORD)
    kind = _kind(source, head, subs)
    if kind in (_VAR, _DOMAIN):
        return build_variable(source, head, index, 0)
    return build_composite(source, index, head, subs, kind) if kind in (ARRAY, RECORD) else None


def _kind(source: Source, head: Section, subs: Subs) -> int:
    """ObjectType, or what the rest of the section shows where that is missing or cannot be."""
    stated = _VAR
    if text := head.value("ObjectType"):
        try:
            stated = parse_integer(text, source.remark(head, "ObjectType"))
        except ValueError:
            stated = -1
    compact = bool(head.value("CompactSubObj")) and source.number(head, "CompactSubObj") > 0
    if stated in (_NULL, _DEFTYPE, _DEFSTRUCT) and not subs:
        return stated
    shown = RECORD if subs else ARRAY if compact else _VAR
    fits = stated in (ARRAY, RECORD) if subs or compact else stated in (_VAR, _DOMAIN)
    if fits or (stated in (ARRAY, RECORD) and not head.value("DataType")):
        return stated
    what = f"{text} does not fit" if text else "missing"
    source.warn(head, "ObjectType", f"{what}; taken for {'a variable' if shown == _VAR else 'an array or record'}")
    return shown


def _add_dummies(source: Source, od: ObjectDictionary) -> None:
    section = source.sections.get("dummyusage")
    if section is None:
        return
    for data_type in range(1, 8):
        key = f"Dummy{data_type:04d}"
        if source.number(section, key) == 1:
            dummy = ODVariable(key, data_type, 0)
            dummy.data_type, dummy.access_type = data_type, "const"
            od.add_object(dummy)


# [DeviceInfo], [Comments] and [DeviceComissioning] → what canopen keeps of them.
#
# Source: CiA 306-1, "Device information", "Comments", "Device commissioning" (the standard's own spelling has one m).

_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
_TEXTS = {"VendorName": "vendor_name", "ProductName": "product_name", "OrderCode": "order_code"}
_NUMBERS = {
    "VendorNumber": "vendor_number",
    "ProductNumber": "product_number",
    "RevisionNumber": "revision_number",
    "NrOfRXPDO": "nr_of_RXPDO",
    "NrOfTXPDO": "nr_of_TXPDO",
}
_FLAGS = {
    "SimpleBootUpMaster": "simple_boot_up_master",
    "SimpleBootUpSlave": "simple_boot_up_slave",
    "Granularity": "granularity",
    "DynamicChannelsSupported": "dynamic_channels_supported",
    "GroupMessaging": "group_messaging",
    "LSS_Supported": "LSS_supported",
}


def read_information(source: Source, od: ObjectDictionary) -> None:
    """Fill in what the dictionary knows of its device; a wrong number is left out with a warning."""
    od.node_id = source.node_id
    if (section := source.sections.get("comments")) is not None:
        lines = [item.value for key, item in section.items.items() if key.startswith("line") and key != "lines"]
        od.comments = "\n".join(lines)
    if (section := source.sections.get("deviceinfo")) is not None:
        information = od.device_information
        for rate in _RATES_KBIT_S:
            if source.number(section, f"BaudRate_{rate}"):
                information.allowed_baudrates.add(rate * 1000)
        for key, field in _TEXTS.items():
            if key.lower() in section.items:
                setattr(information, field, section.value(key))
        for key, field in {**_NUMBERS, **_FLAGS}.items():
            if section.value(key):
                number = source.number(section, key)
                setattr(information, field, bool(number) if key in _FLAGS else number)
    if (section := _commissioning(source.sections)) is not None:
        if rate := source.number(section, "Baudrate"):
            od.bitrate = rate * 1000
        if (node_id := source.number(section, "NodeID", source.node_id)) != source.node_id:
            source.warn(section, "NodeID", f"the file configures node {node_id}; read for node {source.node_id}")


def commissioned_node(sections: Sections) -> int | None:
    """Node id that a DCF has been made for; None where it has none."""
    section = _commissioning(sections)
    if section is None:
        return None
    try:
        node_id = parse_integer(section.value("NodeID"), lambda _: None)
    except ValueError:
        return None
    return node_id if 1 <= node_id <= 127 else None


def _commissioning(sections: Sections) -> Section | None:
    return sections.get("devicecomissioning") or sections.get("devicecommissioning")


# The lists of objects in an EDS file, against the objects that it describes.
#
# Source: CiA 306-1, "Object lists".

_LISTS = {
    "MandatoryObjects": (range(0x1000, 0x1002), range(0x1018, 0x1019)),
    "OptionalObjects": (range(0x1002, 0x1018), range(0x1019, 0x2000), range(0x6000, 0x10000)),
    "ManufacturerObjects": (range(0x2000, 0x6000),),
}
_REQUIRED = ("FileInfo", "DeviceInfo", "MandatoryObjects")


def check_lists(source: Source, described: dict[int, Section]) -> None:
    """Warn of missing sections, wrong counts, listed objects without a section, and sections in no list.

    Args:
        source: the file.
        described: the section of each object by index.
    """
    listed: dict[int, str] = {}
    for title in _REQUIRED:
        if title.lower() not in source.sections:
            source.faults.warn(0, title, "", "section missing")
    present = [title for title in _LISTS if title.lower() in source.sections]
    for title in present:
        _check_list(source, source.sections[title.lower()], title, described, listed)
    covered = [area for title in present for area in _LISTS[title]]
    for index, section in described.items():
        if index not in listed and any(index in area for area in covered):
            source.warn(section, "", "is in no list of objects; served")


def _check_list(
    source: Source, section: Section, title: str, described: dict[int, Section], listed: dict[int, str]
) -> None:
    entries = [item for key, item in section.items.items() if key.isdigit()]
    stated = section.value("SupportedObjects")
    if not stated:
        source.warn(section, "SupportedObjects", f"missing; {len(entries)} objects are listed")
    elif (count := source.number(section, "SupportedObjects", -1)) != len(entries):
        source.warn(section, "SupportedObjects", f"{count}, but {len(entries)} objects are listed")
    for item in entries:
        index = _index(source, section, item.key, item.value, described)
        if index is None:
            continue
        if index in listed:
            source.warn(section, item.key, f"{index:04X}h is in [{listed[index]}] already")
        elif index not in described:
            source.warn(section, item.key, f"{index:04X}h is listed, but no section describes it; not served")
        listed[index] = title


def _index(source: Source, section: Section, key: str, text: str, described: dict[int, Section]) -> int | None:
    """An index of a list; without 0x it is taken as hexadecimal where only that names an object."""
    bare = int(text, 16) if re.fullmatch("[0-9A-Fa-f]{4}", text) else None
    remarks: list[str] = []
    try:
        index: int | None = parse_integer(text, remarks.append)
    except ValueError:
        index = None
    if bare in described and index not in described:
        source.warn(section, key, f"{text} is read as {bare:04X}h; hexadecimal numbers begin with 0x")
        return bare
    for remark in remarks:
        source.warn(section, key, remark)
    if index is None:
        source.warn(section, key, f"{text!r} is not an index")
    return index
