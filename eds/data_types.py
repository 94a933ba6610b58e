"""The data type of a variable: as the file says, as its editor defined it, or as the standard demands.

Source: CiA 306-1, "Object description"; CiA 301, "Data types".
"""

from __future__ import annotations

import re

from canopen.objectdictionary import datatypes

from canprobe.fieldbus.eds.mandatory import U8, USUAL_TYPES, standard_type
from canprobe.fieldbus.eds.numbers import parse_integer
from canprobe.fieldbus.eds.sections import Section
from canprobe.fieldbus.eds.source import Source
from canprobe.fieldbus.eds.values import FOREIGN_TYPE_NUMBERS, KNOWN_TYPES, TYPE_NUMBERS, name_of

_OBJECT_DOMAIN = 2
_OTHER_TYPES = {
    range(0x20, 0x24): "is a record of CiA 301, not the type of one value",
    range(0x40, 0x60): "is a type of the manufacturer, which this file does not define",
    range(0x60, 0x260): "is a type of a device profile, which this file does not define",
}
"""Data types beyond `KNOWN_TYPES`. Source: CiA 301, "Object dictionary data types"."""


def data_type_of(source: Source, section: Section, index: int, subindex: int, composite: bool) -> int | None:
    """Data type that a section means, one of `KNOWN_TYPES`; None where it cannot be known."""
    text = section.value("DataType")
    demanded = standard_type(index, subindex, source.drive)
    usual = U8 if composite and subindex == 0 else USUAL_TYPES.get((index, subindex)) if source.drive else None
    if not text:
        return _untyped(source, section, demanded or usual, "missing")
    if (named := _named_type(text)) is not None:
        source.warn(section, "DataType", f"{text} is read as {named:#06x}")
        data_type = named
    else:
        try:
            data_type = parse_integer(text, source.remark(section, "DataType"))
        except ValueError:
            return _untyped(source, section, demanded or usual, f"{text!r} is not a data type")
    if data_type not in KNOWN_TYPES:
        data_type = _foreign(source, section, data_type)
    if demanded is not None and data_type != demanded:
        source.warn(section, "DataType", f"{name_of(data_type)}, but the standard demands {name_of(demanded)}; taken")
        return demanded
    return data_type


def _named_type(text: str) -> int | None:
    word = re.sub(r"[\s_]", "", text.upper())
    named = TYPE_NUMBERS.get(
        text.upper(), FOREIGN_TYPE_NUMBERS.get(word.removesuffix("T") if word[-2:-1].isdigit() else word)
    )
    return named if named in KNOWN_TYPES else None


def _untyped(source: Source, section: Section, demanded: int | None, why: str) -> int | None:
    if demanded is not None:
        source.warn(section, "DataType", f"{why}; the standard demands {name_of(demanded)}; taken")
    elif section.value("ObjectType") and source.number(section, "ObjectType") == _OBJECT_DOMAIN:
        return int(datatypes.DOMAIN)
    else:
        source.warn(section, "DataType", f"{why}, so the length of the object is not known; served as octets")
    return demanded


def _foreign(source: Source, section: Section, data_type: int) -> int:
    """A type of the maker, which some editors define in a section such as [A0]; else it is served as octets."""
    definition = source.sections.get(f"{data_type:x}sub1")
    base = source.number(definition, "DefaultValue") if definition is not None else 0
    if base in KNOWN_TYPES:
        return base
    what = next((what for numbers, what in _OTHER_TYPES.items() if data_type in numbers), "is not a type of CiA 301")
    source.warn(section, "DataType", f"{data_type:#06x} {what}; the object is served as octets")
    return int(datatypes.DOMAIN)
