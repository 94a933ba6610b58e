"""Drives of other makes in one cell, each as its EDS describes it: planned, brought up, enabled, moved, left.

The EDS files are of `makes`. All of them can have a period of 3 ms: whole milliseconds, and tenths of them.
"""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from makes import MAKES, Entry, changed, pdo, without, word, write_eds
from scenes import change, reasons

import canprobe
from canprobe.cell.master.controller import Command
from canprobe.cell.master.options import RunOptions
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.node_configuration import Interpolation
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.session import Session
from canprobe.errors import NodeError
from canprobe.fieldbus.bus.candump import read_candump
from canprobe.fieldbus.protocol.cia402 import DriveState, OperationMode

RATE_HZ = 333.333
SWING = np.radians((3, -3, 3, 3, -3, 3))
IP, CSP = OperationMode.INTERPOLATED_POSITION, OperationMode.CYCLIC_SYNC_POSITION
PP = OperationMode.PROFILE_POSITION
MOVING = {name: CSP for name in MAKES} | {"interpolated": IP, "no_cyclic_mode": PP}


def scene_of(make, folder):
    """Six drives of a make, by its name or changed."""
    eds = {"eds": str(write_eds(make, folder))}
    return change(canprobe.load_scene("free"), arm=eds, cycle={"rate_hz": RATE_HZ}, outputs={"figures": False})


def moved(plan, folder, *, at_cycles=80):
    """Bring a cell up and move its joints: what was said, how far each joint came (rad), the frames on the bus."""
    said, q = [], []

    def controller(measurement):
        q.append(measurement.q)
        k = len(q)
        return Command(q[0] + SWING * min(1.0, k / 50), done=k > at_cycles)

    with Session(plan, RunOptions(folder, said.append)) as session:
        session.run(controller)
    assert session.cell.notes.lines() == []
    return said, q[-1] - q[0], [(can_id, data) for _, _, can_id, data in read_candump(folder / "bus.log")]


@pytest.mark.parametrize(
    "makes", [tuple(name for name, mode in MOVING.items() if mode is CSP), ("interpolated",), ("no_cyclic_mode",)]
)
def test_a_cell_of_several_makes_moves_and_is_left_disabled(tmp_path, makes):
    setup = resolve(scene_of(makes[0], tmp_path))
    eds = [str(write_eds(makes[i % len(makes)], tmp_path)) for i in range(6)]
    drives = [replace(drive, eds=file) for drive, file in zip(setup.arm.drives, eds, strict=True)]
    plan = make_plan(setup.changed("arm", drives=tuple(drives)))
    assert len({node.eds for node in plan.nodes}) == len(makes)
    assert {node.mode for node in plan.nodes} == {MOVING[make] for make in makes}
    said, way, frames = moved(plan, tmp_path / "run")
    assert way == pytest.approx(SWING, abs=np.radians(0.2))
    left = [line for line in said if "left as the device has it" in line and "by its EDS" not in line]
    assert left == [], "all was foreseen"
    assert_first_targets_are_positions(plan, frames)
    for node_id in plan.node_ids:
        (feedback,) = plan.pdos_of(node_id, "tpdo")
        last = [data for can_id, data in frames if can_id == feedback.cob_id][-1]
        assert feedback.layout.unpack(last)[0] & 0x6F == DriveState.SWITCH_ON_DISABLED.value


def test_a_fixed_mapping_with_booleans_is_read_bit_by_bit(tmp_path):
    """BOOLEANs of one bit between statusword and position: all behind them lies across the bytes."""
    make = MAKES["fixed_mapping"]()
    objects = dict(make.objects)
    objects |= {(0x2010, n): Entry(f"Switch {n}", "BOOL", "ro", n % 2, mappable=True) for n in range(1, 4)}
    objects[0x2010, 0] = Entry("Highest sub-index supported", "U8", "ro", 3)
    without(objects, 0x1802, 0x1A02)
    switches = [word(0x2010, n, 1) for n in (1, 2, 3)]
    objects |= pdo("tpdo", 3, (word(0x6041, 0, 16), *switches, word(0x6064, 0, 32)), fixed=True)
    plan = canprobe.plan(scene_of(replace(make, name="switches", objects=objects), tmp_path))
    _, way, frames = moved(plan, tmp_path / "run")
    assert way == pytest.approx(SWING, abs=np.radians(0.2))
    (feedback,) = plan.pdos_of(1, "tpdo")
    assert feedback.layout.length == 7
    data = [data for can_id, data in frames if can_id == feedback.cob_id][-1]
    assert feedback.layout.unpack(data)[1:4] == (1, 0, 1)


def assert_first_targets_are_positions(plan, frames):
    """Of each drive: its first RPDO has the position of its first TPDO, whatever 607Ah holds as delivered."""
    for node in plan.nodes:
        (feedback,), (commands,) = plan.pdos_of(node.node_id, "tpdo"), plan.pdos_of(node.node_id, "rpdo")
        reports = next(data for can_id, data in frames if can_id == feedback.cob_id)
        orders = [commands.layout.unpack(data) for can_id, data in frames if can_id == commands.cob_id]
        assert orders[0][:2] == (0, feedback.layout.unpack(reports)[1])
        enabling = next(order for order in orders if order[0] & 0x0F == 0x0F)
        assert enabling[1] == orders[0][1]
        bits = {order[0] & 0x10 for order in orders if order[0] & 0x0F == 0x0F}
        assert (0x10 in bits) == (node.mode is not CSP)


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        ("milliseconds_only", [Interpolation(3, -3)]),
        ("bare", [Interpolation(3, -3), Interpolation(30, -4)]),
        ("fixed_mapping", [Interpolation(30, -4)]),
    ],
)
def test_the_period_as_each_make_expresses_it(tmp_path, make, expected):
    assert list(canprobe.plan(scene_of(make, tmp_path)).nodes[0].interpolation) == expected


def test_a_rate_that_a_make_cannot_express_is_refused_with_the_nearest_that_all_can(tmp_path):
    scene = change(scene_of("milliseconds_only", tmp_path), cycle={"rate_hz": 400.0})
    (problem,) = reasons(scene)
    assert problem.startswith("cycle.rate_hz = 400: a SYNC period of 2500 µs cannot be set (")
    assert problem.endswith("60C2h takes 1 to 100 · 10^-3 s); take 333.333 or 500 Hz")
    assert canprobe.plan(change(scene, cycle={"rate_hz": 333.333})).sync.period_ns == 3_000_000


def test_a_make_without_a_mode_for_targets_is_refused_with_the_modes_that_it_has(tmp_path):
    objects = dict(MAKES["no_cyclic_mode"]().objects)
    changed(objects, 0x6502, default=0x24)
    make = replace(MAKES["no_cyclic_mode"](), objects=objects)
    modes = next(problem for problem in reasons(scene_of(make, tmp_path)) if "6502h" in problem)
    assert "profile velocity (3), homing (6); needed: cyclic synchronous position (8), or interpolated" in modes
    assert modes.endswith("or profile position (1) for motions by hand")


def test_profile_position_holds_no_contact_and_the_plan_says_what_goes(tmp_path):
    path = write_eds("no_cyclic_mode", tmp_path)
    (problem,) = reasons(change(canprobe.load_scene("press"), arm={"eds": str(path)}))
    assert problem.startswith(f"{path}: its modes (6502h) are profile position (1), profile velocity (3), homing")
    assert 'too slow for task.kind = "press"; needed: cyclic synchronous position (8)' in problem
    assert problem.endswith("`canprobe console CELL`, `move CELL` and `home CELL` go by profile position")


def test_profile_position_that_would_stop_late_is_refused(tmp_path):
    """6084h of a drive is fixed; without the object the drive decelerates by 6083h."""
    objects = dict(MAKES["no_cyclic_mode"]().objects)
    changed(objects, 0x6084, access="ro", default=100)
    make = replace(MAKES["no_cyclic_mode"](), objects=objects)
    refusal = r"6084h:00 = \d+ \(profile position within the limits of \[joints\]\) is needed: it is ro, 100"
    assert re.search(refusal, "\n".join(reasons(scene_of(make, tmp_path))))
    without(objects, 0x6084)
    assert canprobe.plan(scene_of(make, tmp_path)).nodes[0].mode is PP


def test_profile_position_is_bounded_by_the_limits_whatever_else_a_fixed_pdo_writes(tmp_path):
    """607Ah and 6081h share an RPDO of PRBT drives: the default of the file would take the limit away in each cycle."""
    objects = dict(MAKES["no_cyclic_mode"]().objects)
    without(objects, 0x1006, *(base + number for base in (0x1400, 0x1600) for number in range(4)))
    objects |= pdo("rpdo", 1, (word(0x6040, 0, 16),), fixed=True)
    objects |= pdo("rpdo", 2, (word(0x607A, 0, 32), word(0x6081, 0, 32)), fixed=True)
    make = replace(MAKES["no_cyclic_mode"](), name="speed", objects=objects)
    plan = canprobe.plan(change(scene_of(make, tmp_path), arm={"grouped_rpdo": True}))  # neither 60C2h nor 1006h
    model, (_, target) = plan.setup.arm.model, plan.pdos_of(1, "rpdo")
    speed, rate = (int(model.units_per_q[0, 0] * most[0]) for most in (model.qd_max, model.qdd_max))
    assert dict(target.constants) == {(0x6081, 0): speed}
    writes = {write.index: write.value for write in plan.nodes[0].writes}
    assert (writes[0x6060], writes[0x6081], writes[0x6083], writes[0x6084]) == (1, speed, rate, rate)
    assert "two targets in one RPDO" in dict(plan.not_available)
    assert any("go by profile position" in warning for warning in plan.warnings)
    assert np.allclose(moved(plan, tmp_path / "run", at_cycles=300)[1], SWING, atol=np.radians(0.02))


def test_what_a_bare_drive_lacks_is_listed_with_the_consequence(tmp_path):
    rows = {what: why.partition(": ")[2] for what, why in canprobe.plan(scene_of("bare", tmp_path)).not_available}
    assert rows["the node notices a dead master (1016h:01)"] == (
        "no such object: the device will not notice a dead master"
    )
    assert {what[-9:-1] for what in rows} == {
        "1016h:01", "1029h:01", "2000h:00", "6065h:00", "6066h:00", "607Fh:00", "607Dh:01", "607Dh:02", "605Ah:00",
        "6007h:00",
    }  # fmt: skip


def test_a_lost_master_and_a_start_by_itself_are_settled_where_the_device_can(tmp_path):
    """1029h:01 = 0, pre-operational; bit 2 of 1F80h, the other bits as the device has them."""
    make = MAKES["milliseconds_only"]()
    make.objects[0x1F80, 0] = Entry("NMT startup", "U32", "rw", 8)
    make.objects[0x1029, 0] = Entry("Highest sub-index supported", "U8", "ro", 1)
    make.objects[0x1029, 1] = Entry("Communication error", "U8", "rw", 1)
    plan = canprobe.plan(scene_of(make, tmp_path))
    written = {write.index: write.value for write in plan.nodes[0].writes}
    assert (written[0x1029], written[0x1F80]) == (0, 12)
    changed(make.objects, 0x1F80, access="ro")
    changed(make.objects, 0x1029, 1, low=1, high=2)
    plan = canprobe.plan(scene_of(make, tmp_path))
    assert not {0x1029, 0x1F80} & {write.index for write in plan.nodes[0].writes}
    lacks = {what[-9:-1]: why for what, why in plan.not_available}
    assert "it is ro, 8: the device may become operational before it is configured" in lacks["1F80h:00"]
    assert "it takes 1 to 2: it goes pre-operational" in lacks["1029h:01"]


def told_of_other_values(make, folder, values):
    """What bring-up says where the second drive has other values than its file says."""
    said = []
    session = Session(canprobe.plan(scene_of(make, folder)), RunOptions(say=said.append))
    for place, value in values.items():
        session.buses.world.nodes[1].dictionary.set_default(*place, value)
    with session:
        return said


def test_a_device_whose_polarity_was_turned_is_refused(tmp_path):
    make = MAKES["milliseconds_only"]()
    make.objects[0x607E, 0] = Entry("Polarity", "U8", "rw", 0)
    told = r"\(joint 2\) 607Eh:00 expected 0, as its EDS says, got 128: it would count the other way round"
    with pytest.raises(NodeError, match=told):
        told_of_other_values(make, tmp_path, {(0x607E, 0): 0x80})


GEAR = list(canprobe.load_scene("free").joints.values())[1].gear
BY_JOINT = {(0x6091, 1): round(1000 * GEAR), (0x6091, 2): 1000, (0x6092, 1): round(1000 * GEAR)}
"""Of a device that takes the joint for its shaft: 6091h is the joint's gear, and 6092h its turn."""


@pytest.mark.parametrize(
    ("factors", "values", "told"),
    [
        ({0x6092: (1000, 1), 0x6091: (1, 1)}, BY_JOINT, []),
        ({0x608F: (1000, 1)}, {(0x608F, 2): 2}, ["counts 500 units a motor turn by its 608Fh, the cell 1000"]),
    ],
)
def test_a_device_that_counts_otherwise_than_the_cell_says_is_told(tmp_path, factors, values, told):
    make = MAKES["milliseconds_only"]()
    for index, parts in factors.items():
        make.objects[index, 0] = Entry("Highest sub-index supported", "U8", "ro", 2)
        for subindex, part in enumerate(parts, start=1):
            make.objects[index, subindex] = Entry(f"Part {subindex}", "U32", "rw", part)
    lines = [line for line in told_of_other_values(make, tmp_path, values) if "units a motor turn" in line]
    assert len(lines) == len(told)
    assert all("node 2: (joint 2)" in line and words in line for line, words in zip(lines, told, strict=True))


def test_fixed_mappings_are_used_as_they_are(tmp_path):
    plan = canprobe.plan(scene_of("fixed_mapping", tmp_path))
    feedback, commands = plan.pdos_of(2, "tpdo"), plan.pdos_of(2, "rpdo")
    assert [(pdo.number, pdo.cob_id, pdo.transmission_type) for pdo in feedback] == [(3, 0x382, 1)]
    assert [(pdo.number, pdo.cob_id) for pdo in commands] == [(3, 0x402)]
    (besides,) = [pdo for pdo in plan.pdos if pdo.node_id == 2 and not pdo.used]
    assert (besides.number, besides.cob_id, besides.rate_hz) == (1, 0x182, 10)
    assert "TPDO1 switched off" in dict(plan.not_available)


@pytest.mark.parametrize(
    ("cell", "quirk", "told"),
    [
        (
            "puma260",
            {"tpdo_delay_us": 1000.0},
            r"node \d: its TPDO comes [12]\.\d\d ms behind the SYNC, .* until 1\.\d\d ms",
        ),
        (
            "seven-axis",
            {"fixed_mapping": True},
            r"node 1: .*1A00h:00 = 0x2 failed: .*; it holds 0x3: if it is fixed, say so",
        ),
    ],
)
def test_what_only_the_device_tells_is_said_with_what_there_is(tmp_path, cell, quirk, told):
    scene = change(canprobe.load_scene("press", {"cell": cell}), emulate=quirk, outputs={"figures": False})
    with pytest.raises(NodeError, match=told), Session(scene, RunOptions(tmp_path)) as session:
        session.run(lambda _: Command(done=True))


# What a make may have besides: values that the drives do not take, PDOs with more in them, or with less.


def variant(change_objects, base="late_target"):
    """A make with other objects."""
    make = MAKES[base]()
    change_objects(make.objects)
    return replace(make, name="variant")


@pytest.mark.parametrize(
    ("place", "values", "why"),
    [
        ((0x605A, 0), {"access": "ro", "default": 6}, "it is ro, 6"),
        ((0x605A, 0), {"low": 5, "high": 6}, "it takes 5 to 6"),
        ((0x605A, 0), {"access": "ro", "default": 2}, None),
        ((0x6066, 0), {"access": "const", "default": 10}, "it is const, 10"),
        ((0x607F, 0), {"high": 100}, "it takes at most 100"),
        ((0x1016, 1), {"access": "ro"}, "it is ro, 0"),
    ],
)
def test_a_wished_value_that_the_eds_excludes_is_left_out(tmp_path, place, values, why):
    make = variant(lambda objects: changed(objects, *place, **values))
    plan = canprobe.plan(scene_of(make, tmp_path))
    rows = [text.split(": ")[1] for what, text in plan.not_available if f"{place[0]:04X}h" in what]
    assert rows == ([why] if why else [])


@pytest.mark.parametrize(
    ("place", "values", "told"),
    [
        ((0x1017, 0), {"access": "const", "default": 0}, "1017h:00 = 100 .* is needed: it is const, 0"),
        ((0x1017, 0), {"high": 50}, "1017h:00 = 100 .* is needed: it takes at most 50"),
    ],
)
def test_a_required_value_that_the_eds_excludes_is_refused_with_what_there_is(tmp_path, place, values, told):
    make = variant(lambda objects: changed(objects, *place, **values))
    (problem,) = reasons(scene_of(make, tmp_path))
    assert re.search(told, problem)


def fixed_pdos(*layouts):
    """Exactly these PDOs, with fixed mappings."""

    def change_objects(objects):
        for number in range(1, 9):
            without(objects, *(base + number - 1 for base in (0x1400, 0x1600, 0x1800, 0x1A00)))
        for direction, number, words in layouts:
            objects |= pdo(direction, number, words, fixed=True)

    return variant(change_objects)


W, T, S, P = word(0x6040, 0, 16), word(0x607A, 0, 32), word(0x6041, 0, 16), word(0x6064, 0, 32)
SPEED, MODE, ACTUAL_SPEED = word(0x6081, 0, 32), word(0x6060, 0, 8), word(0x606C, 0, 32)


def test_controlword_and_target_in_different_fixed_pdos_and_more_in_them(tmp_path):
    make = fixed_pdos(
        ("rpdo", 1, (W, MODE)), ("rpdo", 2, (SPEED, T)), ("tpdo", 1, (S,)), ("tpdo", 2, (ACTUAL_SPEED, P))
    )
    plan = canprobe.plan(change(scene_of(make, tmp_path), cycle={"rate_hz": 200.0}))
    assert [pdo.number for pdo in plan.pdos_of(1, "tpdo")] == [1, 2]
    assert {pdo.number: pdo.constants for pdo in plan.pdos_of(1, "rpdo")} == {
        1: (((0x6060, 0), 8),),
        2: (((0x6081, 0), 100_000),),
    }
    _, way, frames = moved(plan, tmp_path / "run")
    assert way == pytest.approx(SWING, abs=np.radians(0.2))
    assert {data[2] for can_id, data in frames if can_id == 0x201} == {8}
    assert {data[:4] for can_id, data in frames if can_id == 0x301} == {(100_000).to_bytes(4, "little")}


def test_the_pdo_that_carries_nothing_else_is_preferred(tmp_path):
    make = fixed_pdos(("rpdo", 1, (W, T, MODE)), ("rpdo", 2, (W, T)), ("tpdo", 1, (S, P)), ("tpdo", 2, (S, P)))
    plan = canprobe.plan(scene_of(make, tmp_path))
    assert [pdo.number for pdo in (*plan.pdos_of(1, "rpdo"), *plan.pdos_of(1, "tpdo"))] == [2, 1]
    assert [(pdo.number, pdo.rate_hz) for pdo in plan.pdos if pdo.node_id == 1 and not pdo.used] == [
        (2, pytest.approx(1000 / 3))
    ]


def test_a_fixed_pdo_whose_other_values_have_no_safe_default_is_refused(tmp_path):
    make = fixed_pdos(("tpdo", 1, (S, P)))
    make.objects[0x60FF, 0] = Entry("Target velocity", "I32", "rw", "", mappable=True)
    make.objects.update(pdo("rpdo", 1, (W, word(0x60FF, 0, 32)), fixed=True) | pdo("rpdo", 2, (T,), fixed=True))
    (problem,) = reasons(scene_of(make, tmp_path))
    assert problem.startswith("nodes 1, 2, 3, 4, 5, 6: ")
    assert "RPDO1 also writes 60FFh:00, whose EDS entry has no default" in problem


def test_no_pdo_with_what_is_needed_is_refused_with_what_they_carry(tmp_path):
    make = fixed_pdos(("rpdo", 1, (W,)), ("tpdo", 1, (S, P)))
    assert "RPDO1 has the fixed mapping 60400010h; needed: 6040h:00, 607Ah:00" in reasons(scene_of(make, tmp_path))[0]


def test_a_pdo_that_follows_no_sync_is_not_used(tmp_path):
    make = variant(lambda objects: changed(objects, 0x1800, 2, access="ro", default=255))
    plan = canprobe.plan(scene_of(make, tmp_path))
    assert [(pdo.number, pdo.cob_id) for pdo in plan.pdos_of(3, "tpdo")] == [(2, 0x183)]


def test_bits_29_and_30_are_written_as_the_eds_has_them(tmp_path):
    plan = canprobe.plan(scene_of("tpdo_without_rtr", tmp_path))
    writes = {(w.index, w.subindex): w.value for w in plan.nodes[2].writes}
    assert writes[0x1800, 1] == 0x4000_0183 and writes[0x1801, 1] == 0xC000_0283 and writes[0x1400, 1] == 0x203


RPM = 0x00B44700


def speed_limited(most, unit=RPM, **values):
    """607Fh in the unit of 60A9h."""

    def change_objects(objects):
        objects[0x60A9, 0] = Entry("SI unit velocity", "U32", "ro", unit)
        changed(objects, 0x607F, default=most, **values)

    return variant(change_objects)


def test_a_limit_of_speed_is_written_in_the_unit_of_the_drive(tmp_path):
    """Joint 1 of the PUMA 260: all its speed in counts a second, and 60 / 1000 of that in turns a minute."""
    plans = [canprobe.plan(scene_of(speed_limited(1300, unit), tmp_path)) for unit in (RPM, 0)]
    rpm, counts = (next(w.value for w in plan.nodes[0].writes if w.index == 0x607F) for plan in plans)
    assert 0.0 <= rpm - counts * 60 / 1000 <= 1.0


def test_joints_keep_within_a_limit_of_speed_that_stands_in_the_drive(tmp_path):
    plan = canprobe.plan(scene_of(speed_limited(1300, access="ro"), tmp_path))
    model = plan.setup.arm.model
    fastest = np.abs(model.units_per_q[:4]) @ model.qd_max
    assert fastest.max() == pytest.approx(1300 * 1000 / 60 - 2 * plan.sync.rate_hz)
    assert "607Fh: drives that fault below the speeds of their joints" in plan.warnings[0]


def test_a_limit_of_speed_below_the_rounding_of_targets_is_refused(tmp_path):
    problems = reasons(scene_of(speed_limited(10, access="ro"), tmp_path))
    assert re.match(r"joints\.joint_1: drive 1 allows 166\.7 units/s by its 607Fh", problems[0])


def test_a_drive_without_an_object_for_it_waits_for_arm_missed_syncs(tmp_path):
    scene = change(scene_of("milliseconds_only", tmp_path), arm={"missed_syncs": 40})
    drive = Session(canprobe.plan(scene)).buses.world.nodes[0].application
    assert drive.parts.parameters.misses == 40
