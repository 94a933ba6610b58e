"""What a scene leaves open ("auto") is chosen so that it fits; what it writes is kept."""

import dataclasses
import json
import math

import numpy as np
import pytest
from scenes import change, refused, ways_out

import canprobe
from canprobe.cell.planning.array import cut_patch, measured_share, patch_radius_m, true_force_n
from canprobe.cell.planning.free_parameters import opened, second_channel
from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.report import plan_dict, plan_text
from canprobe.cell.scene.load import dump_scene, load_scene, parse_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cli import main
from canprobe.errors import PlanError, SceneError
from canprobe.fieldbus.bus.real.adapters import LOCAL_GROUP
from canprobe.fieldbus.protocol.frames import is_restricted


@pytest.fixture(scope="module")
def press():
    return load_scene("press")


def opened_plan(scene):
    return make_plan(opened(resolve(scene)))


def chosen(plan):
    return {choice.key: choice.written for choice in plan.choices}


def test_what_fits_is_left_as_the_contract_has_it(press):
    plan = opened_plan(press)
    assert plan.pdos == canprobe.plan(press).pdos
    assert chosen(plan) == {
        "sensor.channel": '"can0"', "bus.fd": "false", "arm.grouped_rpdo": "false", "bus.cob_ids": '"default"',
    }  # fmt: skip
    assert not canprobe.plan(press).choices


def test_500_hz_needs_grouped_targets_and_priorities_by_deadline(press):
    """Neither alone is enough: the planner finds the pair, which costs no hardware."""
    scene = change(press, cycle={"rate_hz": 500.0}, sensor={"rate_hz": 250.0})
    for half in ({"arm": {"grouped_rpdo": True}}, {"bus": {"cob_ids": "by_deadline"}}):
        with pytest.raises(PlanError):
            make_plan(resolve(change(scene, **half)), find_ways=False)
    ways = ways_out(scene)
    assert any(way.startswith('arm.grouped_rpdo = true and bus.cob_ids = "by_deadline": load 95 %') for way in ways)
    assert not any(way.startswith("arm.grouped_rpdo = true: ") for way in ways)  # alone it does not
    plan = opened_plan(scene)
    assert chosen(plan)["arm.grouped_rpdo"] == "true" and chosen(plan)["bus.cob_ids"] == '"by_deadline"'
    assert plan.budget.slack_ns > 0
    assert len(plan.buses) == 1


def test_an_image_beside_the_arm_gets_a_bus_of_its_own_or_can_fd(press):
    image = change(press, sensor={"mode": "image"})
    split = opened_plan(image)
    assert [(bus.channel, bus.node_ids) for bus in split.buses] == [("can0", (1, 2, 3, 4, 5, 6)), ("can1", (16,))]
    assert {pdo.channel for pdo in split.pdos if pdo.kind == "tactile"} == {"can1"}
    assert all(bus.load < 1 for bus in split.buses)
    fd = opened_plan(change(image, sensor={"eds": "tactile_array_fd.eds"}))
    assert len(fd.buses) == 1 and fd.scene.bus.fd is True and chosen(fd)["bus.fd"] == "true"


def test_what_is_written_is_kept(press):
    scene = change(press, sensor={"mode": "image", "channel": "auto"}, bus={"fd": "auto"})
    assert canprobe.plan(scene).scene.arm.grouped_rpdo is False
    with pytest.raises(PlanError, match="none of 2 ways"):
        canprobe.plan(change(scene, sensor={"channel": "can0"}, arm={"grouped_rpdo": "auto"}, bus={"fd": False}))


def test_the_sensor_gives_less_last_of_all(press):
    assert canprobe.plan(change(press, sensor={"mode": "auto"})).scene.sensor.mode == "window"
    fast = change(press, cycle={"rate_hz": 1e6 / 2100}, sensor={"rate_hz": 1e6 / 4200, "mode": "auto"})
    assert canprobe.plan(fast).scene.sensor.mode == "features"
    assert opened_plan(fast).scene.sensor.mode == "window"
    assert canprobe.plan(change(load_scene("listen"), sensor={"mode": "auto"})).scene.sensor.mode == "image"


def test_nothing_fits_says_how_many_were_tried_and_what_would(press):
    with pytest.raises(PlanError) as refused:
        opened_plan(change(press, cycle={"rate_hz": 1000.0}, sensor={"rate_hz": 500.0, "mode": "auto"}))
    first, *_, last = refused.value.problems
    assert first.startswith("none of 32 ways to fill what is left open fits; the nearest: sensor.mode = ")
    assert "1280 µs of the 1000 µs" in last and refused.value.ways_out[0].startswith("cycle.rate_hz = ")


def test_priorities_follow_the_deadlines_and_are_never_restricted(press):
    grouped = change(press, arm={"grouped_rpdo": True})
    default, ordered = canprobe.plan(grouped), canprobe.plan(change(grouped, bus={"cob_ids": "by_deadline"}))
    by_id = sorted(ordered.pdos, key=lambda pdo: pdo.cob_id)
    assert [pdo.deadline_ns for pdo in by_id] == sorted(pdo.deadline_ns for pdo in ordered.pdos)
    assert not any(is_restricted(pdo.cob_id) for pdo in ordered.pdos)
    assert len({pdo.cob_id for pdo in ordered.pdos}) == len({pdo.cob_id for pdo in default.pdos})
    shared = [pdo for pdo in ordered.pdos if pdo.direction == "rpdo" and pdo.number == 2]
    assert len({pdo.cob_id for pdo in shared}) == 3  # two drives each
    assert {tuple(entry.word for entry in pdo.layout.entries) for pdo in shared} == {
        tuple(entry.word for entry in pdo.layout.entries)
        for pdo in default.pdos
        if pdo.direction == "rpdo" and pdo.number == 2
    }


@pytest.mark.parametrize(
    ("channel", "second"), [("can0", "can1"), ("vcan9", "vcan10"), ("PCAN_USBBUS1", "PCAN_USBBUS2"), ("a", "a2")]
)
def test_second_channel(channel, second):
    assert second_channel(channel) == second


@pytest.mark.parametrize(
    ("line", "complaint"),
    [("arm.grouped_rpdo = 'atuo'", 'true or false or "auto"'), ("bus.fd = 1", 'true or false or "auto"'),
     ("bus.cob_ids = 'x'", "one of default, by_deadline, auto")],
)  # fmt: skip
def test_open_keys_in_the_file(line, complaint):
    section, _, text = line.partition(".")
    document = f'[scene]\nname = "x"\n[task]\nkind = "free"\n[arm]\n{text if section == "arm" else ""}\n'
    document += f"[bus]\n{text}\n" if section == "bus" else ""
    with pytest.raises(SceneError, match=complaint):
        parse_scene(document)
    key = text.partition(" ")[0]
    scene = parse_scene(document.replace(text, f'{key} = "auto"'))
    assert getattr(getattr(scene, section), key) == "auto"
    assert parse_scene(dump_scene(scene)) == scene


def test_the_command_opens_what_stands_at_its_default(capsys):
    assert main(["plan", "press", "--auto", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert {"key": "bus.fd", "value": "false", "why": "classical frames do"} in document["choices"]
    assert main(["plan", "press", "--auto", "--full"]) == 0
    assert "chosen by the plan:" in capsys.readouterr().out


# A window that cuts the contact patch: how much of the force it feels, and what the plan says and refuses.

PITCH = 1.5875e-3
PROBE = resolve(load_scene("cylinder")).probe


@pytest.mark.parametrize(
    ("side", "off", "force"), [(4, 0.75, 2.0), (6, 0.0, 4.5), (8, 0.75, 0.5), (40, 20.0, 2.0), (40, 30.0, 2.0)]
)
def test_share_against_points_on_a_grid(side, off, force):
    """The patch of the plant and its pressure, summed over many points; an edge far away feels half or none."""
    radius = patch_radius_m(force, PROBE)
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 501)] * 2)
    pressure = np.clip(1.0 - x**2 - y**2, 0.0, None)
    half, middle = side / 2 * PITCH / radius, off * PITCH / radius
    inside = pressure[(np.abs(x - middle) <= half) & (np.abs(y) <= half)].sum() / pressure.sum()
    assert measured_share(force, PROBE, side, PITCH, off) == pytest.approx(inside, abs=5e-3)


@pytest.mark.parametrize("side", [4, 6])
def test_the_true_force_is_the_one_of_which_the_target_is_inside(side):
    true = true_force_n(2.0, PROBE, side, PITCH, 100.0)
    assert true * measured_share(true, PROBE, side, PITCH) == pytest.approx(2.0, rel=1e-6)
    assert true_force_n(2.0, PROBE, side, PITCH, 0.999 * true) is None
    stiffer = dataclasses.replace(PROBE, stiffness=10 * PROBE.stiffness)
    assert true_force_n(2.0, stiffer, side, PITCH, 100.0) < true


def test_a_window_that_cuts_the_patch_is_a_warning_with_numbers():
    small = canprobe.plan(change(load_scene("cylinder"), sensor={"window": 6}))
    (warning,) = small.warnings
    for part in ("6.7 taxels across", "at 2 N", "94 % of that force", "carried on", "errs by up to 10 %", "window = 8"):
        assert part in warning
    assert f"\n  warning    {warning}\n" in plan_text(small)
    assert plan_dict(small)["warnings"] == [warning]


def test_more_than_the_force_limit_unfelt_is_refused(tmp_path, capsys):
    foam = change(load_scene("foam"), sensor={"window": 4})
    error = refused(foam)
    assert "more than limits.force_max_n = 5 N can press" in error.problems[0]
    assert error.problems[0].endswith("; take sensor.window = 10 or a smaller task.force_n") and not error.ways_out
    assert "up to 0.29 N" in canprobe.plan(change(foam, task={"force_n": 0.2})).warnings[0]
    (tmp_path / "foam.toml").write_text(dump_scene(foam))
    assert main(["plan", str(tmp_path / "foam.toml"), "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert document["fits"] is False and document["problems"] == list(error.problems)
    assert document["ways_out"] == list(error.ways_out)


def test_features_and_the_whole_image_cut_nothing():
    for mode in ("features", "image"):
        assert cut_patch(resolve(change(load_scene("foam"), sensor={"mode": mode, "window": 4}))) is None


@pytest.mark.parametrize(
    ("channel", "local"),
    [
        ("239.74.163.2", False),
        ("ff15:7079:7468:6f6e:6465:6d6f:6d63:6173", False),
        (LOCAL_GROUP, True),
    ],
)
def test_a_bus_that_other_machines_hear_is_a_warning_with_the_way_to_restrict_it(channel, local):
    plan = canprobe.plan(change(load_scene("free"), bus={"interface": "udp_multicast", "channel": channel}))
    assert len(plan.warnings) == (not local)
    for warning in plan.warnings:
        assert warning.startswith(f"bus.channel = {channel}: every machine on this network segment hears this bus")
        assert warning.endswith(f"--channel {LOCAL_GROUP} keeps it on this machine")


@pytest.mark.parametrize(
    ("section", "told"),
    [
        ('use = ["ros2"]\nros2_commands = true', None),
        ('use = ["mcap"]\nros2_loopback = false\nros2_commands = true', None),
        ('use = ["ros2"]\nros2_loopback = false', "segment sees the cell; bridge.ros2_loopback = true keeps"),
        (
            'use = ["ros2"]\nros2_loopback = false\nros2_commands = true',
            "segment can start, stop and move the cell; bridge.ros2_loopback = true keeps",
        ),
    ],
)
def test_topics_that_leave_this_machine_are_a_warning(section, told):
    warnings = canprobe.plan(parse_scene(f"{dump_scene(load_scene('free'))}[bridge]\n{section}\n")).warnings
    assert warnings == () if told is None else told in warnings[0]


def test_errors_on_the_wire_are_a_warning():
    """135 bits: 31 more for the error, and 1 - (1 - 1e-3)^135 of them are hit."""
    (warning,) = canprobe.plan(change(load_scene("free"), bus={"bit_error_rate": 1e-3})).warnings
    assert "up to 166 µs" in warning and f"{100 * (1 - math.exp(135 * math.log1p(-1e-3))):.2g} % of the" in warning


@pytest.mark.parametrize(("emulated", "missed_syncs", "warned"), [(False, 10, 0), (False, 11, 1), (True, 250, 0)])
def test_real_drives_that_wait_long_for_their_master_are_a_warning(emulated, missed_syncs, warned):
    one = load_scene("free", {"joints.joint_3.emulated": emulated})
    plan = canprobe.plan(change(one, arm={"missed_syncs": missed_syncs}))
    found = [one for one in plan.warnings if one.startswith(f"arm.missed_syncs = {missed_syncs}: real drives")]
    assert len(found) == warned
    assert all(f"stay enabled for {11 / plan.setup.rate_hz * 1e3:g} ms after" in warning for warning in found)
