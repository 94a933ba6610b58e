"""One section of an EDS file → one variable of the dictionary.

Source: CiA 306-1, "Object description".
"""

from __future__ import annotations

from contextlib import suppress

from canopen.objectdictionary import ODVariable, datatypes

from canprobe.eds.data_types import data_type_of
from canprobe.eds.lines import Section
from canprobe.eds.numbers import parse_flag, parse_sum
from canprobe.eds.source import Source
from canprobe.eds.standard_types import standard_access
from canprobe.eds.values import TEXTS, convert, convert_limit, name_of

_ACCESS = frozenset({"ro", "wo", "rw", "rwr", "rww", "const"})
_ACCESS_WORDS = {"r": "ro", "w": "wo", "wr": "rw", "readonly": "ro", "writeonly": "wo", "readwrite": "rw", "c": "const"}


def build_variable(
    source: Source, section: Section, index: int, subindex: int, composite: bool = False
) -> ODVariable | None:
    """The variable that a section describes, or None where its data type cannot be known (a fault).

    Args:
        source: the file.
        section: the variable's, or with CompactSubObj that of the whole object.
        index, subindex: of the variable.
        composite: it is part of an array or record.
    """
    data_type = data_type_of(source, section, index, subindex)
    if data_type is None:
        return None
    variable = ODVariable(_name(source, section, index, subindex), index, subindex)
    variable.data_type = data_type
    variable.access_type = _access(source, section, index, subindex, composite)
    variable.pdo_mappable = _flag(source, section, "PDOMapping")
    if location := section.value("StorageLocation"):
        setattr(variable, "storage_location", location)  # noqa: B010 - canopen declares it as None
    _set_limits(source, section, variable, data_type)
    set_value(source, section, "DefaultValue", variable)
    set_value(source, section, "ParameterValue", variable)
    _check_default(source, section, variable)
    _set_extras(section, variable)
    return variable


def set_value(source: Source, section: Section, key: str, variable: ODVariable, name: str = "") -> None:
    """Give the variable its `DefaultValue` or `ParameterValue`; `name` is the key where it is another one."""
    where, data_type = name or key, variable.data_type or datatypes.DOMAIN
    if where.lower() not in section.items:
        return
    text = section.value(where)
    field = "default" if key == "DefaultValue" else "value"
    setattr(variable, f"{field}_raw", text)
    if not text and data_type not in TEXTS:
        return
    try:
        setattr(variable, field, convert(text, data_type, source.node_id, source.remark(section, where)))
    except (ValueError, OverflowError):
        source.fault(section, where, f"{text!r} is not a value of type {name_of(data_type)}")
        return
    if field == "default" and "$" in text and data_type not in TEXTS:
        with suppress(ValueError):
            variable.relative = parse_sum(text, source.node_id, _silent)[1]


def _name(source: Source, section: Section, index: int, subindex: int) -> str:
    name = section.value("ParameterName")
    if not name:
        name = f"Object {index:04X}h:{subindex:02X}"
        source.warn(section, "ParameterName", f"missing; named {name!r}")
    return name


def _access(source: Source, section: Section, index: int, subindex: int, composite: bool) -> str:
    text = section.value("AccessType").lower()
    if text in _ACCESS:
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
    if low is not None and high is not None and low > high:
        source.warn(section, "LowLimit", f"{low} is above HighLimit {high}; neither is used")
        return
    variable.min, variable.max = low, high  # type: ignore[assignment]  # of a REAL they are floats


def _limit(source: Source, section: Section, key: str, data_type: int) -> int | float | None:
    text = section.value(key)
    if not text:
        return None
    try:
        return convert_limit(text, data_type, source.node_id, source.remark(section, key))
    except (ValueError, OverflowError):
        source.warn(section, key, f"{text!r} is not a value of type {name_of(data_type)}; not used")
        return None


def _check_default(source: Source, section: Section, variable: ODVariable) -> None:
    default = variable.default
    if not isinstance(default, (int, float)):
        return
    too_low = variable.min is not None and default < variable.min
    if too_low or (variable.max is not None and default > variable.max):
        source.warn(section, "DefaultValue", f"{default} is outside LowLimit and HighLimit; served")


def _set_extras(section: Section, variable: ODVariable) -> None:
    """What canopen takes beyond the standard."""
    variable.description = section.value("Description")
    variable.unit = section.value("Unit")
    with suppress(ValueError):
        variable.factor = float(section.value("Factor"))


def _silent(text: str) -> None:
    return None
