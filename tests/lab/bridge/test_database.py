"""DBC and KCD by cantools: read back, and used to decode a real run."""

import sys

import cantools
import numpy as np
import pytest
from puma_arm import MODELS

import canprobe
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.lab.bridge.database import FORMATS, identifier, plan_database, write_database


@pytest.fixture(params=FORMATS)
def read_back(request, press_plan, tmp_path):
    return cantools.database.load_file(write_database(press_plan, tmp_path, request.param))


def test_every_pdo_of_the_plan_is_there_with_its_entries(read_back, press_plan):
    for pdo in press_plan.pdos:
        message = read_back.get_message_by_frame_id(pdo.cob_id)
        assert message.length == pdo.layout.length
        assert sum(signal.length for signal in message.signals) == sum(entry.bits for entry in pdo.layout.signals)
        assert all(signal.byte_order == "little_endian" for signal in message.signals)


def test_a_run_decodes_to_what_it_logged(read_back, free_run):
    """Positions of the drives' own frames, through cantools, are the joint angles that the cell logged."""
    folder, result = free_run
    counts = {node: [] for node in range(1, 7)}
    for _, _, can_id, data in read_candump(folder / "bus.log"):
        if 0x181 <= can_id <= 0x186:
            counts[can_id - 0x180].append(read_back.decode_message(can_id, data)["Position_actual_value"])
    motors = np.array([counts[node][-100:-50] for node in range(1, 7)], float)
    q = np.linalg.solve(MODELS["puma260"].units_per_q, motors).T
    logged = result.log["q_rad"]
    assert any(np.allclose(logged[i : i + 50], q, atol=1e-9) for i in range(len(logged) - 49))


def test_tactile_header_and_taxels_decode_as_the_cell_reads_them(read_back, listen_run):
    folder, _ = listen_run
    counters, modes, taxels = [], set(), set()
    for _, _, can_id, data in read_candump(folder / "bus.log"):
        if can_id == 0x511:
            header = read_back.decode_message(can_id, data)
            counters.append(header["frame_counter"])
            modes.add(header["mode"])
            assert (header["origin_row"] << 4 | header["origin_col"]) == data[2]
        elif can_id == 0x513:
            row = read_back.decode_message(can_id, data)
            taxels |= set(row)
            assert bytes(row[f"taxel_{8 + i}"] for i in range(8)) == data
    assert modes == {1} and taxels == {f"taxel_{i}" for i in range(8, 16)}
    assert set(np.diff(counters) % 256) == {1}


def test_grouped_targets_are_one_message_with_two_signals(tmp_path):
    plan = canprobe.plan("free", {"arm.grouped_rpdo": True})
    database = cantools.database.load_file(write_database(plan, tmp_path, "dbc"))
    message = database.get_message_by_frame_id(0x303)
    first, second = message.signals
    assert (first.name, first.start, second.name, second.start) == (
        "Target_position_joint_3", 0, "Target_position_joint_4", 32,
    )  # fmt: skip
    assert message.encode({first.name: -1, second.name: 2}) == b"\xff\xff\xff\xff\x02\0\0\0"


def test_identifiers():
    assert [identifier(text) for text in ("a b-c", "2nd", "µ", "")] == ["a_b_c", "_2nd", "signal", "signal"]


@pytest.mark.parametrize("scene", ["cylinder", "listen"])
def test_names_are_unique_and_no_bit_is_used_twice(scene):
    frames = plan_database(canprobe.plan(scene)).messages
    assert len({frame.name for frame in frames}) == len({frame.frame_id for frame in frames}) == len(frames)
    for frame in frames:
        bits = [bit for signal in frame.signals for bit in range(signal.start, signal.start + signal.length)]
        assert len(bits) == len(set(bits)) and max(bits) < 8 * frame.length
        assert len({signal.name for signal in frame.signals}) == len(frame.signals)


def test_a_missing_extra_names_the_line_that_installs_it(monkeypatch, press_plan, tmp_path):
    for name in [name for name in sys.modules if name.split(".")[0] == "cantools"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "cantools", None)
    with pytest.raises(UsageError, match=r"needs cantools; type: pip install .*\[can\]'"):
        write_database(press_plan, tmp_path, "dbc")


def test_long_pdos_are_messages_of_can_fd(tmp_path):
    plan = canprobe.plan("listen", {"sensor.mode": "image", "sensor.eds": "tactile_array_fd.eds", "bus.fd": True})
    database = cantools.database.load_file(write_database(plan, tmp_path, "dbc"))
    message = database.get_message_by_frame_id(0x513)
    assert (message.length, message.is_fd, len(message.signals)) == (64, True, 64)
    assert not database.get_message_by_frame_id(0x511).is_fd
    data = bytes(range(64))
    assert message.decode(data) == {f"taxel_{64 + i}": i for i in range(64)}
