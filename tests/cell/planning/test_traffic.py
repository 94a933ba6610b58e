"""The bus part of a plan against the budget table of the cell, and what does not fit."""

import dataclasses
import re

import pytest
from makes import write_eds
from scenes import change, reasons, refused, ways_out, with_eds, with_joints, without_torque

import canprobe
from canprobe.cell.planning.identifiers import identifier_problems
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.measured import expected_messages
from canprobe.cell.planning.model import PlannedPdo
from canprobe.cell.planning.node_configuration import Interpolation
from canprobe.cell.planning.traffic import controller_starts
from canprobe.cell.scene.load import dump_scene, load_scene, parse_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.fieldbus.protocol.pdo import PdoEntry, PdoLayout


@pytest.fixture(scope="module")
def press():
    return load_scene("press")


@pytest.fixture(scope="module")
def press_plan(press):
    return canprobe.plan(press)


# Independent truth: 55 + 10 n bits a frame, counted by hand from the mapping table; shares of 1 Mbit/s.
SYNC, DRIVE_TPDO, DRIVE_RPDO, FULL, CONTROLWORD = 65, 135, 115, 135, 75


@pytest.mark.parametrize(
    ("name", "sections", "part", "bits_per_second", "percent"),
    [
        ("free", {}, ("SYNC", "drives"), 400 * (SYNC + 6 * (DRIVE_TPDO + DRIVE_RPDO)), 63),
        (
            "free",
            {"arm": {"grouped_rpdo": True}},
            ("SYNC", "drives"),
            400 * (SYNC + 6 * DRIVE_TPDO + 3 * FULL) + 10 * 6 * CONTROLWORD,
            51.65,
        ),
        ("listen", {"sensor": {"mode": "image"}}, ("tactile",), 200 * 33 * FULL, 89),
        ("listen", {}, ("tactile",), 200 * 9 * FULL, 24),
        ("listen", {"sensor": {"mode": "features"}}, ("tactile",), 200 * 2 * FULL, 5.4),
        ("cylinder", {}, ("SYNC", "drives", "tactile"), 626_000 + 243_000, 87),
    ],
)
def test_budget_table(name, sections, part, bits_per_second, percent):
    plan = canprobe.plan(change(load_scene(name), **sections))
    load = sum(share for what, share in plan.traffic.parts if what in part)
    assert load == pytest.approx(bits_per_second / 1e6)
    assert 100 * load == pytest.approx(percent, abs=0.5)
    heartbeats = 10 * 65 * (len(plan.nodes) + 1) / 1e6
    assert plan.traffic.load == pytest.approx(sum(share for _, share in plan.traffic.parts), abs=1e-6)
    assert dict(plan.traffic.parts)["heartbeats"] == pytest.approx(heartbeats)


def test_image_beside_the_drives_is_refused_with_numbers_and_ways_out(press):
    error = refused(change(press, sensor={"mode": "image"}))
    assert any("worst-case load 152 %" in problem for problem in error.problems)
    assert any("7585 µs of the 5000 µs in 2 cycles" in problem for problem in error.problems)
    assert error.ways_out == (
        'sensor.mode = "window": load 87 %, peak 4345 of 5000 µs',
        'sensor.mode = "features": load 69 %, peak 3400 of 5000 µs',
        'a separate bus for the sensor (sensor.channel = "can1"): load 92 %, peak 4585 of 5000 µs',
        'CAN FD: bus.fd = true and sensor.eds = "tactile_array_fd.eds": load 79 %, peak 3937 of 5000 µs',
        "cycle.rate_hz = 250 with sensor.rate_hz = 125: load 95 %, peak 7585 of 8000 µs",
    ), "grouping alone does not make it fit and must not be named"
    assert str(error).splitlines()[-1] == f"  {error.ways_out[-1]}"


def test_ways_out_written_into_the_scene_file_make_it_fit(press):
    """As a user would: what a way out names goes into the file, nothing else."""
    follow_ways_out(change(press, sensor={"mode": "image"}))


def follow_ways_out(scene):
    """Write each way out into the file, plan that, and return what the ways out name."""
    texts = []
    for way in ways_out(scene):
        text, numbers = way.rsplit(": ", 1)
        texts.append(text)
        file = dump_scene(scene)
        for section, key, value in re.findall(r'(\w+(?:\.\w+)?)\.(\w+) = ("[^"]*"|[\w.]+)', text):
            head, name, tail = file.partition(f"[{section}]\n")
            mine, mark, rest = tail.partition("\n[")
            mine = re.sub(rf"^{key} = .*\n?", "", mine, count=1, flags=re.M)
            file = f"{head}{name}{key} = {value}\n{mine}{mark}{rest}"
        for key in re.findall(r"without sensor\.(\w+)", text):
            file = re.sub(rf"^{key} = .*\n", "", file, count=1, flags=re.M)
        plan = canprobe.plan(parse_scene(file))
        assert f"load {100 * max(bus.load for bus in plan.buses):.0f} %" in numbers, way
        assert ("without 6077h" in numbers) == (scene.arm.torque and not plan.setup.arm.torque), way
    return texts


def eight_drives():
    scene = load_scene("cylinder", {"cell": "seven-axis"})
    joints = {**scene.joints, "joint_8": dataclasses.replace(scene.joints["joint_7"], node_id=8)}
    return dataclasses.replace(scene, joints=joints)


@pytest.mark.slow(reason="plans of a large cell, for every way out")
def test_eight_drives_with_an_array_need_a_second_bus_or_a_third_of_a_kilohertz():
    texts = follow_ways_out(eight_drives())
    assert "cycle.rate_hz = 333.333 with sensor.rate_hz = 166.667" in texts
    half = " and ".join(f'joints.joint_{n}.channel = "can1"' for n in (5, 6, 7, 8))
    assert f"a second bus for half of the drives ({half})" in texts


def test_average_below_one_but_peak_too_high_is_refused(press, monkeypatch):
    """At 50 Hz the image takes 85 % on average, yet a frame is not through before its deadline of two cycles.

    The search for ways out, which takes a quarter of a minute at this rate, is tried elsewhere.
    """
    monkeypatch.setattr("canprobe.cell.planning.make.suggested_changes", lambda *_: [])
    problems = reasons(change(press, sensor={"mode": "image", "rate_hz": 50.0}))
    assert not any("load" in problem for problem in problems)
    assert any("7585 µs of the 5000 µs" in problem for problem in problems)


def test_slower_bus_is_refused_and_the_faster_one_named(press):
    assert ways_out(change(press, bus={"bitrate": 500_000}))[0].startswith("bus.bitrate = 1000000: ")


def test_six_drives_alone_end_at_500_hz():
    """At 625 Hz 1565 of 1600 µs would do for the bus, but the controller needs its time between TPDOs and RPDOs."""
    free = load_scene("free")
    assert canprobe.plan(change(free, cycle={"rate_hz": 500.0})).traffic.load < 0.8
    error = refused(change(free, cycle={"rate_hz": 625.0}))
    (problem,) = error.problems
    assert "takes 200 µs (cycle.compute_us)" in problem and "behind the next SYNC" in problem
    assert error.ways_out[-1].startswith("cycle.rate_hz = 500: ")
    assert any("worst-case load" in problem for problem in reasons(change(free, cycle={"rate_hz": 1000.0})))


@pytest.mark.parametrize(("rate", "period_us", "units"), [(400, 2500, 25), (40, 25_000, 250)])
def test_sync_period(rate, period_us, units):
    plan = canprobe.plan(change(load_scene("free"), cycle={"rate_hz": float(rate)}))
    sync = plan.sync
    assert (sync.period_us, sync.period_ns, sync.overflow) == (period_us, period_us * 1000, 240)
    assert {node.interpolation[0] for node in plan.nodes} == {Interpolation(units, -4)}, "as the device has it"


@pytest.mark.parametrize("rate", [333.333, 1000 / 3])
def test_a_rate_with_six_digits_is_the_rate_of_a_whole_period(rate):
    assert canprobe.plan(change(load_scene("free"), cycle={"rate_hz": rate})).sync.period_ns == 3_000_000


@pytest.mark.parametrize(("rate", "near"), [(300.0, "294.118 or 303.03"), (30.0, "29.4118 or 30.303")])
def test_a_period_that_60c2h_cannot_hold(rate, near):
    """334 and 333 · 10⁻⁵ s would be nearer, but a value has one byte."""
    (problem,) = reasons(change(load_scene("free"), cycle={"rate_hz": rate}))
    assert near in problem


def test_sync_period_of_a_sensor_alone_needs_only_whole_microseconds():
    scene = change(load_scene("listen"), cycle={"rate_hz": 320.0}, sensor={"rate_hz": 160.0})
    assert canprobe.plan(scene).sync.period_us == 3125
    (problem,) = reasons(change(scene, cycle={"rate_hz": 300.0}, sensor={"rate_hz": 150.0}))
    assert "1006h counts µs" in problem


def test_a_period_too_long_for_60c2h():
    (problem,) = reasons(change(load_scene("free"), cycle={"rate_hz": 3.0}))
    assert "60C2h takes 1 to 255 · 10^-6 or -5 or -4 or -3 s" in problem and problem.endswith("take 3.92157 Hz")


@pytest.mark.parametrize("rate", [300.0, 400 / 7])
def test_tactile_rate_that_no_trigger_gives(press, rate):
    problems = reasons(change(press, sensor={"rate_hz": rate}))
    assert [problem for problem in problems if "sensor.rate_hz" in problem.split("=")[0]]


@pytest.mark.parametrize("ratio", [1, 2, 3, 240])
def test_tactile_trigger(ratio):
    plan = canprobe.plan(change(load_scene("listen"), sensor={"rate_hz": 400 / ratio}))
    assert {pdo.transmission_type for pdo in plan.pdos} == {ratio}
    assert 240 % ratio == 0
    assert {pdo.deadline_ns for pdo in plan.pdos} == {min(2, ratio) * 2_500_000}


def test_identifiers_and_mappings_of_the_default_cell(press_plan):
    found = {pdo.cob_id: [(e.index, e.subindex, e.bits) for e in pdo.entries] for pdo in press_plan.pdos}
    tpdo = [(0x6041, 0, 16), (0x6064, 0, 32), (0x6077, 0, 16)]
    rpdo = [(0x6040, 0, 16), (0x607A, 0, 32)]
    window = {0x511: [(0x2120, 0, 64)]} | {0x511 + row: [(0x2110, row, 64)] for row in range(1, 9)}
    drives = {0x180 + i: tpdo for i in range(1, 7)} | {0x200 + i: rpdo for i in range(1, 7)}
    assert found == drives | window
    assert [pdo.cob_id for pdo in press_plan.pdos] == sorted(found)
    signed = {(e.index, e.signed) for pdo in press_plan.pdos for e in pdo.entries if e.index >= 0x6000}
    assert signed == {(0x6041, False), (0x6040, False), (0x6064, True), (0x607A, True), (0x6077, True)}


@pytest.mark.parametrize(
    ("mode", "last", "first_object"), [("image", 0x531, (0x2120, 0)), ("features", 0x512, (0x2130, 1))]
)
def test_identifiers_of_other_modes(mode, last, first_object):
    pdos = canprobe.plan(change(load_scene("listen"), sensor={"mode": mode})).pdos
    assert [pdo.cob_id for pdo in pdos] == list(range(0x511, last + 1))
    assert (pdos[0].entries[0].index, pdos[0].entries[0].subindex) == first_object


def test_grouped_targets_share_an_rpdo_through_dummies():
    plan = canprobe.plan(change(load_scene("free"), arm={"grouped_rpdo": True}))
    shared = {(pdo.node_id, pdo.cob_id): [e.index for e in pdo.entries] for pdo in plan.pdos if pdo.number == 2}
    assert shared == {
        (1, 0x301): [0x607A, 4], (2, 0x301): [4, 0x607A], (3, 0x303): [0x607A, 4],
        (4, 0x303): [4, 0x607A], (5, 0x305): [0x607A, 4], (6, 0x305): [4, 0x607A],
    }  # fmt: skip
    words = [pdo for pdo in plan.pdos if pdo.direction == "rpdo" and pdo.number == 1]
    assert {(pdo.transmission_type, pdo.event_timer_ms, pdo.rate_hz, pdo.layout.length) for pdo in words} == {
        (255, 250, 10, 2)
    }


def test_nodes_with_identity_and_what_is_switched_off(press_plan):
    assert press_plan.node_ids == (1, 2, 3, 4, 5, 6, 16)
    joint, sensor = press_plan.nodes[0], press_plan.nodes[-1]
    assert (joint.kind, joint.name, joint.emulated) == ("drive", "joint 1", True)
    assert (joint.identity.vendor_id, joint.identity.product_code) == (0xCA5E, 0x260)
    assert (sensor.kind, sensor.identity.product_code) == ("tactile", 0x1616)
    assert ("rpdo", 2) in joint.switched_off
    assert ("tpdo", 1) not in joint.switched_off
    assert [number for direction, number in sensor.switched_off if direction == "tpdo"] == list(range(10, 34))


def test_frames_that_may_be_on_the_bus(press_plan):
    ids = set(expected_messages(press_plan, press_plan.buses[0]))
    assert {0x000, 0x080, 0x081, 0x090, 0x181, 0x206, 0x519, 0x590, 0x610, 0x701, 0x710, 0x77F} <= ids
    assert not {0x100, 0x187, 0x190, 0x301, 0x510, 0x51A, 0x711} & ids


def test_order_of_node_ids_is_the_order_of_joints():
    plan = canprobe.plan(with_joints(load_scene("free"), node_id=(16, 5, 4, 3, 2, 1)))
    assert {node.node_id: node.name for node in plan.nodes}[16] == "joint 1"
    assert plan.node_ids == (1, 2, 3, 4, 5, 16)


def _pdo(cob_id, node_id, direction):
    layout = PdoLayout(cob_id, (PdoEntry(0x6041, 0, 16),))
    return PlannedPdo(node_id, direction, 1, "can0", layout, 400.0, 75, 2_500_000)


@pytest.mark.parametrize(
    ("pdos", "count"),
    [
        ([_pdo(0x181, 1, "tpdo"), _pdo(0x182, 2, "tpdo")], 0),
        ([_pdo(0x181, 1, "tpdo"), _pdo(0x181, 2, "tpdo")], 1),
        ([_pdo(0x181, 1, "tpdo"), _pdo(0x181, 2, "rpdo")], 1),
        ([_pdo(0x301, 1, "rpdo"), _pdo(0x301, 2, "rpdo")], 0),
        ([_pdo(0x180, 1, "tpdo")], 1),
        ([_pdo(0x701, 1, "tpdo"), _pdo(0x6E0, 1, "tpdo"), _pdo(0x101, 1, "rpdo")], 3),
    ],
)
def test_restricted_and_duplicate_identifiers(pdos, count):
    assert len(identifier_problems(pdos)) == count


# --- other devices: the plan works from what an EDS really offers --------------------------------------------------


def edited(folder, *edits):
    return with_eds(load_scene("free"), folder, *edits)


def test_unknown_eds():
    assert "no such packaged file" in reasons(change(load_scene("free"), arm={"eds": "puma261_joint.eds"}))[0]


def test_without_dummies_targets_stay_single_and_it_says_so(tmp_path):
    scene = change(edited(tmp_path, (r"Dummy0004=1", "Dummy0004=0")), arm={"grouped_rpdo": True})
    plan = canprobe.plan(scene)
    assert {pdo.number for pdo in plan.pdos} == {1}
    ((what, why),) = plan.not_available
    assert what == "two targets in one RPDO"
    assert "0004h" in why


@pytest.mark.parametrize(
    ("fixed", "why"),
    [(False, ": 6077h is not mappable to a TPDO"), (True, ": TPDO1 has the fixed mapping 60410010h, 60640020h")],
)
def test_torque_that_cannot_be_mapped_is_left_away_and_it_says_so(tmp_path, fixed, why):
    plan = canprobe.plan(without_torque(load_scene("free"), tmp_path, fixed=fixed))
    assert [e.index for e in plan.pdos_of(1, "tpdo")[0].entries] == [0x6041, 0x6064]
    assert plan.not_available == (("motor torque (torque_permille of log.npz)", f"{plan.nodes[0].eds}{why}"),)


def test_each_drive_is_planned_by_its_own_eds(tmp_path):
    """Makes may be mixed in one arm: a drive without torque, and without dummies, leaves the others as they are."""
    plain = load_scene("free")
    scene = edited(tmp_path, (r"(\[6077\][^\[]*PDOMapping=)1", r"\g<1>0"), (r"Dummy0004=1", "Dummy0004=0"))
    setup = resolve(plain)
    drives = list(setup.arm.drives)
    drives[2] = dataclasses.replace(drives[2], eds=scene.arm.eds)
    plan = make_plan(setup.changed("arm", drives=tuple(drives), grouped=True))
    assert [node.eds == scene.arm.eds for node in plan.nodes] == [False, False, True, False, False, False]
    assert [len(plan.pdos_of(n, "tpdo")[0].entries) for n in plan.node_ids] == [3, 3, 2, 3, 3, 3]
    assert {pdo.number for pdo in plan.pdos} == {1}
    assert [why.startswith(scene.arm.eds) for _, why in plan.not_available] == [True, True]


def test_target_that_cannot_be_mapped_is_refused(tmp_path):
    problems = reasons(edited(tmp_path, (r"(\[607A\][^\[]*PDOMapping=)1", r"\g<1>0")))
    assert any("607Ah:00 is not mappable to a RPDO" in problem for problem in problems)


def test_missing_objects_are_named(tmp_path):
    no_60c2 = (r"\[60C2\]", "[5FFF]"), (r"\[60C2sub", "[5FFFsub"), (r"=0x60C2", "=0x5FFF")
    problems = reasons(edited(tmp_path, *no_60c2, (r"\[1006\]", "[5FFE]"), (r"=0x1006", "=0x5FFE")))
    said = "objects 60C2h (interpolation time period) and 1006h (period of SYNC) are missing"
    assert any(said in problem for problem in problems)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        (r"AccessType=ro", "(other.eds: 1006h is ro, 0 µs); no period suits all drives"),
        (r"AccessType=ro\nDefaultValue=2500", None),
        (r"AccessType=ro\nDefaultValue=4000", "1006h is ro, 4000 µs); take 250 Hz"),
        (r"LowLimit=4000", "1006h takes 4000 to 4294967295 µs); take 250 Hz"),
    ],
)
def test_a_drive_without_60c2h_takes_the_period_that_1006h_takes(tmp_path, keys, said):
    """Of two equal keys in a section the first counts."""
    no_60c2 = (r"\[60C2\]", "[5FFF]"), (r"\[60C2sub", "[5FFFsub"), (r"=0x60C2", "=0x5FFF")
    scene = edited(tmp_path, *no_60c2, (r"\[1006\]", rf"[1006]\n{keys}"))
    if said is None:
        assert canprobe.plan(scene)
    else:
        assert any(said in problem.replace(f"{scene.arm.eds}", "other.eds") for problem in reasons(scene))


@pytest.mark.parametrize(
    ("sub", "keys", "said"),
    [
        (
            1,
            r"AccessType=ro\nDefaultValue=",
            "60C2h:01 takes no value by the EDS: no integer, read-only without a default",
        ),
        (1, r"DataType=0x9", "60C2h:01 takes no value by the EDS"),
        (2, r"AccessType=ro\nDefaultValue=3", "60C2h:02 takes no unit of 10^-6 to 10^0 s by the EDS"),
    ],
)
def test_an_interpolation_time_that_nothing_fits_is_said_without_a_hole(tmp_path, sub, keys, said):
    problems = reasons(edited(tmp_path, (rf"\[60C2sub{sub}\]", rf"[60C2sub{sub}]\n{keys}")))
    assert any(said in problem for problem in problems)


def test_axes_beyond_the_first_are_left_out_and_named(tmp_path):
    more = "".join(
        f"[{index:X}]\nParameterName=Controlword\nObjectType=7\nDataType=6\nAccessType=rw\n\n"
        for index in (0x6840, 0x7040)
    )
    left = dict(canprobe.plan(edited(tmp_path, (r"\[6041\]", more + "[6041]"))).left_out)
    assert "has objects of more axes, from 6800h, 7000h" in left["axes 2, 3 of node 4 (joint 4)"]


# --- the budget of one cycle, added up by hand: what each part waits for, in the order of the bus ------------------

HEARTBEAT = 65


@pytest.mark.parametrize(
    ("name", "sections", "sync_blocked", "sneaks_in", "compute"),
    [
        ("free", {"cycle": {"rate_hz": 500.0}}, HEARTBEAT, HEARTBEAT, 200),
        ("free", {"cycle": {"compute_us": 0.0}}, HEARTBEAT, HEARTBEAT, 0),
        ("cylinder", {}, FULL, FULL, 200),  # a tactile PDO of the cycle before
    ],
)
def test_cycle_budget(name, sections, sync_blocked, sneaks_in, compute):
    plan = canprobe.plan(change(load_scene(name), **sections))
    budget = plan.budget
    sync = sync_blocked + SYNC
    feedback = sync + sneaks_in + 6 * DRIVE_TPDO
    commands = feedback + compute + sneaks_in + 6 * DRIVE_RPDO
    assert (budget.sync_ns, budget.feedback_ns, budget.commands_ns) == (sync * 1000, feedback * 1000, commands * 1000)
    assert (budget.start_ns, budget.compute_ns) == (feedback * 1000, compute * 1000)
    assert budget.slack_ns == plan.sync.period_ns - commands * 1000
    assert budget.bus_ns + budget.compute_ns + budget.slack_ns == plan.sync.period_ns
    assert budget.feedback_ns in budget.looks_ns


@pytest.mark.parametrize(("best_us", "starts_us"), [(300, (625, 1145)), (900, (900, 1145))])
def test_a_controller_starts_when_the_last_feedback_comes_or_at_the_next_look(best_us, starts_us):
    starts = controller_starts(best_us * 1000, (625_000, 1_145_000, 1_500_000), 1_145_000)
    assert starts == tuple(us * 1000 for us in starts_us)


@pytest.mark.slow(reason="plans for every way out")
def test_a_controller_that_takes_too_long_is_refused(press):
    setup = resolve(press)
    budgets = [make_plan(setup.changed("arm", torque=torque)).budget for torque in (True, False)]
    longest, without = [(budget.slack_ns + budget.compute_ns) / 1000 for budget in budgets]
    for compute_us, what in (
        (longest, ()),
        (longest + 1, ("motor torque (6077h)",)),
        (without, ("motor torque (6077h)",)),
    ):
        plan = canprobe.plan(change(press, cycle={"compute_us": compute_us}))
        assert tuple(what for what, _ in plan.left_out if "torque" in what) == what
        assert plan.budget.slack_ns >= 0
    longer = change(press, cycle={"compute_us": without + 1})
    assert "behind the next SYNC" in reasons(longer)[0]
    assert f"cycle.compute_us = {longest:.0f}" in [way.partition(":")[0] for way in ways_out(longer)]


def test_torque_is_given_up_before_the_window_is_narrowed(press):
    """At 454.5 Hz 2·(65 + 6·(135 + 115)) + 9·135 = 4345 of 4400 µs leave no room for jitter; 4105 do."""
    plan = canprobe.plan(change(press, cycle={"rate_hz": 1e6 / 2200}, sensor={"rate_hz": 1e6 / 4400}))
    assert plan.setup.array.window == 8
    assert plan.traffic.demands[1].used_ns == 4_105_000
    assert {len(plan.pdos_of(n, "tpdo")[0].entries) for n in range(1, 7)} == {2}
    assert "motor torque (6077h)" in dict(plan.left_out)


def test_a_sensor_alone_has_a_budget_too():
    budget = canprobe.plan(load_scene("listen")).budget
    assert (budget.feedback_ns, budget.commands_ns) == (None, None)
    assert budget.tactile_ns == (HEARTBEAT + SYNC + HEARTBEAT + 9 * FULL) * 1000
    assert budget.looks_ns == (625_000, 1_500_000)
    assert budget.slack_ns == 2_500_000 - 625_000 - 200_000


@pytest.mark.parametrize(
    ("mode", "ids"),
    [("image", (17, 18, 19, 20, 21, 49, 126)), ("window", (120, 121, 122, 123, 124, 125, 126))],
)
def test_identifiers_of_the_array_leave_those_of_any_drive_alone(mode, ids, tmp_path):
    """RPDO4 of nodes 17 to 49 are 511h to 531h, where the array's are otherwise; whatever bus they are on."""
    scene = load_scene("cylinder", {"cell": "seven-axis"})
    scene = change(
        scene,
        arm={"eds": str(write_eds("milliseconds_only", tmp_path))},
        cycle={"rate_hz": 333.333},
        sensor={"mode": mode, "channel": "can1", "rate_hz": 333.333 / 2},
    )
    plan = canprobe.plan(with_joints(scene, node_id=ids, channel=["can0"] * 4 + ["can2"] * 3))
    tactile = [pdo.cob_id for pdo in plan.pdos if pdo.kind == "tactile"]
    drives = {pdo.cob_id for pdo in plan.pdos if pdo.kind == "drive"} | {0x500 + node_id for node_id in ids}
    assert drives.isdisjoint(tactile) and len(set(tactile)) == len(tactile)
    assert tactile == sorted(tactile) and (tactile[0] == 0x511) == (17 not in ids)
    assert [bus.channel for bus in plan.buses] == ["can0", "can2", "can1"]
