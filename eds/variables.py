"""Builds a variable of the dictionary from a section of an EDS file: data type, values and limits.

Source: CiA 306-1, "Object description".
"""

from __future__ import annotations

from contextlib import suppress

from canopen.objectdictionary import ODVariable, datatypes

from canprobe.fieldbus.eds.data_types import data_type_of
from canprobe.fieldbus.eds.mandatory import CHOICE_INDICES, decides, standard_access
from canprobe.fieldbus.eds.numbers import parse_flag, parse_sum
from canprobe.fieldbus.eds.sections import Section
from canprobe.fieldbus.eds.source import Source
from canprobe.fieldbus.eds.values import TEXT_TYPES, convert, convert_limit, name_of

_ACCESS_TYPES = frozenset({"ro", "wo", "rw", "rwr", "rww", "const"})
_ACCESS_WORDS = {"r": "ro", "w": "wo", "wr": "rw", "readonly": "ro", "writeonly": "wo", "readwrite": "rw", "c": "const"}


def build_variable(source: Source, section: Section, index: int, subindex: int, composite: bool = False) -> ODVariable:
    """Build the variable that a section describes; without a known data type it holds octets and has no value.

    Args:
        source: the file.
        section: section of the variable, or with CompactSubObj that of the whole object.
        index, subindex: place of the variable.
        composite: whether it is part of an array or record.
    """
    known = data_type_of(source, section, index, subindex, composite)
    data_type = int(datatypes.DOMAIN) if known is None else known
    variable = ODVariable(_name(source, section, index, subindex), index, subindex)
    variable.data_type = data_type
    variable.access_type = _access(source, section, index, subindex, composite)
    variable.pdo_mappable = _flag(source, section, "PDOMapping")
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
    if not text and data_type not in TEXT_TYPES:
        return
    try:
        setattr(variable, field, convert(text, data_type, source.node_id, source.remark(section, where)))
    except (ValueError, OverflowError):
        wrong = f"{text!r} is not a value of type {name_of(data_type)}"
        if decides(variable.index):
            source.fault(section, where, wrong)
        else:
            source.warn(section, where, f"{wrong}; left out, as if the file had none")
        return
    if field == "default" and "$" in text and data_type not in TEXT_TYPES:
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


def _flag(source: Source, section: Section, key: str) -> bool:
    text = section.value(key)
    if not text:
        return False  # the default of CiA 306
    try:
        return parse_flag(text, source.remark(section, key))
    except ValueError:
        source.warn(section, key, f"{text!r} is neither 0 nor 1; read as 0")
        return False


def _set_limits(source: Source, section: Section, variable: ODVariable, data_type: int) -> None:
    low = _limit(source, section, "LowLimit", data_type)
    high = _limit(source, section, "HighLimit", data_type)
    if low == high == 0 and not (source.drive and variable.index in CHOICE_INDICES):
        source.warn(
            section, "LowLimit", "0, and HighLimit 0 too, as editors fill in what nobody stated; neither is used"
        )
        return
    if low is not None and high is not None and low > high:
        source.warn(section, "LowLimit", f"{low} is above HighLimit {high}; neither is used")
        return
    variable.min, variable.max = low, high  # type: ignore[assignment]  # those of a REAL are floats


def _limit(source: Source, section: Section, key: str, data_type: int) -> int | float | None:
    text = section.value(key)
    if not text:
        return None
    try:
        return convert_limit(text, data_type, source.node_id, source.remark(section, key))
    except (ValueError, OverflowError):
        source.warn(section, key, f"{text!r} is not a value of type {name_of(data_type)}; not used")
        return None
