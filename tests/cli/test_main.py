"""The command line: what is parsed, what is called, what is printed where, and the exit status."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_lines import command_lines, parse

import canprobe
from canprobe import api
from canprobe.cell.master.monitor import Monitor
from canprobe.cell.results import text
from canprobe.cell.scene.load import load_scene, packaged
from canprobe.cell.session import served
from canprobe.cli import COMMANDS, main
from canprobe.cli.interrupts import termination_interrupts
from canprobe.cli.output import print_json
from canprobe.errors import InterfaceError, NodeError, PlanError, SafetyStop, SceneError, UsageError, at_least, at_most
from canprobe.fieldbus.bus.real.adapters import BACKENDS
from canprobe.fieldbus.bus.real.interrupts import Terminated
from canprobe.fieldbus.eds.packaged import eds_path

SUMMARY = {"scene": "free", "completed": True, "shape": {"method": None}}


class FakeResult:
    """As much of a RunResult as the command line asks for."""

    def __init__(self):
        self.summary = SUMMARY


@pytest.fixture
def calls(monkeypatch):
    """Replace the API by functions that remember how they were called."""
    seen = []

    def fake(name, answer=None):
        def call(*args, **kwargs):
            seen.append((name, args, kwargs))
            if "early_summary" in kwargs:
                kwargs["early_summary"](SUMMARY)
            return answer

        monkeypatch.setattr(api, name, call)

    monkeypatch.setattr(text, "summary_text", lambda *_, **__: "all went well")
    fake("run", FakeResult())
    fake("up")
    fake("emulate")
    one = dict.fromkeys(("product_code", "revision_number", "serial_number", "device_name"))
    fake("scan", [{"node_id": 1, "state": "PRE_OPERATIONAL", "devices": 1, "vendor_id": 0xCA5E, **one}])
    return seen


@pytest.mark.parametrize(
    "command", [(), *((command,) for command in COMMANDS), ("eds", "list"), ("eds", "path"), ("eds", "check")]
)
def test_help_has_examples_of_its_command_that_parse(command, capsys):
    assert main([*command, "--help"]) == 0
    _, _, examples = capsys.readouterr().out.partition("example")
    lines = command_lines(examples)
    assert any(tuple(line[: len(command)]) == command for line in lines)
    for line in lines:
        parse(line)


@pytest.mark.parametrize("words", [[], ["--help"], ["help"]])
def test_help_lists_every_command(words, capsys):
    assert main(words) == 0
    out = capsys.readouterr().out
    assert all(f"    {command}" in out for command in COMMANDS)


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"canprobe {canprobe.__version__}\n"


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["runn"], ("unknown command 'runn'", "did you mean run?")),
        (["run"], ("SCENE",)),
        (["--versoin"], ("unrecognized arguments: --versoin; did you mean --version?",)),
        (["run", "cylinder", "--sead", "3"], ("--sead 3; did you mean --seed?", "see canprobe run --help")),
        (["eds", "list", "--no-such"], ("see canprobe eds list --help",)),
        (["run", "cylinder", "--seed", "-1"], ("--seed", "'-1'")),
        (["run", "cylinder", "--seed", "x"], ("--seed", "an integer from 0")),
        (["run", "cylinder", "--duration", "0"], ("--duration", "seconds above 0")),
        (["run", "cylinder", "--duration", "inf"], ("--duration",)),
        (["run", "cylinder", "--bitrate", "5"], ("--bitrate", "from 10000")),
        (["run", "cylinder", "--channel", "=vcan0"], ("--channel", "NAME=CH")),
        (["run", "cylinder", "--channel", "can1=vcan0"], ("no channel can1", "only can0", "did you mean can0?")),
        (["run", "cylinder", "--channel", "vcan0", "--channel", "vcan1"], ("given 2 times",)),
        (["run", "cilinder"], ("no such scene", "did you mean cylinder?")),
        (["up", "gantri"], ("no such scene, cell or file; did you mean gantry?",)),
        *((["jog", "puma260"], ("type canprobe console",)), (["zero"], ("type canprobe tare", "canprobe home"))),
        (["plan", "none.toml"], ("none.toml", "cannot be read", "`canprobe scenes` lists the packaged ones")),
        (["plan", "free", "--measured", "run", "--export", "dcf"], ("--measured", "no --export or --figure")),
        (["emulate", "cylinder"], ("--channel", "missing")),
        (["emulate", "cylinder", "--channel", "vcan0", "--nodes", "6-1"], ("--nodes", "1-6,16")),
        (["emulate", "cylinder", "--channel", "vcan0", "--nodes", "126-127"], ("--nodes", "from 1 to 126")),
        (
            ["emulate", "cylinder", "--channel", "vcan0", "--nodes", "1,126"],
            ("no node [126]", "[1, 2, 3, 4, 5, 6, 16]"),
        ),
        (["eds", "path", "puma260"], ("puma260", "puma260_joint")),
        (["eds"], ("ACTION",)),
    ],
)
def test_wrong_usage_is_one_clear_line_and_status_2(argv, words, capsys, calls):
    assert main(argv) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("canprobe")
    assert all(word in captured.err for word in words), captured.err
    assert not calls


@pytest.mark.parametrize(
    ("error", "status"),
    [
        (UsageError("wrong"), 2),
        (SceneError(["one", "two"]), 2),
        (PlanError(["one"]), 2),
        (InterfaceError("no vcan9"), 3),
        (NodeError(3, "absent"), 3),
        (SafetyStop("force 7 N above 5 N"), 1),
        (PermissionError(13, "Permission denied", "/nowhere"), 2),
        (PermissionError(1, "Operation not permitted"), 3),
        (OSError(28, "No space left on device", "bus.log"), 3),
        (KeyboardInterrupt(), 130),
        (Terminated(), 143),
    ],
)
def test_exit_status_of_every_error(error, status, monkeypatch, capsys):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(api, "run", fail)
    assert main(["run", "free"]) == status
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "Traceback" not in captured.err
    expected = ["interrupted"] if status > 100 else str(error).splitlines()
    assert len(captured.err.splitlines()) == len(expected)


def test_an_error_that_nobody_foresaw_is_no_safety_stop(monkeypatch, capsys):
    monkeypatch.setattr(api, "run", lambda *_, **__: 1 / 0)
    assert main(["run", "free"]) == 70
    assert "ZeroDivisionError" in (err := capsys.readouterr().err)
    assert err.endswith("canprobe: this is a fault of canprobe itself: please report it with the lines above\n")


def test_a_run_hears_sigterm_from_its_beginning(monkeypatch, tmp_path):
    def load(*_):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("canprobe.cell.scene.load.load_scene", load)
    assert main(["run", "free"]) == 143


BUSY = {
    "run": ("run", "free"),
    "up": ("up", "free"),
    "check_joints": ("up", "free", "--check-joints", "--yes"),
    "home": ("home", "free", "--yes"),
    "emulate": ("emulate", "free", "--channel", "vcan0"),
    "emulate_eds": ("emulate", "--eds", "puma260_joint.eds", "--node-id", "5", "--channel", "vcan0"),
    "monitor": ("monitor", "free", "--channel", "vcan0"),
    "scan": ("scan", "--channel", "vcan0"),
    "commission": ("scan", "--lss", "--channel", "vcan0"),
}
"""Command lines by the function of the API that keeps each of them busy."""
UNTIL_CTRL_C = ("up", "emulate", "emulate_eds", "monitor")


@pytest.mark.parametrize("name", BUSY)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_a_signal_ends_has_its_status(name, number, monkeypatch, capsys):
    """Ctrl-C is the normal end of what only holds or shows; SIGTERM is 143 everywhere."""
    place = served if name == "emulate_eds" else api
    monkeypatch.setattr(place, name, lambda *_, **__: signal.raise_signal(number))
    assert main(BUSY[name]) == (143 if number == signal.SIGTERM else 0 if name in UNTIL_CTRL_C else 130)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize("json_too", [[], ["--json"]])
def test_a_monitor_that_is_ended_shows_what_it_knows(json_too, monkeypatch, capsys):
    """`timeout 5 canprobe monitor …` is a way to look for five seconds."""

    def views(*_, **__):
        plan = canprobe.plan(canprobe.load_scene("free"))
        yield Monitor(plan).view(0)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(api, "monitor", views)
    assert main(["monitor", "free", "--channel", "vcan0", *json_too]) == 143
    assert "can0" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["run press", "emulate press", "monitor press", "scan"])
def test_a_bus_that_python_can_does_not_know_is_wrong_usage(command, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert main([*command.split(), "--bus", "token-ring", "--channel", "x"]) == 2
    err = capsys.readouterr().err.splitlines()[-1]
    assert err.startswith("canprobe: no interface 'token-ring'; ") and "python-can has: " in err and "socketcan" in err
    assert list(tmp_path.iterdir()) == []


def bus_of(scene):
    return scene.bus.interface, scene.bus.channel, scene.bus.bitrate


def test_run_passes_everything_on(calls, tmp_path, capsys):
    argv = ["--bus", "socketcan", "--channel", "can0=vcan3", "--bitrate", "500000", "--seed", "7", "--duration", "2.5"]
    assert main(["run", "free", *argv, "--out", str(tmp_path / "out")]) == 0
    ((name, (scene,), kwargs),) = calls
    assert (name, scene.name) == ("run", "free")
    assert bus_of(scene) == ("socketcan", "vcan3", 500_000)
    assert (scene.seed, scene.task.duration_s, kwargs["out"]) == (7, 2.5, tmp_path / "out")
    out = tmp_path / "out"
    assert capsys.readouterr().out == f"all went well\n  files      {out}\nnext: canprobe view {out}\n"


@pytest.mark.parametrize("command", ["run", "up"])
def test_patience_is_what_is_asked_for_and_for_emulated_nodes_only(command, calls, tmp_path, capsys):
    def limits(*words):
        assert main([command, "cylinder", "--bus", "socketcan", *words]) == 0
        _, (scene,), _ = calls.pop()
        return scene.arm.missed_syncs, scene.limits.late_cycles_max_percent

    assert limits() == (5, 10.0)
    assert limits("--patient") == (40, 100.0)
    path = tmp_path / "real.toml"
    path.write_text("[scene]\nname = 'real'\n[arm]\nemulated = false\n[task]\nkind = 'free'\n")
    assert main([command, str(path), "--bus", "socketcan", "--patient"]) == 2
    assert "--patient is for emulated nodes" in capsys.readouterr().err and not calls


@pytest.mark.parametrize("command", ["run", "up"])
def test_keys_are_set_as_a_file_has_them(command, calls):
    words = ["--set", "task.swing_period_s=3", "--set", "scene.title=a = b", "--set", "cycle.realtime = true"]
    assert main([command, "free", "--bus", "socketcan", *words]) == 0
    ((_, (scene,), _),) = calls
    assert (scene.task.swing_period_s, scene.title, scene.cycle.realtime) == (3.0, "a = b", True)


@pytest.mark.parametrize(("bus", "said"), [("lockstep", True), ("direct", True), ("socketcan", False)])
def test_realtime_on_a_bus_in_virtual_time_is_said_to_have_no_effect(bus, said, calls, capsys):
    assert main(["run", "free", "--bus", bus, "--realtime"]) == 0
    assert ("warning: --realtime has no effect" in capsys.readouterr().err) == said


def test_run_takes_the_scenes_bus_by_default(calls):
    assert main(["run", "free"]) == 0
    ((_, (scene,), kwargs),) = calls
    assert bus_of(scene) == ("lockstep", "can0", 1_000_000)
    assert (scene.seed, scene.task.duration_s) == (0, load_scene("free").task.duration_s)
    assert (kwargs["out"].parent, kwargs["out"].name[:5]) == (Path("runs"), "free-")


def test_run_json_is_one_document(calls, capsys):
    assert main(["run", "free", "--json"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) == SUMMARY
    assert captured.err == ""


def test_a_stopped_run_still_prints_its_summary(monkeypatch, capsys):
    def stop(*_, **__):
        error = SafetyStop("contact lost")
        error.summary = {"completed": False}
        raise error

    monkeypatch.setattr(api, "run", stop)
    assert main(["run", "free", "--json"]) == 1
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"completed": False}
    assert captured.err == "canprobe: contact lost\n"


def test_json_refuses_what_is_no_number():
    with pytest.raises(ValueError, match="Out of range"):
        print_json({"value": float("nan")})


def test_up_and_emulate_pass_everything_on(calls, tmp_path):
    assert main(["up", "free", "--bus", "socketcan", "--channel", "vcan0"]) == 0
    truth = tmp_path / "truth.npz"
    argv = ["--channel", "vcan0", "--nodes", "16,1-2, 2", "--seed", "4", "--truth", str(truth)]
    assert main(["emulate", "cylinder", *argv]) == 0
    (_, (scene,), _), (_, (_, target), emulate) = calls
    assert bus_of(scene) == ("socketcan", "vcan0", 1_000_000)
    assert (target, emulate["node_ids"]) == (api.Target("socketcan", "vcan0", 1_000_000), (1, 2, 16))
    assert (emulate["seed"], emulate["truth_path"]) == (4, truth)


def test_emulate_serves_what_the_scene_marks(calls):
    assert main(["emulate", "listen", "--channel", "vcan0"]) == 0
    assert calls[0][2]["node_ids"] == (16,)


ON_TWO_BUSES = """\
[scene]
name = "two"
[bus]
channel = "arm"
[arm]
[sensor]
channel = "touch"
[object]
kind = "plane"
[task]
kind = "press"
"""


@pytest.mark.parametrize(
    ("words", "arm", "touch"),
    [
        ("--channel vcan0", "vcan0", "vcan0"),
        ("--channel arm=x --channel touch=y", "x", "y"),
        ("--channel touch=y --nodes 16", "arm", "y"),
        ("--channel arm=x --nodes 2", "x", "touch"),
    ],
)
def test_emulate_serves_each_node_on_its_own_bus(words, arm, touch, calls, tmp_path):
    (tmp_path / "two.toml").write_text(ON_TWO_BUSES)
    assert main(["emulate", str(tmp_path / "two.toml"), *words.split()]) == 0
    ((_, (_, target), _),) = calls
    assert (target.channel, target.others) == (arm, {"touch": touch})


def test_scan_prints_a_table_or_json(calls, capsys):
    assert main(["scan", "--channel", "vcan0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["vendor_id"] == 0xCA5E
    assert main(["scan", "--channel", "vcan0"]) == 0
    header, row = capsys.readouterr().out.splitlines()
    numbers = ["vendor_id", "product_code", "revision_number", "serial_number"]
    assert header.split() == ["node_id", "state", *numbers, "device_name"]
    assert row.split() == ["1", "PRE_OPERATIONAL", "0xca5e", "-", "-", "-", "-"]
    assert calls[0][:2] == ("scan", (api.Target("socketcan", "vcan0", 1_000_000),))


def test_scenes(capsys):
    assert main(["scenes"]) == 0
    *lines, figures, last = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [n for n, _ in packaged("scene")]
    assert figures.startswith("figures: ")
    folder = Path(last.removeprefix("in ").partition(";")[0])
    assert main(["scenes", "--json"]) == 0
    scenes = json.loads(capsys.readouterr().out)
    assert [scene["name"] for scene in scenes] == [n for n, _ in packaged("scene")]
    for scene in scenes:
        path = Path(scene["path"])
        assert path.parent == folder and load_scene(path) == load_scene(scene["name"])


def test_eds(capsys):
    assert main(["eds", "list"]) == 0
    assert {"puma260_joint", "tactile_array"} <= set(capsys.readouterr().out.split())
    assert main(["eds", "path", "puma260_joint.eds"]) == 0
    assert capsys.readouterr().out == f"{eds_path('puma260_joint')}\n"


def test_sigterm_is_left_alone_outside_the_main_thread():
    def enter():
        with termination_interrupts():
            pass

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert signal.getsignal(signal.SIGTERM) is not None


def test_a_reader_that_goes_away_is_quiet():
    read, write = os.pipe()
    os.close(read)
    try:
        command = [sys.executable, "-m", "canprobe", "plan", "free"]
        done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    finally:
        os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_line_to_type_names_the_scene_that_was_given(monkeypatch, capsys):
    def refuse(args):
        raise NodeError(1, "is not homed; type: canprobe home 'a cell' --bus socketcan")

    monkeypatch.setattr("canprobe.cli.plan.run", refuse)
    assert main(["plan", "my cell.toml", "--cell", "puma560"]) == 3
    assert capsys.readouterr().err == (
        "canprobe: node 1: is not homed; type: canprobe home 'my cell.toml' --cell puma560 --bus socketcan\n"
    )


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["--bitrate", "1000000"], "--set bus.bitrate=1000000"),
        (["--seed=3"], "--set scene.seed=3"),
        (["--realtime"], "--set cycle.realtime=true"),
    ],
)
def test_an_option_of_other_commands_is_named_as_the_key_that_was_meant(words, meant, capsys):
    assert main(["plan", "free", *words]) == 2
    assert f"; did you mean {meant}?" in capsys.readouterr().err
    assert main(["plan", "free", *meant.split()]) == 0


@pytest.mark.parametrize(
    ("key", "given", "meant"),
    [
        ("object.radius_mm", 0.036, "36, for 0.036 metres"),
        ("bus.bitrate", 500, "500000, for 500 kbit/s"),
        ("bring_up.sdo_s", 500, "0.5, for 500 milliseconds"),
        ("sensor.full_scale_kpa", 100_000, "100, for 100000 Pa"),
        ("task.speed_mm_s", 300, None),
        ("object.radius_mm", -36, None),
        ("object.radius_mm", float("inf"), None),
    ],
)
def test_a_number_out_of_range_is_named_as_the_one_of_another_unit(key, given, meant, capsys):
    assert main(["plan", "cylinder", "--set", f"{key}={given}"]) == 2
    said = capsys.readouterr().err
    assert f"{key}: expected" in said
    assert f"; did you mean {meant}?" in said if meant else "did you mean" not in said


@pytest.mark.parametrize(
    ("value", "most", "least"),
    [(3.6949, "3.69", "3.7"), (0.3, "0.3", "0.3"), (112_999.0, "112000", "113000"), (9.999, "9.99", "10")],
)
def test_advised_numbers_are_rounded_to_the_safe_side(value, most, least):
    assert (at_most(value), at_least(value)) == (most, least)


def test_adapters_are_listed_with_what_each_lacks(capsys):
    assert main(["adapters", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["interface"] for one in document["interfaces"]] == list(BACKENDS)
    assert main(["adapters"]) == 0
    out = capsys.readouterr().out
    for one in document["interfaces"]:
        assert one["interface"] in out and all(lack in out for lack in one["missing"])
    assert all(one["type_next"] in out for one in document["found"])


def test_the_page_on_hardware_has_the_table():
    page = Path(__file__).parents[2] / "docs" / "hardware.md"
    rows = [line.strip("| \n").split(" | ") for line in page.read_text().splitlines() if line.startswith("| `")]
    table = {row[0].strip("`"): row for row in rows if row[0].strip("`") in BACKENDS}
    assert list(table) == list(BACKENDS)
    for name, backend in BACKENDS.items():
        _, hardware, channel, example, needs, *has, rates = table[name]
        assert (hardware, channel, example) == (backend.hardware, backend.channel, f"`{backend.example}`")
        assert (backend.package is None) or f"pip install 'python-can[{backend.extra}]'" in needs
        assert (backend.driver is None) or backend.driver.replace("sudo ", "") in needs
        assert backend.windows_only == ("Windows only" in needs)
        words = ({"fd", "fd-timing"}, {"filter"}, {"listen-only"}, {"errors"}, {"stamps"})
        assert [cell == "yes" for cell in has] == [bool(word & backend.features) for word in words]
        assert rates == (", ".join(f"{rate:g}" for rate in backend.bitrates_kbit) or "any")
