"""Builds arrays and records from sections, also in the compact form, and checks their counts.

Source: CiA 306-1, "Object description", "CompactSubObj".
"""

from __future__ import annotations

import copy

from canopen.objectdictionary import ODArray, ODRecord, ODVariable, datatypes

from canprobe.fieldbus.eds.mandatory import COUNTING_INDICES, is_variable
from canprobe.fieldbus.eds.sections import Section
from canprobe.fieldbus.eds.source import Source
from canprobe.fieldbus.eds.variables import build_variable, set_value

ARRAY, RECORD = 8, 9
"""Object codes."""
Subs = dict[int, Section]
"""Sections of the sub-objects of an object, by subindex."""
_MAX_COMPACT_MEMBERS = 254


def build_composite(source: Source, index: int, head: Section, subs: Subs, kind: int) -> ODArray | ODRecord | None:
    """The array or record that sections describe, or None where nothing of it can be served.

    Args:
        source: the file.
        index: index of the object.
        head: section of the object itself.
        subs: sections of its sub-objects.
        kind: object code, `ARRAY` or `RECORD`.
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
    variable = ODVariable("Number of entries", index, 0)
    variable.data_type = datatypes.UNSIGNED8
    variable.access_type = "rw" if index in COUNTING_INDICES else "ro"
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
    elif index not in COUNTING_INDICES and members[0].default != highest and 0 in subs:
        default = members[0].default
        if default is None:
            source.warn(subs[0], "DefaultValue", f"missing, but the highest subindex is {highest}; taken")
            members[0].default = highest
        else:
            source.warn(subs[0], "DefaultValue", f"{default}, but the highest subindex described is {highest}")
