"""Stored parameters in a file: what comes back, what is refused, what happens when it cannot be written."""

from __future__ import annotations

import json

import pytest

from canprobe.errors import UsageError
from canprobe.fieldbus.node.stored_file import keep_in_file

SAVE = 0x65766173


@pytest.fixture
def path(tmp_path):
    return tmp_path / "nodes" / "node005.json"


@pytest.fixture
def stored(make_bench, path):
    """A node that has stored a number, a negative one, a float and a domain."""
    bench = make_bench()
    keep_in_file(bench.node, path)
    bench.node.start(0)
    assert bench.write(0x2000, 0, 77, 1) == 0
    assert bench.write(0x2002, 0, -77, 2) == 0
    assert bench.ask("2306200000004840")[:2] == "60"  # 3.125
    bench.ask("2104200007000000")
    bench.ask("0100ff8010203040")
    assert bench.write(0x1010, 1, SAVE, 4) == 0
    return bench


def test_every_kind_of_value_comes_back(stored, make_bench, path):
    other = make_bench()
    keep_in_file(other.node, path)
    other.node.start(0)
    values = other.node.dictionary.values
    assert [values[key] for key in (0x200000, 0x200200, 0x200600, 0x200400)] == [
        *(77, -77, 3.125, bytes.fromhex("00ff8010203040"))
    ]
    assert values == stored.node.dictionary.values


def test_nothing_is_written_before_the_first_save(make_bench, path):
    bench = make_bench()
    keep_in_file(bench.node, path)
    bench.node.start(0)
    bench.write(0x2000, 0, 77, 1)
    assert not path.exists()


def change(path, **values):
    content = json.loads(path.read_text())
    content["values"] |= {key.replace("_", ":"): value for key, value in values.items()}
    path.write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        ({"9999_00": 1}, "9999h:00: the EDS of node 5 has no such object"),
        ({"2000_00": 101}, "2000h:00: 101 is no value of it"),
        ({"2000_00": 300}, "2000h:00: 300 is no value of it"),
        ({"2002_00": 1.5}, "2002h:00: 1.5 is no value of it: another data type"),
        ({"2002_00": {"hex": "0102"}}, "another data type"),
        ({"2004_00": 5}, "2004h:00: 5 is no value of it"),
        ({"2000_00": True}, "expected a number or hex"),
        ({"2004_00": {"hex": "xy"}}, "no stored parameters"),
    ],
)
def test_a_file_with_wrong_values_is_refused(stored, make_bench, path, broken, words):
    change(path, **broken)
    with pytest.raises(UsageError, match=r"node005\.json") as caught:
        keep_in_file(make_bench().node, path)
    assert words in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"identity": 1, "values": 2, "device": ""}', "\x00"])
def test_a_file_that_is_none_is_refused(make_bench, tmp_path, text):
    path = tmp_path / "node.json"
    path.write_text(text)
    with pytest.raises(UsageError, match=r"node\.json: no stored parameters"):
        keep_in_file(make_bench().node, path)


def test_a_file_of_another_device_is_refused(stored, make_bench, path):
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"identity": [1, 2, 3]}))
    with pytest.raises(UsageError, match=r"stored by the device \[1, 2, 3\], node 5 is \[51806, 0, 65536\]"):
        keep_in_file(make_bench().node, path)


def test_a_write_that_fails_aborts_and_keeps_what_was_stored(stored, path):
    path.with_name(f".part-{path.name}").mkdir()  # in the way
    before = path.read_text()
    stored.write(0x2000, 0, 33, 1)
    assert stored.write(0x1010, 1, SAVE, 4) == 0x06060000
    assert path.read_text() == before
    stored.nmt(0x81)
    assert stored.read(0x2000) == 77
