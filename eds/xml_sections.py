"""Reads an XDD or XDC file into the sections of the EDS or DCF file that says the same, each with its line.

What checks, mends and builds is the same for both kinds of files. An object has its type, access and values by itself,
or by the parameter that it refers to. Documents that declare entities, and those that are too large, are not read.

Source: CiA 311, "CANopenObject", "parameter", "CANopenGeneralFeatures"; CiA 306-1 for the sections; IEC 61131-3 for the
types of parameters. CANopenEditor marks what the device does not have by its property CO_disabled.
"""

from __future__ import annotations

import re
from typing import Any
from xml.parsers import expat

from canprobe.fieldbus.eds.findings import EdsFindings
from canprobe.fieldbus.eds.sections import Item, Section, Sections
from canprobe.fieldbus.eds.values import FOREIGN_TYPE_NUMBERS

_MAX_BYTES = 16 << 20
_KEYS = {
    "name": "ParameterName",
    "objectType": "ObjectType",
    "dataType": "DataType",
    "accessType": "AccessType",
    "defaultValue": "DefaultValue",
    "actualValue": "ParameterValue",
    "lowLimit": "LowLimit",
    "highLimit": "HighLimit",
    "subNumber": "SubNumber",
    "PDOmapping": "PDOMapping",
}
"""Attribute of an object → key of its section."""
_ACCESS = {"read": "ro", "write": "wo", "readWrite": "rw", "readWriteInput": "rwr", "readWriteOutput": "rww"}
_TYPES = {
    **FOREIGN_TYPE_NUMBERS,
    **{"BYTE": 0x05, "WORD": 0x06, "DWORD": 0x07, "LWORD": 0x1B},
    **{"CHAR": 0x02, "WSTRING": 0x0B, "BITSTRING": 0x0A},
}
_VALUES = {
    "defaultValue": "defaultValue",
    "actualValue": "actualValue",
    "minValue": "lowLimit",
    "maxValue": "highLimit",
}
"""Element of a parameter → attribute of an object that says the same."""
_TEXTS = {
    "vendorName": "VendorName",
    "vendorID": "VendorNumber",
    "productName": "ProductName",
    "productID": "ProductNumber",
    "orderNumber": "OrderCode",
}
_FEATURES = {
    "granularity": "Granularity",
    "nrOfRxPDO": "NrOfRXPDO",
    "nrOfTxPDO": "NrOfTXPDO",
    "bootUpSlave": "SimpleBootUpSlave",
    "bootUpMaster": "SimpleBootUpMaster",
    "dynamicChannels": "DynamicChannelsSupported",
    "groupMessaging": "GroupMessaging",
    "layerSettingServiceSlave": "LSS_Supported",
}
_FLAGS = {"true": "1", "false": "0"}
_COMPOSITES = ("8", "9")


def xml_sections(data: bytes, faults: EdsFindings) -> Sections:
    """The sections of a document; what keeps it from being read is a fault."""
    document = _Document(faults)
    try:
        if len(data) > _MAX_BYTES:
            faults.fault(0, "", "", f"it has {len(data)} bytes, and at most {_MAX_BYTES} are read")
        else:
            document.parser.Parse(data, True)
            return document.sections()
    except (expat.ExpatError, LookupError, ValueError) as error:  # the others: an encoding that expat does not know
        faults.fault(document.parser.CurrentLineNumber, "", "", f"not XML that can be read: {error}")
    return {}


class _Document:
    def __init__(self, faults: EdsFindings) -> None:
        self._faults = faults
        self._sections: Sections = {}
        self._objects: list[tuple[Section, dict[str, str]]] = []
        self._parameters: dict[str, dict[str, str]] = {}
        self._parameter: dict[str, str] = {}  # that which is read
        self._index = ""
        self._path: list[str] = []
        self._text: list[str] = []
        self.parser = expat.ParserCreate()
        self.parser.StartElementHandler, self.parser.EndElementHandler = self._start, self._end
        self.parser.CharacterDataHandler, self.parser.EntityDeclHandler = self._text.append, self._refuse

    def _refuse(self, *_: Any) -> None:
        raise ValueError("it declares an entity, which no XDD needs")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        name = name.rpartition(":")[2]
        parent = self._path[-1] if self._path else ""
        self._path.append(name)
        self._text.clear()
        if name == "parameter":
            access = attributes.get("access", "read")
            self._parameter = {"accessType": _ACCESS.get(access, access)}
            self._parameters[attributes.get("uniqueID", "")] = self._parameter
        elif parent == "parameter" and name in _TYPES:
            self._parameter["dataType"] = f"{_TYPES[name]:04X}"
        elif name in _VALUES and "parameter" in self._path:
            self._parameter[_VALUES[name]] = attributes.get("value", "")
        elif name == "property" and attributes.get("name") == "CO_disabled":
            self._parameter["disabled"] = _FLAGS.get(attributes.get("value", ""), "")
        elif name == "CANopenObject":
            self._index = attributes.get("index", "")
            if not re.fullmatch("[0-9A-Fa-f]{4}", self._index):
                text = f"{self._index!r} is no index of four hexadecimal digits; the object is left out"
                self._faults.warn(self.parser.CurrentLineNumber, "", "", text)
            self._add_object(self._index, attributes)
        elif name == "CANopenSubObject":
            self._add_object(f"{self._index}sub{attributes.get('subIndex', '').lstrip('0') or '0'}", attributes)
        elif name in ("CANopenGeneralFeatures", "CANopenMasterFeatures"):
            for attribute in _FEATURES.keys() & attributes:
                self._add("DeviceInfo", _FEATURES[attribute], attributes[attribute])
        elif name == "supportedBaudRate":
            self._add("DeviceInfo", f"BaudRate_{attributes.get('value', '').partition(' ')[0]}", "1")
        elif name == "dummy":
            key, _, value = attributes.get("entry", "").partition("=")
            self._add("DummyUsage", key, value)
        elif name == "deviceCommissioning":
            given = {key.lower(): value for key, value in attributes.items()}
            self._add("DeviceComissioning", "NodeID", given.get("nodeid", ""))
            self._add("DeviceComissioning", "Baudrate", given.get("actualbaudrate", "").partition(" ")[0])

    def _end(self, _: str) -> None:
        name = self._path.pop()
        if name in _TEXTS and self._path[-1:] == ["DeviceIdentity"]:
            self._add("DeviceInfo", _TEXTS[name], "".join(self._text).strip())

    def _add(self, title: str, key: str, value: str) -> None:
        line = self.parser.CurrentLineNumber
        section = self._sections.setdefault(title.lower(), Section(title, line))
        section.items.setdefault(key.lower(), Item(key, _FLAGS.get(value, value), line))

    def _add_object(self, title: str, attributes: dict[str, str]) -> None:
        section = Section(title, self.parser.CurrentLineNumber)
        if (first := self._sections.setdefault(title.lower(), section)) is section:
            self._objects.append((section, attributes))
        else:
            self._faults.warn(section.line, title, "", f"is in line {first.line} already; that one counts")

    def sections(self) -> Sections:
        """The sections, with what their objects refer to."""
        disabled = ""
        for section, attributes in self._objects:
            index, named = section.name.partition("sub")[0], attributes.get("uniqueIDRef", "")
            if named and named not in self._parameters:
                self._faults.warn(section.line, section.name, "", f"refers to parameter {named}, which is not there")
            stated = {**self._parameters.get(named, {}), **attributes}
            disabled = index if stated.get("disabled") == "1" else disabled
            if index == disabled:
                del self._sections[section.name.lower()]
                continue
            if stated.get("objectType") in _COMPOSITES:
                stated.pop("accessType", None)
            if "dataType" in stated:
                stated["dataType"] = f"0x{stated['dataType']}"
            if "PDOmapping" in stated:
                stated["PDOmapping"] = "0" if stated["PDOmapping"] == "no" else "1"
            for attribute, key in _KEYS.items():
                if attribute in stated:
                    value = _FLAGS.get(stated[attribute], stated[attribute])
                    section.items[key.lower()] = Item(key, value, section.line)
        return self._sections
