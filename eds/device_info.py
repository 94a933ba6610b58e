"""Reads [DeviceInfo], [Comments] and [DeviceComissioning] into the fields that canopen has for them.

Source: CiA 306-1, "Device information", "Comments", "Device commissioning" (the standard's own spelling has one m).
"""

from __future__ import annotations

from canopen.objectdictionary import ObjectDictionary

from canprobe.fieldbus.eds.numbers import parse_integer
from canprobe.fieldbus.eds.sections import Section, Sections, Source

_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
_TEXT_FIELDS = {"VendorName": "vendor_name", "ProductName": "product_name", "OrderCode": "order_code"}
_NUMBER_FIELDS = {
    "VendorNumber": "vendor_number",
    "ProductNumber": "product_number",
    "RevisionNumber": "revision_number",
    "NrOfRXPDO": "nr_of_RXPDO",
    "NrOfTXPDO": "nr_of_TXPDO",
}
_FLAG_FIELDS = {
    "SimpleBootUpMaster": "simple_boot_up_master",
    "SimpleBootUpSlave": "simple_boot_up_slave",
    "Granularity": "granularity",
    "DynamicChannelsSupported": "dynamic_channels_supported",
    "GroupMessaging": "group_messaging",
    "LSS_Supported": "LSS_supported",
}


def read_information(source: Source, od: ObjectDictionary) -> None:
    """Fill in the dictionary's fields on its device; a wrong number is left out with a warning."""
    od.node_id = source.node_id
    if (section := source.sections.get("comments")) is not None:
        lines = [item.value for key, item in section.items.items() if key.startswith("line") and key != "lines"]
        od.comments = "\n".join(lines)
    if (section := source.sections.get("deviceinfo")) is not None:
        information = od.device_information
        for rate in _RATES_KBIT_S:
            if source.number(section, f"BaudRate_{rate}"):
                information.allowed_baudrates.add(rate * 1000)
        for key, field in _TEXT_FIELDS.items():
            if key.lower() in section.items:
                setattr(information, field, section.value(key))
        for key, field in {**_NUMBER_FIELDS, **_FLAG_FIELDS}.items():
            if section.value(key):
                number = source.number(section, key)
                setattr(information, field, bool(number) if key in _FLAG_FIELDS else number)
    if (section := _commissioning(source.sections)) is not None:
        if rate := source.number(section, "Baudrate"):
            od.bitrate = rate * 1000
        if (node_id := source.number(section, "NodeID", source.node_id)) != source.node_id:
            source.warn(section, "NodeID", f"the file configures node {node_id}; read for node {source.node_id}")


def commissioned_node(sections: Sections) -> int | None:
    """Node id for which a DCF was made; None where it states none."""
    section = _commissioning(sections)
    if section is None:
        return None
    try:
        node_id = parse_integer(section.value("NodeID"), lambda _: None)
    except ValueError:
        return None
    return node_id if 1 <= node_id <= 127 else None


def _commissioning(sections: Sections) -> Section | None:
    return sections.get("devicecomissioning") or sections.get("devicecommissioning")
