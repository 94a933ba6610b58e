"""The two EDS files, read by canopen and by hand; the standard's rules (CiA 306-1, CiA 301) are checked, not copied."""

import configparser
import logging
import re
from collections import Counter

import canopen
import pytest
from canopen.objectdictionary import datatypes

from canprobe.errors import EdsError
from canprobe.fieldbus.eds import packaged as eds
from canprobe.fieldbus.protocol.frames import is_restricted

NAMES = ("puma260_joint", "tactile_array")
SIGNED = {2: 8, 3: 16, 4: 32, 0x15: 64}
UNSIGNED = {5: 8, 6: 16, 7: 32, 0x1B: 64}
STRING = 9
DUMMY_BITS = {1: 1, 2: 8, 3: 16, 4: 32, 5: 8, 6: 16, 7: 32}
LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")


def read_by_hand(name):
    """Second parser: sections as plain dicts, duplicates refused."""
    parser = configparser.RawConfigParser(strict=True, comment_prefixes=(";",))
    parser.optionxform = str
    parser.read_string(eds.eds_path(name).read_text(encoding="ascii"))
    return {section: dict(parser[section]) for section in parser.sections()}


def hand_value(text, node_id):
    total = 0
    for term in text.split("+"):
        total += node_id if term == "$NODEID" else int(term, 0)
    return total


def variables(od):
    for entry in od.values():
        if entry.index <= 7:
            continue
        yield from entry.values() if hasattr(entry, "values") else (entry,)


def value_range(data_type):
    if data_type in SIGNED:
        bits = SIGNED[data_type]
        return -(1 << bits - 1), (1 << bits - 1) - 1
    return 0, (1 << UNSIGNED[data_type]) - 1


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


@pytest.fixture
def sections(name):
    return read_by_hand(name)


@pytest.fixture
def od(name):
    return eds.load_eds(name, 5)


def test_canopen_reads_it_without_a_word(name, caplog):
    caplog.set_level(logging.DEBUG)
    od = canopen.import_od(str(eds.eds_path(name)), 5)
    assert caplog.records == []
    assert len(od) > 80


def test_object_lists_hold_every_object_once_where_it_belongs(sections):
    """CiA 306-1: object lists."""
    listed = []
    for title in LISTS:
        entries = dict(sections[title])
        count = int(entries.pop("SupportedObjects"), 0)
        assert list(entries) == [str(n) for n in range(1, count + 1)]
        listed.append([int(index, 16) for index in entries.values()])
    mandatory, optional, manufacturer = listed
    assert mandatory == [0x1000, 0x1001, 0x1018]
    assert all(0x1000 <= i < 0x2000 or 0x6000 <= i < 0xA000 for i in optional)
    assert all(0x2000 <= i < 0x6000 for i in manufacturer)
    present = [int(s, 16) for s in sections if re.fullmatch("[0-9A-F]{4}", s)]
    assert present == mandatory + optional + manufacturer  # the order of the file is that of the lists
    assert all(indices == sorted(indices) for indices in listed)


def test_every_object_is_described_completely(sections):
    """CiA 306-1: object description; AccessType before nothing else is known."""
    for title, entry in sections.items():
        if not re.fullmatch("[0-9A-F]{4}(sub[0-9A-F]{1,2})?", title):
            continue
        if entry["ObjectType"] == "0x7":
            keys = {"ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "PDOMapping"}
            assert keys <= set(entry) <= keys | {"LowLimit", "HighLimit"}, title
            assert entry["AccessType"] in {"ro", "wo", "rw", "rwr", "rww", "const"}, title
            assert entry["PDOMapping"] in {"0", "1"}, title
            assert entry["ParameterName"] and len(entry["ParameterName"]) <= 241
        else:
            subs = [s for s in sections if s.startswith(f"{title}sub")]
            assert entry["ObjectType"] in {"0x8", "0x9"}, title
            assert set(entry) == {"ParameterName", "ObjectType", "SubNumber"}, title
            assert int(entry["SubNumber"], 0) == len(subs), title
            assert f"{title}sub0" in subs, title


def test_sub_index_0_tells_the_highest_sub_index(od):
    for entry in od.values():
        if entry.index == 0x1003 or 0x1600 <= entry.index < 0x1800 or 0x1A00 <= entry.index < 0x1C00:
            continue  # there it counts what is in use
        if hasattr(entry, "values"):
            assert entry[0].default == max(v.subindex for v in entry.values()), hex(entry.index)


def test_defaults_fit_type_and_limits(od):
    checked = 0
    for var in variables(od):
        if var.data_type == STRING:
            assert isinstance(var.default, str) and var.default
            continue
        lowest, highest = value_range(var.data_type)
        low = lowest if var.min is None else var.min
        high = highest if var.max is None else var.max
        assert lowest <= low <= var.default <= high <= highest, (hex(var.index), var.subindex)
        assert len(var.encode_raw(var.default)) * 8 == len(var)
        checked += 1
    assert checked > 200


def test_canopen_and_a_parser_by_hand_agree(name, sections):
    for node_id in (1, 6, 16, 127):
        od = eds.load_eds(name, node_id)
        assert od.node_id == node_id
        for var in variables(od):
            title = f"{var.index:04X}"
            entry = sections[
                title if title in sections and "DataType" in sections[title] else f"{title}sub{var.subindex:X}"
            ]
            assert var.name == entry["ParameterName"]
            assert var.data_type == int(entry["DataType"], 16)
            assert var.access_type == entry["AccessType"]
            assert var.pdo_mappable == (entry["PDOMapping"] == "1")
            expected = entry["DefaultValue"]
            assert var.default == (expected if var.data_type == STRING else hand_value(expected, node_id))
            for limit, key in ((var.min, "LowLimit"), (var.max, "HighLimit")):
                assert limit == (int(entry[key], 0) if key in entry else None)


def test_device_info_and_identity_say_the_same(sections, od):
    info = sections["DeviceInfo"]
    assert int(info["VendorNumber"], 0) == od[0x1018][1].default == 0xCA5E
    assert int(info["ProductNumber"], 0) == od[0x1018][2].default
    assert int(info["RevisionNumber"], 0) == od[0x1018][3].default
    assert int(info["NrOfRXPDO"]) == sum(0x1400 <= i < 0x1600 for i in od)
    assert int(info["NrOfTXPDO"]) == sum(0x1800 <= i < 0x1A00 for i in od)
    assert 1_000_000 in od.device_information.allowed_baudrates


def test_the_two_devices_are_distinguishable():
    joint, array = (eds.load_eds(name, 1)[0x1018][2].default for name in NAMES)
    assert joint != array


def test_file_info_names_the_file(name, sections):
    info = sections["FileInfo"]
    assert info["FileName"] == eds.eds_path(name).name
    assert re.fullmatch(r"\d\d-\d\d-\d{4}", info["CreationDate"])
    assert re.fullmatch(r"\d\d:\d\d(AM|PM)", info["CreationTime"])
    assert info["EDSVersion"] == "4.0"
    assert len(sections["Comments"]) == int(sections["Comments"]["Lines"]) + 1


def test_lines_are_plain_and_unambiguous(name):
    raw = eds.eds_path(name).read_bytes()
    text = raw.decode("ascii")
    assert "\t" not in text and "\r" not in text and text.endswith("\n") and not text.endswith("\n\n")
    lines = text.splitlines()
    assert all(len(line) <= 255 and line == line.rstrip() for line in lines)
    assert all(";" not in line for line in lines if not line.startswith(";"))  # inline comments differ by parser


def test_names_are_unique_so_that_lookup_by_name_works(od):
    names = Counter(entry.name for entry in od.values())
    assert [n for n, count in names.items() if count > 1] == []
    for entry in od.values():
        if hasattr(entry, "values"):
            subs = Counter(v.name for v in entry.values())
            assert max(subs.values()) == 1, hex(entry.index)


# --- PDOs ---------------------------------------------------------------------------------------------------------


def pdos(od, communication):
    mapping = communication + 0x200
    for index in [i for i in od if communication <= i < communication + 0x200]:
        count = od[mapping + index - communication][0].default
        words = [od[mapping + index - communication][n].default for n in range(1, count + 1)]
        yield index, od[index], words


@pytest.mark.parametrize("communication, direction", [(0x1400, "w"), (0x1800, "r")])
def test_default_mappings_lead_to_mappable_objects_of_that_length(od, communication, direction):
    """CiA 301: PDO mapping parameter."""
    for index, _, words in pdos(od, communication):
        assert sum(word & 0xFF for word in words) <= 64
        for word in words:
            entry = od[word >> 16]
            var = entry[word >> 8 & 0xFF] if hasattr(entry, "values") else entry
            assert var.pdo_mappable, (hex(index), hex(word))
            assert len(var) == word & 0xFF
            assert var.subindex == word >> 8 & 0xFF
            assert direction in var.access_type


@pytest.mark.parametrize("communication", [0x1400, 0x1800])
def test_pdo_cob_ids_are_legal_and_used_once(name, communication):
    od = eds.load_eds(name, 16 if name == "tactile_array" else 3)
    seen = Counter()
    for _, record, _words in pdos(od, communication):
        assert not is_restricted(record[1].default & 0x7FF)
        assert record[1].default & 0x3FFFF800 == 0
        seen[record[1].default & 0x7FF] += 1
        assert record[1].access_type == "rw"
    assert not seen or max(seen.values()) == 1


def test_what_can_be_mapped_can_be_encoded_by_a_pdo(od):
    for var in variables(od):
        if var.pdo_mappable:
            assert var.data_type in SIGNED | UNSIGNED


@pytest.mark.parametrize("node_id", range(1, 7))
def test_drive_pdo_defaults_are_those_of_the_bus_table(node_id):
    od = eds.load_eds("puma260_joint", node_id)
    rpdo = list(pdos(od, 0x1400))
    tpdo = list(pdos(od, 0x1800))
    assert rpdo[0][1][1].default == 0x200 + node_id
    assert tpdo[0][1][1].default == 0x180 + node_id
    assert rpdo[0][2] == [0x60400010, 0x607A0020]  # 6 bytes
    assert tpdo[0][2] == [0x60410010, 0x60640020, 0x60770010]  # 8 bytes
    assert rpdo[0][1][2].default == tpdo[0][1][2].default == 1
    for base, entries in ((0x200, rpdo), (0x180, tpdo)):
        assert len(entries) == 4
        for n, (_, record, _words) in enumerate(entries[1:], 1):
            assert record[1].default == 0x80000000 + base + 0x100 * n + node_id  # there, but not in use


def test_drive_takes_the_dummies_of_the_grouped_targets():
    od = eds.load_eds("puma260_joint", 1)
    dummies = read_by_hand("puma260_joint")["DummyUsage"]
    assert set(dummies) == {f"Dummy{i:04d}" for i in range(1, 8)}
    assert dummies["Dummy0004"] == "1"
    for i in range(1, 8):
        assert (i in od) == (dummies[f"Dummy{i:04d}"] == "1")
    granularity = int(read_by_hand("puma260_joint")["DeviceInfo"]["Granularity"])
    assert all(DUMMY_BITS[i] % granularity == 0 for i in range(1, 8) if i in od)


def test_sensor_takes_no_dummies():
    assert all(i not in eds.load_eds("tactile_array", 16) for i in range(1, 8))


def test_drive_objects_are_all_there():
    wanted = """1000 1001 1003 1005 1006 1007 1008 1009 100A 100C 100D 1010 1011 1014 1015 1016 1017 1018 1019 1020 1029
        1200 1400 1401 1402 1403 1600 1601 1602 1603 1800 1801 1802 1803 1A00 1A01 1A02 1A03 6007 603F 6040 6041 605A
        605B 605C 605D 605E 6060 6061 6064 6065 6066 606C 6071 6072 6077 607A 607C 607D 607F 6081 6083 6084 6085 608F
        6091 6092 6098 6099 609A 60B0 60C2 60FF 6502"""
    od = eds.load_eds("puma260_joint", 1)
    assert [index for index in wanted.split() if int(index, 16) not in od] == []


@pytest.mark.parametrize(
    "index, sub, low, high",
    [
        (0x6060, 0, 0, 10),
        (0x1029, 1, 0, 2),
        (0x607A, 0, -(2**23), 2**23 - 1),
        (0x6071, 0, -2000, 2000),
        (0x60FF, 0, -10_000_000, 10_000_000),
        (0x605A, 0, 1, 6),
        (0x6007, 0, 0, 3),
    ],
)
def test_drive_limits(index, sub, low, high):
    entry = eds.load_eds("puma260_joint", 1)[index]
    var = entry[sub] if sub else entry
    assert (var.min, var.max) == (low, high)


@pytest.mark.parametrize("index", [0x1003, 0x1019, 0x1600, 0x1A00, 0x1400, 0x1800])
def test_entries_with_their_own_abort_codes_have_no_limits(index):
    """Conformance points 25, 29, 39, 42: else a generic limit check would answer 06090031h before them."""
    entry = eds.load_eds("puma260_joint", 1)[index]
    for var in entry.values() if hasattr(entry, "values") else (entry,):
        assert var.min is None and var.max is None


def test_sensor_sends_the_window_as_delivered():
    od = eds.load_eds("tactile_array", 16)
    entries = list(pdos(od, 0x1800))
    assert len(entries) == 33 and not list(pdos(od, 0x1400))
    for n, (_, record, words) in enumerate(entries):
        assert record[2].default == 2
        assert record[6].default == 0
        assert record[1].default == 0x511 + n + (0x80000000 if n > 8 else 0)
        assert len(words) == 1 and words[0] & 0xFF == 64
    assert entries[0][2] == [0x21200040]
    assert [words[0] for _, _, words in entries[1:9]] == [0x21100040 + (n << 8) for n in range(1, 9)]
    assert [words[0] for _, _, words in entries[9:]] == [0x21000040 + (n << 8) for n in range(9, 33)]


@pytest.mark.parametrize("index, count", [(0x2100, 32), (0x2110, 18), (0x2130, 2)])
def test_sensor_data_are_64_bit_entries(index, count):
    array = eds.load_eds("tactile_array", 16)[index]
    assert array[0].default == count
    assert {v.data_type for v in array.values() if v.subindex} == {datatypes.UNSIGNED64}


def test_sensor_image_names_follow_the_row_halves():
    image = eds.load_eds("tactile_array", 16)[0x2100]
    for row in range(16):
        assert image[2 * row + 1].name == f"Image row {row} columns 0 to 7"
        assert image[2 * row + 2].name == f"Image row {row} columns 8 to 15"


def test_sensor_tare_is_write_only():
    var = eds.load_eds("tactile_array", 16)[0x2003]
    assert var.writable and not var.readable


def test_real_nodes_differ_only_in_node_id_relative_entries(name):
    first, second = eds.load_eds(name, 1), eds.load_eds(name, 2)
    for a, b in zip(variables(first), variables(second), strict=True):
        assert (b.default == a.default) != getattr(a, "relative", False), hex(a.index)


# --- loading ------------------------------------------------------------------------------------------------------


def test_names_and_paths(tmp_path):
    assert set(NAMES) <= set(eds.eds_names())
    assert eds.eds_path("puma260_joint") == eds.eds_path("puma260_joint.eds")
    copy = tmp_path / "mine.eds"
    copy.write_bytes(eds.eds_path("tactile_array").read_bytes())
    assert eds.load_eds(copy, 9)[0x1014].default == 0x80 + 9
    assert eds.load_eds(str(copy), 9).node_id == 9


@pytest.mark.parametrize(
    "source, node_id, words",
    [
        ("puma260_joints", 1, ("puma260_joints", "did you mean puma260_joint?")),
        ("xyz", 1, ("xyz", "puma260_joint, tactile_array")),
        ("/nowhere/x.eds", 1, ("/nowhere/x.eds", "no such file")),
        ("puma260_joint", 0, ("node id 0", "1..127")),
        ("puma260_joint", 128, ("node id 128",)),
    ],
)
def test_what_cannot_be_loaded_is_named(source, node_id, words):
    with pytest.raises(EdsError) as caught:
        eds.load_eds(source, node_id)
    assert all(word in str(caught.value) for word in words)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "content, words",
    [
        (b"no section\n", "usable"),
        (b"", "no object"),
        (b"[DeviceInfo]\n", "no object"),
        (b"\xff\xfe\x00", "text"),
        (
            b"[DeviceInfo]\n[1018]\nObjectType=9\n[1018sub1]\nDataType=7\nDefaultValue=who\n",
            "line 6 [1018sub1] DefaultValue: 'who'",
        ),
        (
            b"[DeviceInfo]\n[1000sub1]\nParameterName=x\nDataType=0x7\nAccessType=ro\n",
            "[1000]: the standard has a variable",
        ),
        (
            b"[DeviceInfo]\n[1000]\nParameterName=x\nDataType=0x7\nAccessType=ro\nDefaultValue=many\n",
            "line 6 [1000] DefaultValue: 'many'",
        ),
    ],
)
def test_broken_files_raise_only_eds_errors_that_name_the_file(tmp_path, content, words):
    path = tmp_path / "broken.eds"
    path.write_bytes(content)
    with pytest.raises(EdsError) as caught:
        eds.load_eds(path, 1)
    assert str(path) in str(caught.value) and words in str(caught.value)
