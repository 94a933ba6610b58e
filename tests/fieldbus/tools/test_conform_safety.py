"""What the examination sends to a device that is not ours, and that it leaves the device as it was."""

from __future__ import annotations

import json
import random

import pytest
from defects import rewrites
from examined import NODE_ID, eds_device, failed

from canprobe.errors import NodeError, UsageError
from canprobe.fieldbus.bus.virtual.lockstep import Participant
from canprobe.fieldbus.protocol.frames import RTR_FLAG, is_restricted
from canprobe.fieldbus.tools.conform import POINTS, ExaminationSettings, WriteList, restore_snapshot
from canprobe.fieldbus.tools.conform.outcome import NotPermitted
from canprobe.fieldbus.tools.conform.permits import Permits
from canprobe.fieldbus.tools.conform.surroundings import Surroundings
from canprobe.fieldbus.tools.reports import Verdict

MS = 1_000_000
SDO = 0x600 + NODE_ID
# Written out from the table of what may be written, not from the code.
NEVER = {0x1010, 0x1011, 0x1013, *range(0x1021, 0x1027), *range(0x1280, 0x1400), *range(0x1F00, 0x2000)}
MAY_CHANGE = {0x1006, 0x1007, 0x100C, 0x100D, 0x1015, 0x1016, 0x1017, 0x1019, 0x1028, 0x1029, *range(0x1400, 0x1C00)}
SAME_ONLY = {0x1000, 0x1001, 0x1002, 0x1008, 0x1009, 0x100A, 0x1018, 0x1020, 0x1027}


def downloads(sent):
    """(index, subindex, value or None) of every write that was begun."""
    for can_id, data in sent:
        if can_id == SDO and len(data) == 8 and (data[0] >> 5 == 1 or (data[0] >> 5 == 6 and not data[0] & 1)):
            size = 4 - (data[0] >> 2 & 3) if data[0] & 1 else 4
            expedited = data[0] >> 5 == 1 and data[0] & 2
            yield data[1] | data[2] << 8, data[3], data[4 : 4 + size] if expedited else None


class Talker(Participant):
    """Sends a frame every 10 ms, as another machine does; it is told from our device by its frames alone."""

    def __init__(self, can_id, data=b""):
        self.frame, self.due_ns, self.heard = (can_id, data), 10 * MS, []

    @property
    def next_deadline_ns(self):
        return self.due_ns

    def receive(self, can_id, data, t_ns):
        self.heard.append((can_id, data))
        return ()

    def advance(self, t_ns):
        self.due_ns = t_ns + 10 * MS
        return [self.frame]


@pytest.mark.parametrize("eds", ["puma260_joint", "tactile_array", "prbt_joint"])
@pytest.mark.parametrize("described", [True, False])
def test_it_writes_what_may_be_written_and_leaves_the_device_as_it_was(eds, described):
    device = eds_device(eds, described=described)
    before, application = device.values, {k: v for k, v in device.node.dictionary.values.items() if k >> 8 >= 0x2000}
    report = device.run()
    assert failed(report) == {}
    wrong = []
    for index, subindex, value in downloads(device.port.sent):
        old = before.get(index << 8 | subindex)
        same = (
            value is None
            or old is None
            or value == (old if isinstance(old, bytes) else old.to_bytes(len(value), "little"))
        )
        if index == 0x1003:
            fine = value != b"\0"
        elif index in (0x1005, 0x1012, 0x1014):  # or a restricted identifier, which must be refused
            fine = same or is_restricted(int.from_bytes(value, "little") & 0x7FF)
        else:
            fine = index in MAY_CHANGE or (same and (index in SAME_ONLY or 0x1200 <= index < 0x1280))
        if not fine:
            wrong.append((hex(index), subindex, value))
    assert wrong == []
    assert not {index for index, _, _ in downloads(device.port.sent)} & NEVER
    commands = {data for can_id, data in device.port.sent if can_id == 0 and len(data) == 2}
    assert {data[1] for data in commands} == {NODE_ID} and 0x81 not in {data[0] for data in commands}
    after = {k: v for k, v in device.node.dictionary.values.items() if k >> 8 >= 0x2000}
    assert (device.values, after) == (before, application)


def test_all_that_can_be_permitted_is_put_back_too():
    device = eds_device()
    before = dict(device.node.dictionary.values)
    settings = ExaminationSettings(written=WriteList.parse("2000h-5FFFh,6065h-6067h,607Dh,60C2h,reset"), motion=True)
    assert failed(device.run(settings)) == {}
    ignored = {0x1001, 0x1003, 0x6040, 0x6041}
    differing = {hex(k) for k, v in device.node.dictionary.values.items() if v != before[k] and k >> 8 not in ignored}
    assert differing == set()


@pytest.mark.parametrize("seed", range(3))
def test_ctrl_c_anywhere_puts_back_what_was_written(seed):
    device = eds_device()
    before = device.values
    at = random.Random(seed).randrange(300, 3500)

    def strike(count):
        if count == at:
            device.port.before = lambda count: None
            raise KeyboardInterrupt

    device.port.before = strike
    with pytest.raises(KeyboardInterrupt):
        device.run()
    assert device.values == before


def test_a_bus_off_is_outlasted_and_the_rest_is_examined():
    device = eds_device()
    before = device.values

    def fail(count):
        if count == 1000:
            device.port.off_until_ns = device.port.clock.now_ns() + 2_000 * MS

    device.port.before = fail
    report = device.run()
    assert device.values == before
    assert report.counts()[Verdict.ERROR] == 1 and report.rows[-1].verdict is Verdict.PASS


def test_a_snapshot_is_on_disk_before_the_first_write_and_restores(tmp_path):
    path = tmp_path / "snapshot.json"
    device, off = eds_device(), []
    before = device.values

    def check(count):
        if any(True for _ in downloads(device.port.sent[-1:])):
            assert path.exists()
        if count > 1500 and device.port.sent[-1][1].hex() == "2b17100032000000" and not off:
            off.append(count)  # it falls silent in the middle of a point
            device.bus.detach(device.node)

    device.port.before = check
    last = device.run(ExaminationSettings(snapshot=path)).rows[-1]
    assert last.name == "put back" and f"--restore {path} --node 5" in last.detail
    device.node.dictionary.values[0x101700] = 1234
    device.bus.attach(device.node)
    device.node.dictionary.values[0x101700] = 1234
    device.port.before = lambda count: None
    assert "1017h:00: restored to 00 00" in restore_snapshot(device.port, NODE_ID, path)
    assert device.values == before
    with pytest.raises(UsageError, match="cut off"):
        device.run(ExaminationSettings(snapshot=path))
    other = eds_device("tactile_array")
    with pytest.raises(NodeError, match="the snapshot is of 0xca5e:0x260"):
        restore_snapshot(other.port, NODE_ID, path)
    path.write_text(json.dumps({"kind": "another"}))
    with pytest.raises(UsageError, match="another kind of file"):
        restore_snapshot(device.port, NODE_ID, path)


def test_a_snapshot_goes_when_all_is_put_back_unless_it_was_asked_for(tmp_path):
    points = [point for point in POINTS if point.number == 8]
    for keep in (False, True):
        path = tmp_path / "snapshot.json"
        eds_device().run(ExaminationSettings(snapshot=path, keep_snapshot=keep), points)
        assert path.exists() is keep


def test_a_power_stage_that_is_on_ends_it_before_anything_is_written():
    device = eds_device()
    device.port.before(0)
    for word in (6, 7, 15):
        device.port.send_batch([(SDO, bytes.fromhex(f"2b406000{word:02x}000000"))])
    device.port.sent.clear()
    report = device.run()
    assert {row.verdict for row in report.rows} == {Verdict.ERROR}
    assert "OPERATION_ENABLED" in report.rows[0].detail
    assert list(downloads(device.port.sent)) == []
    assert 0 not in {can_id for can_id, _ in device.port.sent}  # no NMT command to an axis that may hang on its motor


def test_power_that_comes_on_in_between_ends_it_without_another_command():
    device = eds_device()

    def switch_on(count):
        if count == 1200:
            device.port.before = lambda count: None
            device.node.receive(0, b"\x80\x05", device.port.clock.now_ns())
            for word in (6, 7, 15):
                device.node.receive(SDO, bytes.fromhex(f"2b406000{word:02x}000000"), device.port.clock.now_ns())

    device.port.before = switch_on
    report = device.run()
    at = next(n for n, row in enumerate(report.rows) if row.verdict is Verdict.ERROR)
    assert "OPERATION_ENABLED" in report.rows[at].detail
    assert {row.verdict for row in report.rows[at:]} == {Verdict.ERROR}
    assert device.node.dictionary.number(0x6041) & 0x6F == 0x27  # as whoever switched it on wants it


@pytest.mark.parametrize(
    ("frame", "never"),
    [
        ((0x80, b""), {0x80, 0x7E5}),
        ((0x000, b"\x01\x09"), {0x00, 0x80, 0x7E5}),
        ((0x609, bytes.fromhex("4000100000000000")), {0x00, 0x80, 0x7E5}),
        ((0x709, b"\x05"), {0x709, 0x7E5}),
        ((0x189, b"1234"), {0x7E5}),
    ],
    ids=["SYNC", "NMT", "SDO client", "heartbeat", "PDO"],
)
def test_beside_others_it_leaves_out_what_could_disturb_them(frame, never):
    talker = Talker(*frame)
    device = eds_device(others=[talker])
    report = device.run()
    assert failed(report) == {}
    ids = {can_id & ~RTR_FLAG for can_id, _ in device.port.sent}
    assert not ids & never
    assert not {can_id for can_id in ids if can_id > 0x7FF or 0x060 <= can_id < 0x080}  # 29 bits, background load
    assert any("alone" in why for _, why in report.left_out)
    assert {row.verdict for row in report.rows if row.group == "lss"} == {Verdict.NOT_APPLICABLE}
    assert ("warning" in report.facts) is (frame[0] in (0x000, 0x609))  # who commands may also watch its heartbeat


def test_tpdos_that_others_ask_for_are_compared_without_a_command():
    """Another master has started the device, and sends SYNC: its TPDOs were heard before the first point."""
    short = rewrites(0x185, "", lambda text: text[:-2])
    device = eds_device(others=[Talker(0x000, b"\x01\x05"), Talker(0x80, b"")], wrap=short)
    assert failed(device.run()) == {"pdo 83 heard lengths": "TPDO 185h (1800h) has 7 bytes, its mapping 8"}
    assert not {0x000, 0x080} & {can_id for can_id, _ in device.port.sent}


def test_it_does_not_begin_beside_another_client_of_the_device():
    device = eds_device(others=[Talker(SDO, bytes.fromhex("4000100000000000"))])
    with pytest.raises(NodeError, match="another master"):
        device.run()
    assert device.port.sent == []


ALONE = Surroundings()
REFUSED = {
    "NMT to all": (0x000, "0100"),
    "NMT to another": (0x000, "0106"),
    "reset node": (0x000, "8105"),
    "save": (SDO, "2310100173617665"),
    "wrong signature": (SDO, "2310100100000000"),
    "program": (SDO, "2f511f0101000000"),
    "self starting": (SDO, "23801f0000000000"),
    "history": (SDO, "2f03100000000000"),
    "EMCY off": (SDO, "2314100085000080"),
    "1005h producer": (SDO, "2305100080000040"),
    "controlword": (SDO, "2b4060000f000000"),
    "the same mode": (SDO, "2f60600000000000"),
    "segmented to 6040h": (SDO, "2140600002000000"),
    "block to 1F50h": (SDO, "c2501f0104000000"),
    "SDO to another": (0x606, "4000100000000000"),
    "heartbeat of the device": (0x705, "05"),
    "its RPDO": (0x205, "0f00"),
    "TIME": (0x100, "000000000000"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_the_gate(name):
    permits = Permits(NODE_ID, ALONE, WriteList())
    permits.values = {(0x1014, 0): b"\x85\0\0\0", (0x1005, 0): b"\x80\0\0\0", (0x6060, 0): b"\0"}
    permits.rpdo_ids = {0x205}
    can_id, text = REFUSED[name]
    with pytest.raises(NotPermitted):
        permits.check(can_id, bytes.fromhex(text))


def test_a_write_list_refuses_what_is_never_written_and_what_it_does_not_know():
    parsed = WriteList.parse("2000h-20FFh, 6081h ,60C2h:01,history")
    assert [parsed.permits(at) for at in ((0x2080, 3), (0x6081, 0), (0x60C2, 1), (0x60C2, 2))] == [True] * 3 + [False]
    for text in ("1010h", "1F00h-2000h", "speed", "60C2h:1FF"):
        with pytest.raises(UsageError, match="--write"):
            WriteList.parse(text)
