"""Checks the lists of objects in an EDS file against the objects that it describes.

Source: CiA 306-1, "Object lists".
"""

from __future__ import annotations

import re

from canprobe.fieldbus.eds.numbers import parse_integer
from canprobe.fieldbus.eds.sections import Section, Source

_LISTED_AREAS = {
    "MandatoryObjects": (range(0x1000, 0x1002), range(0x1018, 0x1019)),
    "OptionalObjects": (range(0x1002, 0x1018), range(0x1019, 0x2000), range(0x6000, 0x10000)),
    "ManufacturerObjects": (range(0x2000, 0x6000),),
}
_REQUIRED_SECTIONS = ("FileInfo", "DeviceInfo", "MandatoryObjects")


def check_lists(source: Source, described: dict[int, Section]) -> None:
    """Warn of missing sections, wrong counts, listed objects without a section, and sections in no list.

    Args:
        source: the file.
        described: section of each object, by index.
    """
    listed: dict[int, str] = {}
    for title in _REQUIRED_SECTIONS:
        if title.lower() not in source.sections:
            source.faults.warn(0, title, "", "section missing")
    present = [title for title in _LISTED_AREAS if title.lower() in source.sections]
    for title in present:
        _check_list(source, source.sections[title.lower()], title, described, listed)
    covered = [area for title in present for area in _LISTED_AREAS[title]]
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
    """Index in a list; a number without 0x is hexadecimal where only that names an object."""
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
