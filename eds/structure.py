"""Builds the objects of the dictionary from sections: variables, arrays, records and dummy types.

Source: CiA 306-1, "Object description", "Dummy usage".
"""

from __future__ import annotations

import re

from canopen.objectdictionary import ObjectDictionary, ODArray, ODRecord, ODVariable

from canprobe.fieldbus.eds.numbers import parse_integer
from canprobe.fieldbus.eds.records import ARRAY, RECORD, Subs, build_composite
from canprobe.fieldbus.eds.sections import Section
from canprobe.fieldbus.eds.source import Source
from canprobe.fieldbus.eds.variables import build_variable

_OBJECT_PATTERN = re.compile(r"(?:0x)?([0-9a-f]{4})")
_SUB_OBJECT_PATTERN = re.compile(r"(?:0x)?([0-9a-f]{4})\s*sub\s*(?:0x)?([0-9a-f]{1,2})")
_NULL, _DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR = 0, 2, 5, 6, 7
_OBJECT_CODES = frozenset({_NULL, _DOMAIN, _DEFTYPE, _DEFSTRUCT, _VAR, ARRAY, RECORD})


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
        return build_composite(source, index, head, subs, RECORD)
    kind = _kind(source, head, subs)
    if kind in (_VAR, _DOMAIN):
        return build_variable(source, head, index, 0)
    return build_composite(source, index, head, subs, kind) if kind in (ARRAY, RECORD) else None


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
