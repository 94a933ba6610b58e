"""XDD and XDC files: read as the EDS file that says the same, with findings at their lines, whatever is in them."""

from __future__ import annotations

import random
from xml.sax.saxutils import quoteattr

import pytest
from canopen.objectdictionary import ODVariable

from canprobe.fieldbus.bus.clock import VirtualClock
from canprobe.fieldbus.bus.virtual.lockstep import LockstepBus
from canprobe.fieldbus.drive.from_eds import make_eds_node
from canprobe.fieldbus.eds.description import Description
from canprobe.fieldbus.eds.packaged import check_eds, eds_names, load_eds
from canprobe.fieldbus.tools.conform import POINTS, Examination
from canprobe.fieldbus.tools.reports import Verdict

TYPES = {1: "BOOL", 2: "SINT", 3: "INT", 4: "DINT", 5: "USINT", 6: "UINT", 7: "UDINT", 8: "REAL", 9: "STRING"}
ACCESS = {"ro": "read", "const": "const", "wo": "write", "rw": "readWrite"} | {
    "rwr": "readWriteInput",
    "rww": "readWriteOutput",
}
CONTAINER = """<?xml version="1.0" encoding="utf-8"?>
<ISO15745ProfileContainer xmlns="http://www.canopen.org/xml/1.1" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">
 <ISO15745Profile><ProfileBody xmlns:q1="http://www.canopen.org/xml/1.1" xmlns="">
  <q1:DeviceIdentity><q1:vendorName>Some &amp; Sons</q1:vendorName><q1:vendorID>0xCA5E</q1:vendorID>
   <q1:productName>device</q1:productName></q1:DeviceIdentity>
  <q1:ApplicationProcess><q1:parameterList>
{parameters}
  </q1:parameterList></q1:ApplicationProcess>
 </ProfileBody></ISO15745Profile>
 <ISO15745Profile><ProfileBody>
  <ApplicationLayers><CANopenObjectList>
{objects}
  </CANopenObjectList><dummyUsage><dummy entry="Dummy0005=1"/></dummyUsage></ApplicationLayers>
  <TransportLayers><PhysicalLayer><baudRate><supportedBaudRate value="500 Kbps"/></baudRate></PhysicalLayer>
  </TransportLayers>
  <NetworkManagement><CANopenGeneralFeatures granularity="8" bootUpSlave="true" layerSettingServiceSlave="false"/>
{management}
  </NetworkManagement>
 </ProfileBody></ISO15745Profile>
</ISO15745ProfileContainer>
"""


def document(objects: str = "", parameters: str = "", management: str = "") -> str:
    return CONTAINER.format(objects=objects, parameters=parameters, management=management)


def variable_xml(tag: str, place: str, variable: ODVariable, parameters: list[str]) -> str:
    """One variable: by attributes of its own where its index is odd, else by a parameter."""
    low, high, default = variable.min, variable.max, getattr(variable, "default_raw", None)
    mapping = "optional" if variable.pdo_mappable else "no"
    head = f"<{tag} {place} name={quoteattr(variable.name)} objectType='7' PDOmapping='{mapping}'"
    if variable.index % 2 or variable.data_type not in TYPES:
        given = {"defaultValue": default, "lowLimit": low, "highLimit": high}
        own = "".join(f" {key}={quoteattr(str(value))}" for key, value in given.items() if value is not None)
        return f"{head} dataType='{variable.data_type:04X}' accessType='{variable.access_type}'{own}/>"
    name = f"UID_{variable.index:04X}{variable.subindex:02X}"
    limits = (("minValue", low), ("maxValue", high))
    values = "".join(f"<{tag} value={quoteattr(str(value))}/>" for tag, value in limits if value is not None)
    allowed = f"<q1:allowedValues><range>{values}</range></q1:allowedValues>" if values else ""
    value = "" if default is None else f"<q1:defaultValue value={quoteattr(default)}/>"
    parameters.append(
        f"<q1:parameter uniqueID='{name}' access='{ACCESS[variable.access_type]}'><label>x</label>"
        f"<{TYPES[variable.data_type]}/>{value}{allowed}</q1:parameter>"
    )
    return f"{head} uniqueIDRef='{name}'/>"


def xdd_of(name: str) -> str:
    objects, parameters = [], []
    for entry in load_eds(name, 5).values():
        place = f"index='{entry.index:04X}'"
        if isinstance(entry, ODVariable):
            if entry.index > 7:  # a dummy is none
                objects.append(variable_xml("CANopenObject", place, entry, parameters))
            continue
        kind = 9 if type(entry).__name__ == "ODRecord" else 8
        members = entry.subindices
        title = f"name={quoteattr(entry.name)} objectType='{kind}' subNumber='{len(members)}'"
        subs = [variable_xml("CANopenSubObject", f"subIndex='{n:02X}'", one, parameters) for n, one in members.items()]
        objects.append(f"<CANopenObject {place} {title}>{''.join(subs)}</CANopenObject>")
    return document("\n".join(objects), "\n".join(parameters))


def entries(od) -> dict[tuple[int, int], ODVariable]:
    named = {}
    for one in od.values():
        named |= {(one.index, 0): one} if isinstance(one, ODVariable) else {(one.index, n): v for n, v in one.items()}
    return {place: variable for place, variable in named.items() if place[0] > 7}


@pytest.mark.parametrize("name", eds_names())
def test_every_entry_is_that_of_the_eds_file(name, tmp_path):
    path = tmp_path / "device.xdd"
    path.write_text(xdd_of(name), encoding="utf-8")
    reading, eds = check_eds(path, 5), entries(check_eds(name, 5).dictionary)
    assert reading.faults == () and {one.text for one in reading.warnings} <= {
        one.text for one in check_eds(name, 5).warnings
    }
    xdd = entries(reading.dictionary)
    assert xdd.keys() == eds.keys()
    fields = ("name", "data_type", "access_type", "pdo_mappable", "default", "min", "max", "relative")
    for place, variable in eds.items():
        assert [getattr(xdd[place], one) for one in fields] == [getattr(variable, one) for one in fields], place
    information = reading.dictionary.device_information
    assert (information.vendor_name, information.vendor_number) == ("Some & Sons", 0xCA5E)
    assert information.allowed_baudrates == {500_000} and information.simple_boot_up_slave is True
    assert information.LSS_supported is False and 5 in reading.dictionary.indices


def test_an_xdc_has_its_values_and_its_node(tmp_path):
    objects = (
        "<CANopenObject index='1000' name='type' objectType='7' dataType='0007' accessType='ro' defaultValue='0x191'/>"
        "<CANopenObject index='1017' name='beat' objectType='7' uniqueIDRef='UID_1017'/>"
        "<CANopenObject index='2000' name='not there' objectType='7' uniqueIDRef='UID_2000'/>"
    )
    parameters = (
        "<q1:parameter uniqueID='UID_1017' access='readWrite'><UINT/><q1:actualValue value='500'/></q1:parameter>"
        "<q1:parameter uniqueID='UID_2000'><UINT/><q1:property name='CO_disabled' value='true'/></q1:parameter>"
    )
    path = tmp_path / "device.xdc"
    commissioning = "<deviceCommissioning nodeID='0x0C' actualBaudRate='250 Kbps' nodeName='n'/>"
    path.write_text(document(objects, parameters, commissioning))
    od = check_eds(path).dictionary
    assert (od.node_id, od.bitrate, od[0x1017].value, od[0x1017].access_type) == (12, 250_000, 500, "rw")
    assert 0x2000 not in od.indices, "CANopenEditor disabled it"


HUGE = "<!DOCTYPE x [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;'>]>"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (document(), "whole file: no object in it"),
        ("<?xml version='1.0'?>\n<a><b></a>", "line 2: not XML that can be read: mismatched tag"),
        (CONTAINER.replace("?>\n", f"?>\n{HUGE}\n", 1), "line 2: not XML that can be read: it declares an entity"),
        ("<?xml version='1.0' encoding='gbk'?><a/>", "not XML that can be read: multi-byte encodings"),
        ("<?xml version='1.0'?><a>" + " " * (16 << 20) + "</a>", "bytes, and at most 16777216 are read"),
        (
            document("<CANopenObject index='1000' name='t' objectType='7' dataType='0007' defaultValue='x'/>"),
            "line 12 [1000] DefaultValue: 'x' is not a value of type UNSIGNED32",
        ),
        (document("<CANopenObject name='t' objectType='7'/>"), "line 12: '' is no index of four hexadecimal digits"),
        (
            document("<CANopenObject index='2000' name='t' objectType='7' uniqueIDRef='UID'/>\n" * 2),
            "line 12 [2000]: refers to parameter UID, which is not there",
        ),
        (
            document("<CANopenObject index='2000' name='t' objectType='7' dataType='0007' accessType='ro'/>\n" * 2),
            "line 13 [2000]: is in line 12 already; that one counts",
        ),
    ],
)
def test_findings_have_their_lines(text, told, tmp_path):
    path = tmp_path / "device.xdd"
    path.write_text(text)
    assert any(told in str(finding) for finding in check_eds(path).found)


def test_damaged_documents_give_findings_and_nothing_else(tmp_path):
    path, rng = tmp_path / "device.xdd", random.Random(5)
    whole = xdd_of("puma260_joint").encode()
    for _ in range(60):
        data = bytearray(whole)
        for _ in range(rng.randrange(1, 4)):
            at = rng.randrange(len(data))
            data[at : at + rng.randrange(4)] = rng.randbytes(rng.randrange(3))
        path.write_bytes(bytes(data[: rng.choice([len(data), rng.randrange(len(data))])]))
        check_eds(path, 5)


def test_a_device_is_served_and_examined_by_its_xdd(tmp_path):
    path = tmp_path / "drive.xdd"
    path.write_text(xdd_of("puma260_joint"))
    od, bus = load_eds(path, 5), LockstepBus(VirtualClock(), fd=True)
    bus.attach(make_eds_node(od, 5, eds=path))
    points = [point for point in POINTS if point.group in ("sdo", "objects")]
    report = Examination(bus.port(), 5, Description(od)).run(points=points)
    assert report.exit_status == 0 and report.counts()[Verdict.PASS] > 20
