"""Builds the objects of the dictionary from sections: variables, arrays and records, also in the compact form, dummies.

Source: CiA 306-1, "Object description", "CompactSubObj", "Dummy usage".
"""

from __future__ import annotations

import copy
import re

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable, datatypes

from canprobe.fieldbus.eds.mandatory import COUNTING_INDICES, is_variable
from canprobe.fieldbus.eds.numbers import parse_integer
from canprobe.fieldbus.eds.sections import Section, Source
from canprobe.fieldbus.eds.variables import build_variable, plain_variable, set_value

_OBJECT_PATTERN = re.compile(r"(?:0x)?([0-9a-f]{4})")
_SUB_OBJECT_PATTERN = re.compile(r"(?:0x)?([0-9a-f]{4})\s*sub\s*(?:0x)?([0-9a-f]{1,2})")
Subs = dict[int, Section]
"""Sections of the sub-objects of an object, by subindex."""
_MAX_COMPACT_MEMBERS = 254
_NULL, _DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR, _ARRAY, _RECORD = 0, 2, 5, 6, 7, 8, 9


def find_objects(source: Source) -> tuple[dict[int, Section], dict[int, Subs]]:
    """Sections of objects by index, and of their sub-objects by index and subindex."""
    heads: dict[int, Section] = {}
    subs: dict[int, Subs] = {}
    for name, section in source.sections.items():
        if match := _OBJECT_PATTERN.fullmatch(name):
            heads.setdefault(int(match[1], 16), section)
        elif match := _SUB_OBJECT_PATTERN.fullmatch(name):
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
        return _build_composite(source, index, head, subs, _RECORD)
    kind = _kind(source, head, subs)
    if kind in (_VAR, _DOMAIN):
        return build_variable(source, head, index, 0)
    return _build_composite(source, index, head, subs, kind) if kind in (_ARRAY, _RECORD) else None


def _kind(source: Source, head: Section, subs: Subs) -> int:
    """ObjectType, or the type that the rest of the section shows where it is missing or impossible."""
    stated = _VAR
    if text := head.value("ObjectType"):
        try:
            stated = parse_integer(text, source.remark(head, "ObjectType"))
        except ValueError:
            stated = -1
    compact = bool(head.value("CompactSubObj")) and source.number(head, "CompactSubObj") > 0
    if stated in (_NULL, _DEFTYPE, _DEFSTRUCT) and not subs:
        return stated
    shown = _RECORD if subs else _ARRAY if compact else _VAR
    fits = stated in (_ARRAY, _RECORD) if subs or compact else stated in (_VAR, _DOMAIN)
    if fits or (stated in (_ARRAY, _RECORD) and not head.value("DataType")):
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
            od.add_object(plain_variable(key, (data_type, 0), data_type, "const", None))


def _build_composite(source: Source, index: int, head: Section, subs: Subs, kind: int) -> ODArray | ODRecord | None:
    """The array or record that sections describe, or None where nothing of it can be served."""
    if is_variable(index, source.drive):
        source.fault(head, "", "the standard has a variable at this index, not an array or record")
        return None
    name = head.value("ParameterName")
    if not name:
        name = f"Object {index:04X}h"
        if head.items:
            source.warn(head, "ParameterName", f"missing; named {name!r}")
    built = (ODArray if kind == _ARRAY else ODRecord)(name, index)
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
    if not 0 < count <= _MAX_COMPACT_MEMBERS:
        if count:
            source.warn(head, "CompactSubObj", f"{count} is not 1..{_MAX_COMPACT_MEMBERS}; ignored")
        return {}
    template = build_variable(source, head, index, 1, composite=True)
    members = {0: _count_of(index, 0 if index in COUNTING_INDICES else count)}
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
    access = "rw" if index in COUNTING_INDICES else "ro"
    return plain_variable("Number of entries", (index, 0), datatypes.UNSIGNED8, access, count)


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
    elif index not in COUNTING_INDICES and members[0].default != highest and 0 in subs:
        default = members[0].default
        if default is None:
            source.warn(subs[0], "DefaultValue", f"missing, but the highest subindex is {highest}; taken")
            members[0].default = highest
        else:
            source.warn(subs[0], "DefaultValue", f"{default}, but the highest subindex described is {highest}")
