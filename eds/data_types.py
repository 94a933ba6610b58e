"""The data type of a variable: as the file says, as its editor defined it, or as the standard demands.

Source: CiA 306-1, "Object description"; CiA 301, "Data types".
"""

from __future__ import annotations

from canopen.objectdictionary import datatypes

from canprobe.eds.lines import Section
from canprobe.eds.numbers import parse_integer
from canprobe.eds.source import Source
from canprobe.eds.standard_types import standard_type
from canprobe.eds.values import KNOWN, NAMES, name_of

_OBJECT_DOMAIN = 2


def data_type_of(source: Source, section: Section, index: int, subindex: int) -> int | None:
    """The data type that a section means, one of `values.KNOWN`; None where it cannot be known (a fault)."""
    text = section.value("DataType")
    demanded = standard_type(index, subindex, source.drive)
    if not text:
        return _untyped(source, section, demanded)
    if (named := NAMES.get(text.upper())) is not None:
        source.warn(section, "DataType", f"{text} is read as {named:#06x}")
        return named
    try:
        data_type = parse_integer(text, source.remark(section, "DataType"))
    except ValueError:
        source.fault(section, "DataType", f"{text!r} is not a data type")
        return None
    if data_type not in KNOWN:
        data_type = _foreign(source, section, data_type)
    if demanded is not None and data_type != demanded:
        source.warn(section, "DataType", f"{name_of(data_type)}, but the standard demands {name_of(demanded)}; taken")
        return demanded
    return data_type


def _untyped(source: Source, section: Section, demanded: int | None) -> int | None:
    if section.value("ObjectType") and source.number(section, "ObjectType") == _OBJECT_DOMAIN:
        return int(datatypes.DOMAIN)
    if demanded is None:
        source.fault(section, "DataType", "missing, so the length of the object cannot be known")
    else:
        source.warn(section, "DataType", f"missing; the standard demands {name_of(demanded)}")
    return demanded


def _foreign(source: Source, section: Section, data_type: int) -> int:
    """A type of the maker's own: defined in a section such as [A0] by some editors, else served as octets."""
    definition = source.sections.get(f"{data_type:x}sub1")
    base = source.number(definition, "DefaultValue") if definition is not None else 0
    if base in KNOWN:
        return base
    source.warn(section, "DataType", f"{data_type:#06x} is not a type of CiA 301; the object is served as octets")
    return int(datatypes.DOMAIN)
