"""Builds a variable of the dictionary from a section of an EDS file: data type, values and limits.

Source: CiA 306-1, "Object description"; CiA 301, "Data types".
"""

from __future__ import annotations

import re
from contextlib import suppress

from canopen.objectdictionary import ODVariable, datatypes

from canprobe.fieldbus.eds import values
from canprobe.fieldbus.eds.mandatory import CHOICE_INDICES, U8, USUAL_TYPES, decides, standard_access, standard_type
from canprobe.fieldbus.eds.numbers import Remark, parse_flag, parse_integer, parse_sum
from canprobe.fieldbus.eds.sections import Section, Source
from canprobe.fieldbus.protocol.sdo import Place

_OBJECT_DOMAIN = 2
_OTHER_TYPES = {
    range(0x20, 0x24): "is a record of CiA 301, not the type of one value",
    range(0x40, 0x60): "is a type of the manufacturer, which this file does not define",
    range(0x60, 0x260): "is a type of a device profile, which this file does not define",
}
"""Data types beyond `KNOWN_TYPES`. Source: CiA 301, "Object dictionary data types"."""
_ACCESS_TYPES = frozenset({"ro", "wo", "rw", "rwr", "rww", "const"})
_ACCESS_WORDS = {"r": "ro", "w": "wo", "wr": "rw", "readonly": "ro", "writeonly": "wo", "readwrite": "rw", "c": "const"}


def plain_variable(name: str, place: Place, data_type: int, access: str, value: int | None) -> ODVariable:
    """A variable that no section describes, with its default."""
    variable = ODVariable(name, *place)
    variable.data_type, variable.access_type, variable.default = data_type, access, value
    return variable


def build_variable(source: Source, section: Section, index: int, subindex: int, composite: bool = False) -> ODVariable:
    """Build the variable that a section describes; without a known data type it holds octets and has no value.

    Args:
        source: the file.
        section: section of the variable, or with CompactSubObj that of the whole object.
        index, subindex: place of the variable.
        composite: whether it is part of an array or record.
    """
    known = _data_type_of(source, section, index, subindex, composite)
    data_type = int(datatypes.DOMAIN) if known is None else known
    variable = ODVariable(_name(source, section, index, subindex), index, subindex)
    variable.data_type = data_type
    variable.access_type = _access(source, section, index, subindex, composite)
    variable.pdo_mappable = source.read(section, "PDOMapping", parse_flag, False, "is neither 0 nor 1; read as 0")
    _set_limits(source, section, variable, data_type)
    if known is not None:
        set_value(source, section, "DefaultValue", variable)
        set_value(source, section, "ParameterValue", variable)
    default, low, high = variable.default, variable.min, variable.max
    if isinstance(default, int | float) and (
        (low is not None and default < low) or (high is not None and default > high)
    ):
        source.warn(section, "DefaultValue", f"{default} is outside LowLimit and HighLimit; served")
    return variable


def set_value(source: Source, section: Section, key: str, variable: ODVariable, name: str = "") -> None:
    """Give the variable its `DefaultValue` or `ParameterValue`; `name` is the key where it has another name."""
    where, data_type = name or key, variable.data_type or datatypes.DOMAIN
    if where.lower() not in section.items:
        return
    text = section.value(where)
    field = "default" if key == "DefaultValue" else "value"
    setattr(variable, f"{field}_raw", text)
    if not text and data_type not in values.TEXT_TYPES:
        return
    try:
        setattr(variable, field, values.convert(text, data_type, source.node_id, source.remark(section, where)))
    except (ValueError, OverflowError):
        wrong = f"{text!r} is not a value of type {values.name_of(data_type)}"
        if decides(variable.index):
            source.fault(section, where, wrong)
        else:
            source.warn(section, where, f"{wrong}; left out, as if the file had none")
        return
    if field == "default" and "$" in text and data_type not in values.TEXT_TYPES:
        with suppress(ValueError):
            variable.relative = parse_sum(text, source.node_id, lambda _: None)[1]


def _name(source: Source, section: Section, index: int, subindex: int) -> str:
    name = section.value("ParameterName")
    if not name:
        name = f"Object {index:04X}h:{subindex:02X}"
        source.warn(section, "ParameterName", f"missing; named {name!r}")
    return name


def _access(source: Source, section: Section, index: int, subindex: int, composite: bool) -> str:
    text = section.value("AccessType").lower()
    if text in _ACCESS_TYPES:
        return text
    taken = _ACCESS_WORDS.get("".join(filter(str.isalpha, text))) or standard_access(
        index, subindex, composite, source.drive
    )
    what = f"{section.value('AccessType')!r} is none of CiA 306" if text else "missing"
    source.warn(section, "AccessType", f"{what}; taken for {taken}")
    return taken


def _set_limits(source: Source, section: Section, variable: ODVariable, data_type: int) -> None:
    def limit(text: str, remark: Remark) -> int | float | None:
        return values.convert_limit(text, data_type, source.node_id, remark)

    wrong = f"is not a value of type {values.name_of(data_type)}; not used"
    low, high = (source.read(section, key, limit, None, wrong) for key in ("LowLimit", "HighLimit"))
    if low == high == 0 and not (source.drive and variable.index in CHOICE_INDICES):
        source.warn(
            section, "LowLimit", "0, and HighLimit 0 too, as editors fill in what nobody stated; neither is used"
        )
        return
    if low is not None and high is not None and low > high:
        source.warn(section, "LowLimit", f"{low} is above HighLimit {high}; neither is used")
        return
    variable.min, variable.max = low, high  # type: ignore[assignment]  # those of a REAL are floats


def _data_type_of(source: Source, section: Section, index: int, subindex: int, composite: bool) -> int | None:
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
    if data_type not in values.KNOWN_TYPES:
        data_type = _foreign(source, section, data_type)
    if demanded is not None and data_type != demanded:
        stated, right = values.name_of(data_type), values.name_of(demanded)
        source.warn(section, "DataType", f"{stated}, but the standard demands {right}; taken")
        return demanded
    return data_type


def _named_type(text: str) -> int | None:
    word = re.sub(r"[\s_]", "", text.upper())
    named = values.TYPE_NUMBERS.get(
        text.upper(), values.FOREIGN_TYPE_NUMBERS.get(word.removesuffix("T") if word[-2:-1].isdigit() else word)
    )
    return named if named in values.KNOWN_TYPES else None


def _untyped(source: Source, section: Section, demanded: int | None, why: str) -> int | None:
    if demanded is not None:
        source.warn(section, "DataType", f"{why}; the standard demands {values.name_of(demanded)}; taken")
    elif section.value("ObjectType") and source.number(section, "ObjectType") == _OBJECT_DOMAIN:
        return int(datatypes.DOMAIN)
    else:
        source.warn(section, "DataType", f"{why}, so the length of the object is not known; served as octets")
    return demanded


def _foreign(source: Source, section: Section, data_type: int) -> int:
    """A type of the maker, which some editors define in a section such as [A0]; else it is served as octets."""
    definition = source.sections.get(f"{data_type:x}sub1")
    base = source.number(definition, "DefaultValue") if definition is not None else 0
    if base in values.KNOWN_TYPES:
        return base
    what = next((what for numbers, what in _OTHER_TYPES.items() if data_type in numbers), "is not a type of CiA 301")
    source.warn(section, "DataType", f"{data_type:#06x} {what}; the object is served as octets")
    return int(datatypes.DOMAIN)
