"""Files as vendors ship them. Each file says itself what is wrong with the line below: `; expect: warning TEXT`."""

import gzip
import io
import random
import re
from pathlib import Path

import pytest
from canopen.objectdictionary.eds import import_eds

from canprobe.errors import EdsError
from canprobe.fieldbus import check_eds, eds_path, load_eds, make_eds_node

FOLDER = Path(__file__).parent / "messy"
FILES = sorted(FOLDER.iterdir())
UNSERVABLE = {"binary.eds", "broken.eds", "empty.eds", "half_utf16.eds"}
SERVABLE = [path for path in FILES if path.name not in UNSERVABLE]
NODE_ID = 5
EXPECT = re.compile(r"; expect(?P<whole> whole)?: (?P<level>warning|fault) (?P<text>.*)")

# file → (index, subindex): default, or None where the object has none
VALUES = {
    "miscounted.eds": {(0x1017, 0): 100, (0x2000, 0): 7, (0x2001, 0): 8},
    "nodeid_sums.eds": {
        (0x1014, 0): 0x85,
        (0x1400, 1): 0x205,
        (0x1401, 1): 0x80000305,
        (0x1800, 1): 0x185,
        (0x1801, 1): 0x80000285,
        (0x1802, 1): 0x80000385,
    },
    "forgotten_nodeid.eds": {
        (0x1014, 0): 0x85,
        (0x1200, 1): 0x605,
        (0x1200, 2): 0x585,
        (0x1400, 1): 0x205,
        (0x1800, 1): 0x80000185,
        (0x1802, 1): 0x3A5,  # not of the pre-defined set: as it stands
    },
    "compact.eds": {
        (0x1003, 0): 0,
        (0x1003, 4): None,
        (0x1A00, 0): 2,
        (0x1A00, 2): 0x20100308,
        (0x2010, 0): 3,
        (0x2010, 1): 9,
        (0x2010, 3): 0x21,
    },
    "numbers.eds": {
        (0x2001, 0): 1,
        (0x2002, 0): 0x1A,
        (0x2003, 0): 8,
        (0x2004, 0): 89,
        (0x2005, 0): 0x1A,
        (0x2006, 0): 1,
        (0x2007, 0): 1.5,
        (0x2008, 0): -1,
        (0x2009, 0): 0xFFFF,
        (0x200A, 0): None,
    },
    "latin1_crlf_no_end.eds": {(0x2000, 0): -5, (0x2001, 0): "°C µm"},
    "bom_comments.eds": {(0x1000, 0): 0x30191, (0x2000, 0): 3},
    "utf16.eds": {(0x1018, 1): 0x123},
    "bare.eds": {(0x1000, 0): 0, (0x1001, 0): None, (0x1018, 1): 0, (0x1800, 0): 3, (0x2000, 0): 0x1234},
    "duplicates.eds": {(0x1018, 1): 0x123, (0x2000, 0): 1, (0x20AB, 0): 4},
    "limits.eds": {(0x2001, 0): 50},
    "unreadable.eds": {
        **{(index, 0): None for index in range(0x2001, 0x2007)},
        (0x2007, 0): 0,
        (0x2008, 0): 0x1234,
        (0x2009, 0): 100,
        (0x200A, 0): 0x100,
        (0x200B, 0): 0x10000,
        (0x200C, 0): 0x185,
        (0x200D, 0): 0xFFFFFFFF,
    },
    "types.eds": {
        (0x1017, 0): 200,
        (0x2002, 0): 5,
        (0x2003, 0): 5,
        (0x2004, 0): None,
        (0x2005, 0): bytes.fromhex("deadbeef"),
        (0x2006, 0): "na",
        (0x2007, 0): -2.5,
        (0x2008, 0): 1e-3,
        (0x2009, 0): bytes((2, 1, 0, 0, 0, 0)),
        (0x200A, 0): b"serial",
        (0x200B, 0): 0x123456,
        (0x200C, 0): "",
        (0x200D, 0): None,
    },
    "configured.dcf": {(0x1014, 0): 0x85, (0x1017, 0): 0},
    "orphans.eds": {(0x2000, 0): 2, (0x2000, 2): 5, (0x2002, 1): 6, (0x2003, 0): 3},
    "stray_lines.eds": {(0x2000, 0): 1},
    "mappings.eds": {(0x1A02, 2): 0x20000008},
    "pdo_entries.eds": {
        (0x1005, 0): 0x80,
        (0x1014, 0): 0x85,
        (0x1800, 1): 0x185,
        (0x1804, 1): 0x80000000,
        (0x2003, 0): 0x010203040506.to_bytes(6, "little"),
    },
    "dummies.eds": {(0x1600, 1): 0x00040020},
    "no_statusword.eds": {(0x6040, 0): 0},
    "untold_drive.eds": {(0x1000, 0): 0x20192, (0x1018, 1): 0xFB, (0x1018, 2): 0x62100000, (0x1018, 3): None},
    "encoder406.eds": {(0x6040, 1): -5, (0x6041, 0): 0x12345678, (0x6060, 0): 70000, (0x6064, 0): "north"},
    "other_node.dcf": {(0x1014, 0): 0x85, (0x1200, 1): 0x605},
    "drive402.eds": {(0x1000, 0): 0x20192, (0x6081, 0): 4096, (0x6064, 0): None, (0x60C2, 2): -3},
}


def text_of(path):
    raw = path.read_bytes()
    return raw.decode("utf-16", "ignore") if raw[:2] == b"\xff\xfe" else raw.decode("latin-1")


def expectations(path):
    """(line, level, text) that a file announces."""
    found, waiting = [], []
    for number, line in enumerate(re.split("\r\n|\n", text_of(path)), start=1):
        if match := EXPECT.search(line):
            entry = match["level"], match["text"]
            found.append((0, *entry)) if match["whole"] else waiting.append(entry)
        else:
            found += [(number, *entry) for entry in waiting]
            waiting = []
    assert not waiting
    return found


def variables(od):
    for entry in od.values():
        yield from entry.values() if hasattr(entry, "values") else (entry,)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_what_is_wrong_is_told_with_its_line_and_nothing_else(path):
    reading = check_eds(path, NODE_ID)
    wanted = expectations(path)
    assert {level for _, level, _ in wanted} == (
        {"fault"} if path.name in UNSERVABLE else {"warning"} & {w[1] for w in wanted}
    )
    for fault in reading.found:
        level = "fault" if fault.prevents else "warning"
        match = next((w for w in wanted if w[:2] == (fault.line, level) and w[2] in str(fault)), None)
        assert match is not None, f"not expected: {level} {fault}"
        wanted.remove(match)
    assert wanted == []


@pytest.mark.parametrize("path", SERVABLE, ids=lambda path: path.name)
def test_values_are_what_the_file_means(path):
    od = check_eds(path, NODE_ID).usable()
    for (index, subindex), expected in VALUES[path.name].items():
        entry = od[index]
        variable = entry.subindices[subindex] if hasattr(entry, "subindices") else entry
        assert variable.default == expected, f"{index:04X}h:{subindex:02X}"
        assert type(variable.default) is type(expected)


@pytest.mark.parametrize("name", sorted(UNSERVABLE))
def test_what_cannot_be_served_is_an_error_with_every_fault(name):
    wanted = [text for _, level, text in expectations(FOLDER / name) if level == "fault"]
    with pytest.raises(EdsError) as caught:
        load_eds(FOLDER / name, NODE_ID)
    lines = str(caught.value).splitlines()
    assert len(lines) == len(wanted)
    assert all(line.startswith(f"{FOLDER / name}: not a usable EDS file: ") for line in lines)
    assert all(any(text in line for line in lines) for text in wanted)


def test_limits_names_rights_and_dummies():
    def var(name, index):
        return load_eds(FOLDER / name, NODE_ID)[index]

    limits = {index: (v.min, v.max) for index in range(0x2001, 0x2007) for v in [var("limits.eds", index)]}
    assert limits == {
        0x2001: (None, None),
        0x2002: (0, None),
        0x2003: (-(2**31), 2**31 - 1),
        0x2004: (None, None),
        0x2005: (-1.5, 1.5),
        0x2006: (None, 10),
    }
    assert [v.name for v in var("compact.eds", 0x2010).values()] == ["Number of entries", "Left", "Inputs_2", "Right"]
    assert [v.access_type for v in var("compact.eds", 0x1003).values()] == ["rw", "ro", "ro", "ro", "ro"]
    assert var("latin1_crlf_no_end.eds", 0x2000).name == "Fühler"
    assert var("bom_comments.eds", 0x2000).name == "Länge;Breite"
    assert var("bom_comments.eds", 0x1018)[1].name == "Vendor-ID"
    assert [index for index in load_eds(FOLDER / "dummies.eds", 1) if index < 8] == [2, 4]
    assert (var("types.eds", 0x2004).access_type, var("types.eds", 0x2004).data_type) == ("wo", 0xF)
    configured = var("configured.dcf", 0x1014), var("configured.dcf", 0x1017), var("configured.dcf", 0x1800)[1]
    assert [v.value for v in configured] == [0x321, 250, 0x80000185]


def test_a_master_takes_the_file_at_its_word_and_a_served_node_is_complete():
    """No object and no mappability that the file does not state; a conforming node needs 1000h and 1018h."""
    path = FOLDER / "drive402.eds"
    assert load_eds(path, NODE_ID)[0x6041].pdo_mappable is False
    assert check_eds(path, NODE_ID).dictionary[0x6041].pdo_mappable is True
    path = FOLDER / "bare.eds"
    assert not {0x1000, 0x1018} & set(load_eds(path, NODE_ID))
    assert {0x1000, 0x1018} <= set(check_eds(path, NODE_ID).dictionary)


def test_a_type_that_the_file_lacks_is_that_of_the_standard(tmp_path):
    """CiA 402-2: 60C2h:01 is UNSIGNED8, 607Fh UNSIGNED32, 605Ah INTEGER16; CiA 301: each sub-index 0 is UNSIGNED8."""
    path, text = tmp_path / "untyped.eds", eds_path("puma260_joint").read_text()
    for name in ("60C2sub0", "60C2sub1", "607F", "605A"):
        text = re.sub(rf"(\[{name}\][^\[]*?)DataType=\w+\n", r"\1", text)
    path.write_text(text)
    od = load_eds(path, 1)
    found = [od[0x60C2][0], od[0x60C2][1], od[0x607F], od[0x605A]]
    assert [(one.data_type, one.default) for one in found[:2]] == [(5, 2), (5, 25)]
    assert [one.data_type for one in found] == [5, 5, 7, 3]


def test_of_a_drive_with_several_axes_the_check_says_which_is_driven(tmp_path):
    """CiA 402-1: the objects of axis n are 800h · (n - 1) above those of the first."""
    path = tmp_path / "axes.eds"
    section = "\n[{:X}]\nParameterName=Controlword\nObjectType=7\nDataType=6\nAccessType=rw\n"
    path.write_text(eds_path("puma260_joint").read_text() + section.format(0x6840) + section.format(0x7040))
    said = [str(one) for one in check_eds(path).warnings]
    assert any("further axes (controlwords 6840h, 7040h); only the first is driven" in one for one in said)


@pytest.mark.parametrize("name", ["puma260_joint", "tactile_array"])
def test_our_own_files_are_clean_and_read_as_canopen_reads_them(name):
    """The other parser is the reference, attribute by attribute."""
    reading = check_eds(name, NODE_ID)
    assert reading.found == ()
    theirs = import_eds(io.StringIO(eds_path(name).read_text()), NODE_ID)
    ours = reading.dictionary
    assert list(ours) == list(theirs) and len(ours) > 80
    assert ours.comments == theirs.comments
    assert vars(ours.device_information) == vars(theirs.device_information)
    for mine, other in zip(variables(ours), variables(theirs), strict=True):
        differing = {key for key in vars(other) if key not in ("parent", "value_descriptions", "bit_definitions")}
        assert {key: getattr(mine, key, "absent") for key in differing} == {
            key: getattr(other, key) for key in differing
        }
    for index in ours:
        assert type(ours[index]) is type(theirs[index])
        assert ours[index].name == theirs[index].name


def upload(node, index, subindex, t_ns=0):
    """Value of an entry over SDO, or the abort code: expedited or segmented, by hand."""
    can_id = 0x600 + node.node_id
    head = index.to_bytes(2, "little") + bytes((subindex,))
    ((answered, answer),) = node.receive(can_id, b"\x40" + head + bytes(4), t_ns)
    assert answered == 0x580 + node.node_id
    if answer[0] == 0x80:
        return int.from_bytes(answer[4:], "little")
    if answer[0] & 2:
        return answer[4 : 8 - (answer[0] >> 2 & 3)]
    size, data, toggle = int.from_bytes(answer[4:], "little"), b"", 0
    while True:
        ((_, segment),) = node.receive(can_id, bytes((0x60 | toggle,)) + bytes(7), t_ns)
        data += segment[1 : 8 - (segment[0] >> 1 & 7)]
        toggle ^= 0x10
        if segment[0] & 1:
            assert len(data) == size
            return data


def expected_bytes(variable):
    value = variable.default if variable.value is None else variable.value
    if isinstance(value, bytes):
        return value
    if isinstance(value, str):
        return value.encode("utf-16-le" if variable.data_type == 0xB else "latin-1")
    if value is None:
        return None
    return variable.encode_raw(value)


LIVE = {0x1001, 0x1003, 0x6041, 0x6061, 0x6064, 0x6502, 0x607A}


@pytest.mark.parametrize("path", SERVABLE, ids=lambda path: path.name)
def test_every_value_is_served_over_sdo(path):
    """CiA 301, SDO upload: the bytes are those of canopen's own encoder."""
    od = check_eds(path, NODE_ID).usable()
    node = make_eds_node(od, NODE_ID)
    boot_up, *_ = node.start(0)
    assert boot_up == (0x705, b"\0")
    read = 0
    for variable in variables(od):
        if variable.index in LIVE:
            continue
        answer = upload(node, variable.index, variable.subindex)
        if not variable.readable:
            assert answer == 0x06010001
        elif (wanted := expected_bytes(variable)) is not None:
            assert answer == wanted, f"{variable.index:04X}h:{variable.subindex:02X}"
            read += 1
        else:
            assert not any(answer), "without a value in the file: zeros"
    assert read >= 3
    assert upload(node, 0x5FFF, 0) == 0x06020000


def test_booleans_are_bits_in_a_pdo_and_a_time_has_48():
    """Left is 1, right 0, the level 1234h behind them; TPDO2 and TPDO4, which do not fit, are empty."""
    node = make_eds_node(check_eds(FOLDER / "pdo_entries.eds", NODE_ID).usable(), NODE_ID)
    node.start(0)
    sent = dict(node.receive(0, bytes((1, NODE_ID)), 0))
    assert sent[0x185] == (1 | 0x1234 << 2).to_bytes(3, "little")
    assert sent[0x385] == 0x010203040506.to_bytes(6, "little")
    assert not {0x285, 0x485} & sent.keys()
    assert upload(node, 0x2000, 0) == b"\1" and upload(node, 0x2001, 0) == b"\0"
    sent = dict(node.receive(0x605, bytes.fromhex("2f01200001000000"), 0))
    assert sent[0x185] == (3 | 0x1234 << 2).to_bytes(3, "little"), "an event of one bit"


def test_a_boolean_may_be_mapped_as_a_bit_or_as_a_byte_and_as_nothing_else():
    node = make_eds_node(check_eds(FOLDER / "pdo_entries.eds", NODE_ID).usable(), NODE_ID)
    node.start(0)

    def write(text):
        ((_, answer),) = node.receive(0x605, bytes.fromhex(text), 0)
        return answer[0] == 0x60

    assert write("2300180185010080") and write("2f001a0000000000")
    assert [bits for bits in range(1, 33) if write(f"23001a01{bits:02x}000020")] == [1, 8]


@pytest.mark.parametrize(
    ("head", "told"),
    [
        (b"<?xml version='1.0'?><ISO15745ProfileContainer/>", "whole file: no object in it"),
        (b"\xef\xbb\xbf\r\n  <ISO15745ProfileContainer>", "line 2: not XML that can be read: no element found"),
        ("<?xml version='1.0'?>".encode("utf-16"), "line 1: not XML that can be read: no element found"),
        (gzip.compress(b"[FileInfo]", mtime=0), "compressed by gzip, not an EDS file; type: zcat < "),
        (b"PK\3\4....", "compressed by zip, not an EDS file; type: unzip -p "),
        (b"\xd4\xc3\xb2\xa1\2\0\4\0", "a capture of tcpdump or Wireshark (pcap), not an EDS file"),
    ],
)
def test_a_file_of_another_kind_is_named_as_what_it_is(head, told, tmp_path):
    path = tmp_path / "some device.eds"
    path.write_bytes(head)
    with pytest.raises(EdsError, match=re.escape(told)) as raised:
        load_eds(path, NODE_ID)
    assert len(str(raised.value).splitlines()) == 1
    if "type:" in told:
        assert f"'{path}' > device.eds" in str(raised.value)


def test_the_vendors_drive_moves_an_axis_of_its_own():
    """CiA 402: from a vendor's EDS alone to a motion in cyclic synchronous position, in raw frames."""
    node = make_eds_node(check_eds(FOLDER / "drive402.eds", NODE_ID).usable(), NODE_ID)
    t_ns = 0
    node.start(t_ns)
    node.receive(0, bytes((1, NODE_ID)), t_ns)

    def cycle(controlword, target):
        nonlocal t_ns
        t_ns += 10_000_000
        node.advance(t_ns)
        frames = node.receive(0x80, b"", t_ns)
        node.receive(0x205, controlword.to_bytes(2, "little") + target.to_bytes(4, "little", signed=True), t_ns)
        (data,) = [data for can_id, data in frames if can_id == 0x185]
        return int.from_bytes(data[:2], "little"), int.from_bytes(data[2:], "little", signed=True)

    for word in (6, 7, 15, 15):
        statusword, _ = cycle(word, 0)
    assert statusword & 0x6F == 0x27, "operation enabled"
    seen = [cycle(15, -1000 * n)[1] for n in range(1, 8)]
    assert seen == [0, 0, -1000, -2000, -3000, -4000, -5000], "latched at the next SYNC, there one period later"
    assert upload(node, 0x6061, 0, t_ns) == b"\x08"
    assert upload(node, 0x6502, 0, t_ns) == (1 << 7).to_bytes(4, "little"), "what the emulated drive can do"


def test_a_drive_that_is_known_by_its_objects_alone_is_served_as_one(tmp_path):
    """EDS files of EPOS2, PRBT, LWA4P and others give 1000h no default; some leave it out."""
    path = FOLDER / "untold_drive.eds"
    assert check_eds(path, NODE_ID).profile == 402
    without = tmp_path / "without.eds"
    without.write_text(re.sub(r"(?s)\[1000\].*?(?=\[1001\])", "", path.read_text()).replace("1=0x1000\n", ""))
    for file in (path, without):
        node = make_eds_node(check_eds(file, NODE_ID).usable(), NODE_ID)
        node.start(0)
        assert upload(node, 0x1000, 0) == (0x20192).to_bytes(4, "little")
        assert int.from_bytes(upload(node, 0x6041, 0), "little") & 0x4F == 0x40, "switch on disabled"
        node.receive(0x605, bytes.fromhex("2b40600006000000"), 0)
        assert int.from_bytes(upload(node, 0x6041, 0), "little") & 0x6F == 0x21, "ready to switch on"


def test_device_info_gives_the_identity_that_1018h_leaves_open():
    path = FOLDER / "untold_drive.eds"
    node = make_eds_node(check_eds(path, NODE_ID).usable(), NODE_ID, eds=path)
    assert node.lss.address.numbers == (0xFB, 0x62100000, 0, 0)


def test_identity_that_is_not_described_is_served_as_device_info_has_it(tmp_path):
    path = tmp_path / "bare.eds"
    path.write_text("[DeviceInfo]\nVendorNumber=7\nProductNumber=8\nRevisionNumber=9\n[1001]\nDataType=5\n")
    node = make_eds_node(check_eds(path, NODE_ID).usable(), NODE_ID)
    node.start(0)
    assert [upload(node, 0x1018, sub)[0] for sub in range(4)] == [3, 7, 8, 9]


@pytest.mark.parametrize("node_id", [5, 7, 9])
def test_a_configuration_of_another_node_leaves_no_node_deaf(node_id):
    """What the pre-defined connection set gives to node 7 is given to the node that is asked for; the rest stays."""
    for od in (load_eds(FOLDER / "other_node.dcf", node_id), check_eds(FOLDER / "other_node.dcf", node_id).usable()):
        node = make_eds_node(od, node_id)
        node.start(0)
        cob_ids = {(0x1014, 0): 0x80, (0x1400, 1): 0x200, (0x1800, 1): 0xC0000180, (0x1801, 1): 0x280}
        for (index, subindex), base in cob_ids.items():
            assert upload(node, index, subindex) == (base + node_id).to_bytes(4, "little")
        assert upload(node, 0x1401, 1) == (0x183).to_bytes(4, "little"), "what it hears of node 3"


@pytest.mark.parametrize("name", ["compact.eds", "no_statusword.eds"])
def test_a_device_of_another_profile_is_no_drive(name):
    """Nor one that lacks the state machine: a controlword has no effect there, and nothing breaks."""
    node = make_eds_node(check_eds(FOLDER / name, NODE_ID).usable(), NODE_ID)
    node.start(0)
    node.receive(0, bytes((1, 0)), 0)
    node.receive(0x605, bytes.fromhex("2b40600006000000"), 0)
    assert upload(node, 0x6041, 0) == 0x06020000
    assert upload(node, 0x1001, 0) == b"\0", "no error"


def damaged(data, rng):
    """A file with a few lines lost, doubled, swapped or garbled."""
    lines = data.split(b"\n")
    for _ in range(rng.randrange(1, 8)):
        at, other = rng.randrange(len(lines)), rng.randrange(len(lines))
        kind = rng.randrange(5)
        if kind == 0:
            del lines[at : at + rng.randrange(1, 4)]
            lines.append(b"")
        elif kind == 1:
            lines.insert(other, lines[at])
        elif kind == 2:
            lines[at], lines[other] = lines[other], lines[at]
        elif kind == 3:
            lines[at] = lines[at].partition(b"=")[0] + b"=" + lines[other].partition(b"=")[2]
        else:
            line = bytearray(lines[at] or b"[")
            line[rng.randrange(len(line))] = rng.randrange(256)
            lines[at] = bytes(line)
    return b"\n".join(lines)


@pytest.mark.parametrize("name", ["drive402.eds", "types.eds", "compact.eds", "dummies.eds"])
def test_whatever_the_file_reading_never_raises_and_what_is_served_answers(name, tmp_path):
    path, served = tmp_path / "damaged.eds", 0
    for seed in range(60):
        path.write_bytes(damaged((FOLDER / name).read_bytes(), random.Random(f"{name} {seed}")))
        reading = check_eds(path, NODE_ID)
        assert all(str(fault) and "\n" not in str(fault) for fault in reading.found), seed
        if reading.faults:
            continue
        served += 1
        node = make_eds_node(reading.dictionary, NODE_ID)
        node.start(0)
        node.receive(0, bytes((1, 0)), 0)
        for counter in range(1, 4):
            node.receive(0x205, bytes(6), counter)
            node.receive(0x80, b"", counter)
        for variable in variables(reading.dictionary):
            if variable.index > 7:
                node.receive(
                    0x605, b"\x40" + variable.index.to_bytes(2, "little") + bytes((variable.subindex,)) + bytes(4), 9
                )
        node.receive(0, bytes((130, 0)), 10)
    assert served >= 10, "else this proves little"
