"""Typed entries against what the files say, read by another parser."""

import configparser
from pathlib import Path

import pytest
from canopen.objectdictionary.eds import import_eds

from canprobe.fieldbus import Description, eds_path, load_eds

MESSY = Path(__file__).parent / "messy"


def described(name, node_id=5):
    return Description(load_eds(MESSY / name if "." in name else name, node_id))


@pytest.mark.parametrize("name", ["puma260_joint", "tactile_array", "tactile_array_fd"])
def test_every_entry_is_what_its_section_says(name):
    parser = configparser.RawConfigParser(strict=True, comment_prefixes=(";",))
    parser.read_string(eds_path(name).read_text(encoding="ascii"))
    device, seen = described(name), 0
    theirs = import_eds(str(eds_path(name)), 5)
    for title in parser.sections():
        head, _, sub = title.partition("sub")
        if not (len(head) == 4 and set(head) <= set("0123456789ABCDEF") and "datatype" in parser[title]):
            continue
        section, entry = parser[title], device.entry(int(head, 16), int(sub or "0", 16))
        assert (entry.name, entry.access) == (section["parametername"], section["accesstype"])
        assert (entry.data_type, entry.mappable) == (int(section["datatype"], 0), section["pdomapping"] == "1")
        limits = [int(section[key], 0) if key in section else None for key in ("lowlimit", "highlimit")]
        assert [entry.low, entry.high] == limits
        variable = theirs.get_variable(entry.index, entry.subindex)
        assert entry.default == variable.default and entry.configured is None
        assert (entry.readable, entry.writable) == (variable.readable, variable.writable)
        assert entry.bits == (0 if isinstance(entry.default, str) else len(variable))
        assert not isinstance(entry.default, int) or entry.allows(entry.default)
        seen += 1
    assert seen == sum(entry.index > 7 for entry in device.entries()) > 100


def test_what_is_not_described_is_none():
    device = described("puma260_joint")
    assert device.entry(0x6040) is not None and device.entry(0x6040, 1) is None
    assert device.entry(0x5FFF) is None and device.entry(0x1018, 200) is None


def test_directions_of_mapping_follow_access_and_pdo_mapping():
    device = described("puma260_joint")
    ways = {index: (device.entry(index).in_rpdo, device.entry(index).in_tpdo) for index in (0x6040, 0x6041, 0x1017)}
    assert ways == {0x6040: (True, False), 0x6041: (False, True), 0x1017: (False, False)}
    assert device.dummies == {index for index in range(1, 8) if device.entry(index) is not None}
    assert device.dummies and all(device.entry(index).in_rpdo for index in device.dummies)
    assert not any(device.entry(index).in_tpdo for index in device.dummies)


def test_limits_of_the_file_and_of_the_type():
    mode, target = (described("puma260_joint").entry(index) for index in (0x6060, 0x607A))
    assert [mode.allows(value) for value in (-1, 0, 10, 11)] == [False, True, True, False]
    assert (target.low, target.high) == (-(2**23), 2**23 - 1) and not target.allows(2**23)
    word = described("puma260_joint").entry(0x6040)
    assert (word.low, word.high, word.bits, word.signed) == (None, None, 16, False)
    assert word.allows(0xFFFF) and not word.allows(0x10000) and not word.allows(-1)


def test_a_configuration_file_has_values_besides_defaults():
    entry = described("configured.dcf").entry(0x1017)
    assert (entry.default, entry.configured, entry.initial) == (0, 250, 250)
    assert described("puma260_joint").entry(0x1014).initial == 0x85


def test_an_array_that_describes_its_first_member_only(tmp_path):
    """Sub-index 0 counts the members, the first one stands for all, its PDOMapping too."""
    path = tmp_path / "array.eds"
    path.write_text(
        "[DeviceInfo]\n[2000]\nParameterName=A\nObjectType=8\nSubNumber=2\n"
        "[2000sub0]\nParameterName=n\nDataType=5\nAccessType=ro\nDefaultValue=3\n"
        "[2000sub1]\nParameterName=x\nDataType=6\nAccessType=rw\nPDOMapping=1\n"
    )
    device = Description(load_eds(path, 1))
    assert [device.entry(0x2000, n) is not None for n in range(5)] == [True, True, True, True, False]
    assert device.entry(0x2000, 3).bits == 16 and device.entry(0x2000, 3).in_rpdo


def test_pdos_modes_and_features():
    device = described("puma260_joint")
    assert device.rpdos == device.tpdos == (1, 2, 3, 4)
    assert device.modes == {1, 6, 8, 9, 10}  # PP, homing, CSP, CSV, CST
    assert 1_000_000 in device.bitrates
    read = device.od.device_information
    info = configparser.RawConfigParser()
    info.read_string(eds_path("puma260_joint").read_text(encoding="ascii"))
    stated = info["DeviceInfo"]["SimpleBootUpSlave"], info["DeviceInfo"]["SimpleBootUpMaster"]
    assert (str(int(read.simple_boot_up_slave)), str(int(read.simple_boot_up_master))) == stated
    bare = described("bare.eds")
    assert (bare.modes, bare.rpdos, bare.bitrates) == (None, (), ())
