"""The cycles of a plan as they go: a schedule that a bus could have, never later than the analysis allows."""

import itertools
import json

import pytest
from scenes import change

import canprobe
from canprobe.cell.planning.timeline import timeline, timeline_rows
from canprobe.cell.planning.traffic import on_the_wire
from canprobe.cell.scene.load import load_scene
from canprobe.cli import main


def scenes():
    cylinder = load_scene("cylinder")
    yield cylinder
    yield change(cylinder, arm={"grouped_rpdo": True})
    yield change(cylinder, sensor={"mode": "image", "channel": "can1"})
    yield change(cylinder, sensor={"mode": "image", "eds": "tactile_array_fd.eds"}, bus={"fd": True})
    yield load_scene("listen")
    yield load_scene("free")


@pytest.fixture(scope="module", params=range(6), ids=["cylinder", "grouped", "split", "fd", "listen", "free"])
def plan(request):
    return canprobe.plan(list(scenes())[request.param])


def test_one_frame_at_a_time_on_each_bus(plan):
    for bus in plan.buses:
        mine = sorted((slot.start_ns, slot.end_ns) for slot in timeline(plan) if slot.channel == bus.channel)
        assert all(end <= start for (_, end), (start, _) in itertools.pairwise(mine))


def test_every_message_behind_sync_is_there_as_often_as_it_is_triggered(plan):
    slots = timeline(plan)
    cycles = 1 + max(slot.cycle for slot in slots)
    for pdo in on_the_wire([pdo for pdo in plan.pdos if pdo.transmission_type <= 240]):
        mine = [slot for slot in slots if slot.cob_id == pdo.cob_id]
        every = 1 if pdo.direction == "rpdo" else pdo.transmission_type
        assert len(mine) == cycles / every
        assert {slot.channel for slot in mine} == {pdo.channel}
        assert {slot.end_ns - slot.start_ns for slot in mine} == {1000 * pdo.bits_worst}  # at 1 Mbit/s
    assert sum(slot.part == "SYNC" for slot in slots) == cycles * len(plan.buses)


def test_nothing_is_later_than_the_worst_case_and_some_come_near(plan):
    shares = []
    for slot in timeline(plan):
        planned = [pdo for pdo in plan.pdos if pdo.cob_id == slot.cob_id]
        if planned:
            took = slot.end_ns - slot.cycle * plan.sync.period_ns
            assert took <= planned[0].response_ns
            shares.append(took / planned[0].response_ns)
    assert max(shares) > 0.75


def test_the_controller_starts_after_the_feedback_and_its_commands_follow_it(plan):
    slots = timeline(plan)
    for cycle in range(1 + max(slot.cycle for slot in slots)):
        (controller,) = [slot for slot in slots if slot.part == "controller" and slot.cycle == cycle]
        assert controller.end_ns - controller.start_ns == 200_000
        assert all(s.end_ns <= controller.start_ns for s in slots if s.part == "feedback" and s.cycle == cycle)
        assert all(s.start_ns >= controller.end_ns for s in slots if s.part == "command" and s.cycle == cycle)


def test_of_those_that_wait_the_lowest_identifier_goes_first(plan):
    """A frame that starts later than one of a higher identifier was not there when that one started."""
    slots = [slot for slot in timeline(plan) if slot.part in ("feedback", "tactile") and slot.cycle == 0]
    by_start = sorted(slots, key=lambda slot: (slot.channel, slot.start_ns))
    assert [slot.cob_id for slot in by_start] == [
        slot.cob_id for slot in sorted(slots, key=lambda slot: (slot.channel, slot.cob_id))
    ]


def test_rows_for_a_terminal(plan):
    rows = timeline_rows(plan, 50)
    cycles = 1 + max(slot.cycle for slot in timeline(plan))
    assert len(rows) == cycles * (len(plan.buses) + 1)
    assert all(len(row[2]) == 50 for row in rows)
    busy = sum(character != "·" for row in rows if row[1] != "controller" for character in row[2])
    load = sum(bus.load - dict(bus.parts)["heartbeats"] for bus in plan.buses)
    assert busy / (50 * cycles) == pytest.approx(load, abs=0.04 * len(plan.buses))
    assert rows[0][2].startswith("S")


def test_the_command_draws_and_prints_it(tmp_path, capsys):
    assert main(["plan", "press", "--figure", str(tmp_path / "bare")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == str(tmp_path / "bare.png")
    assert (tmp_path / "bare.png").read_bytes().startswith(b"\x89PNG")
    assert main(["plan", "press", "--figure", str(tmp_path / "plan.xyz")]) == 2
    capsys.readouterr()
    assert main(["plan", "press", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["timeline"][0] == {
        "part": "SYNC", "channel": "can0", "cob_id": 0x80, "cycle": 0, "start_us": 0.0, "end_us": 65.0,
    }  # fmt: skip
    pdo = document["pdos"][0]
    assert pdo["slack_us"] == pdo["deadline_us"] - pdo["response_us"]
    assert main(["plan", "press", "--full"]) == 0
    assert "cycle 2  can0        SSS" in capsys.readouterr().out


def test_each_output_is_listed_with_its_cost_or_the_key_that_turns_it_off(capsys):
    assert main(["plan", "cylinder", "--full", "--set", "outputs.truth=false"]) == 0
    printed = capsys.readouterr().out
    table = printed.partition("outputs, and what each of them costs:\n")[2].partition("\n\n")[0].splitlines()
    costs = {name: cost for name, cost in (line.split(maxsplit=1) for line in table)}
    assert list(costs) == ["truth", "surface_map", "bus_log", "figures"]
    assert costs["truth"].startswith("off: outputs.truth = false")
    assert costs["bus_log"].startswith("3 % of a cycle")
    assert main(["plan", "free", "--set", "bus.interface=direct", "--json"]) == 0
    assert set(json.loads(capsys.readouterr().out)["output_costs"]) <= {"truth", "figures"}
