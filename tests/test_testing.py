"""The pytest plugin: the project of docs/testing.md as a user copies it, and small tests run by a pytest inside."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import canopen
import pytest
from canopen.nmt import NmtError
from plugin_arguments import ARGUMENTS

import canprobe.fieldbus.tools.judged_bus  # noqa: F401 - a pytest inside forgets what it imported
from canprobe.cell.master.controller import Command
from canprobe.errors import BusError, InterfaceError, UsageError
from canprobe.fieldbus.eds.packaged import eds_path, load_eds

ROOT = Path(__file__).resolve().parent.parent
PROJECT = dict(
    re.findall(r'^```\w+ title="([^"]+)"\n(.*?)^```$', (ROOT / "docs" / "testing.md").read_text(), re.S | re.M)
)


BEGINNING = """import canprobe, pytest
from canprobe.fieldbus import eds_path
DRIVE = "puma260_joint"
"""


@pytest.fixture
def run_inside(pytester, monkeypatch):
    """Runs tests, given as text, in a pytest of their own."""
    for name in ("PYTEST_XDIST_WORKER", "CANPROBE_BUS", "CANPROBE_SEED"):
        monkeypatch.delenv(name, raising=False)

    def run(text, *words, outcomes, **files):
        pytester.makepyfile(f"{BEGINNING}{text}", **files)
        result = pytester.runpytest_inprocess(*ARGUMENTS, "-p", "no:cacheprovider", "-p", "no:xdist", *words)
        result.assert_outcomes(**outcomes)
        return result.stdout

    return run


@pytest.mark.slow(reason="makes an environment and runs pytest in it three times")
def test_the_project_of_the_page_works_when_copied(tmp_path):
    assert list(PROJECT) == ["drive_master.py", "test_drive_master.py", "pyproject.toml", ".github/workflows/tests.yml"]
    for name, text in PROJECT.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / ".venv"], check=True)
    packages = next((tmp_path / ".venv" / "lib").iterdir()) / "site-packages"
    places = [ROOT, *(path for path in sys.path if path.endswith("-packages"))]
    (packages / "here.pth").write_text("\n".join(map(str, places)))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    info = packages / f"canprobe-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: canprobe\nVersion: {project['version']}\n")
    points = "".join(f"{name} = {value}\n" for name, value in project["entry-points"]["pytest11"].items())
    (info / "entry_points.txt").write_text(f"[pytest11]\n{points}")

    for words, passed in (([], 4), (["--canprobe-bus", "virtual", "-k", "arrives"], 1)):
        command = [tmp_path / ".venv" / "bin" / "python", "-m", "pytest", "-q", *words]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0 and f"{passed} passed" in done.stdout, done.stdout


def test_nothing_heavy_is_imported_with_the_plugin():
    heavy = "{'can', 'canopen', 'numpy', 'scipy'}"
    script = (
        f"import sys, canprobe.testing; print(sorted({{name.partition('.')[0] for name in sys.modules}} & {heavy}))"
    )
    assert subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_a_failure_shows_seed_faults_and_the_last_frames(run_inside):
    out = run_inside(
        """
@pytest.mark.fault("node 1: heartbeat-off at 2 s for 1 s")
def test_it(emulated_nodes, canopen_network):
    emulated_nodes(DRIVE)
    canopen_network.add_node(1, str(eds_path(DRIVE))).sdo[0x1017].raw = 100
    canopen_network.pass_time(10.0)
    assert False
""",
        "--canprobe-seed=7",
        outcomes={"failed": 1},
    )
    lines = out.str().splitlines()
    start = next(number for number, line in enumerate(lines) if re.fullmatch(r"-+ canprobe -+", line))
    fault = "node 1: heartbeat-off seed=7 at 2 s for 1 s"
    expected = [
        "seed: 7",
        "faults:",
        f"  thrown: {fault}",
        f"  2.000000 s begins: {fault}",
        f"  3.000000 s ends: {fault}",
    ]
    assert lines[start + 1 : start + 6] == expected
    path, count = re.fullmatch(r"log: (\S+), (\d+) frames, the last ones:", lines[start + 6]).groups()
    log = Path(path).read_text().splitlines()
    assert len(log) == int(count) == 4 + 90, "boot-up, the write, its answer and the first heartbeat; 100 less 10"
    assert [line.strip() for line in lines[start + 7 : start + 57]] == log[-50:]
    assert log[-1] == "(0000000010.000000) can0 701#7F"


def test_what_may_be_chosen_and_what_goes_before_what(run_inside, monkeypatch, pytester):
    text = """
def test_it(canprobe_seed, canprobe_bus): assert (canprobe_seed, canprobe_bus) == ({seed}, "{bus}")
"""
    run_inside(text.format(seed=0, bus="lockstep"), outcomes={"passed": 1})
    pytester.makeini("[pytest]\ncanprobe_seed = 1\ncanprobe_bus = virtual")
    run_inside(text.format(seed=1, bus="virtual"), outcomes={"passed": 1})
    monkeypatch.setenv("CANPROBE_SEED", "2")
    run_inside(text.format(seed=2, bus="virtual"), outcomes={"passed": 1})
    run_inside(text.format(seed=3, bus="virtual"), "--canprobe-seed", "3", outcomes={"passed": 1})
    marked = "@pytest.mark.canprobe(seed=4)" + text.format(seed=4, bus="virtual")
    run_inside(marked, "--canprobe-seed", "3", outcomes={"passed": 1})
    overridden = "import pytest\n@pytest.fixture\ndef canprobe_seed(): return 5\n"
    run_inside(text.format(seed=5, bus="virtual"), "--canprobe-seed", "3", outcomes={"passed": 1}, conftest=overridden)


@pytest.fixture(scope="session")
def vcan():
    """All tests here share one, and come one after the other."""
    return "vcan0"


@pytest.mark.parametrize("canprobe_bus", ["lockstep", "virtual", pytest.param("vcan", marks=pytest.mark.vcan)])
def test_the_same_test_on_each_bus_with_nodes_that_are_added_one_by_one(
    emulated_nodes, emulated_bus, canopen_network, faults
):
    first, second = emulated_nodes("puma260_joint", "puma260_joint")
    (third,) = emulated_nodes(eds_path("puma260_joint"), first_id=9)
    assert (first.node_id, second.node_id, third.node_id) == (1, 2, 9)
    node = canopen_network.add_node(9, str(eds_path("puma260_joint")))
    assert node.sdo[0x1018][1].raw == 51806
    faults.inject("sdo-abort", node=9, index=0x6060, code=0x06090030)
    with pytest.raises(canopen.SdoAbortedError, match="0x06090030"):
        node.sdo[0x6060].raw = 8
    faults.clear()
    node.sdo[0x6060].raw = 8
    node.sdo[0x1017].raw = 10
    assert node.nmt.wait_for_heartbeat(5) == "PRE-OPERATIONAL"
    with pytest.raises(UsageError, match="node 2 is on this bus already"):
        emulated_nodes("puma260_joint", first_id=2)
    with pytest.raises(UsageError, match="unknown kind 'mote'"):
        faults.inject("mote", node=9)
    emulated_bus.flush()
    log = emulated_bus.log.read_text()
    assert [
        text for text in ("701#00", "702#00", "709#00", "609#2F60600008000000", "589#80606000300009") if text not in log
    ] == []


@pytest.mark.parametrize("canprobe_bus", ["lockstep", "virtual", pytest.param("vcan", marks=pytest.mark.vcan)])
def test_the_log_has_each_frame_while_the_test_runs(emulated_nodes, emulated_bus, canopen_network):
    emulated_nodes("puma260_joint", first_id=4)
    node = canopen_network.add_node(4, str(eds_path("puma260_joint")))
    assert node.sdo[0x1000].raw == 0x20192
    canopen_network.pass_time(0.2)
    assert "604#4000100000000000\n" in emulated_bus.log.read_text()
    frames = emulated_bus.frames()
    assert [(can_id, data) for can_id, data, _ in frames[:2]] == [(0x704, b"\0"), (0x604, b"\x40\0\x10\0\0\0\0\0")]
    assert all(t_ns >= 0 for *_, t_ns in frames)


@pytest.mark.parametrize("canprobe_bus", ["lockstep", "virtual", pytest.param("vcan", marks=pytest.mark.vcan)])
def test_values_and_errors_of_a_device_are_set_by_the_test(emulated_nodes, emulated_bus, canopen_network):
    drive, array = emulated_nodes("puma260_joint", "tactile_array")
    node = canopen_network.add_node(2, str(eds_path("tactile_array")))
    node.nmt.state = "OPERATIONAL"
    errors = []
    node.emcy.add_callback(lambda error: errors.append(error.code))
    array[0x2100, 1] = 9
    assert node.sdo[0x2100][1].raw == array[0x2100, 1] == 9
    array.emcy(0x5000, b"\1\2")
    array.emcy(0x5000)
    assert node.sdo[0x1001].raw & 1 and node.sdo[0x1003][1].raw & 0xFFFF == 0x5000
    array.emcy(0)
    drive.emcy(0x4310)
    canopen_network.pass_time(0.05)
    assert errors == [0x5000, 0]
    assert node.sdo[0x1001].raw == 0
    sent = [(can_id, data) for can_id, data, _ in emulated_bus.frames() if 0x80 < can_id < 0x100]
    assert sent == [(0x82, b"\x00\x50\x01\x01\x02\0\0\0"), (0x82, bytes(8)), (0x81, b"\x10\x43\x09\0\0\0\0\0")]
    with pytest.raises(UsageError, match=r"node 2: its EDS has no 6041h:00"):
        array[0x6041] = 1
    with pytest.raises(UsageError, match=r"node 1: 6041h:00: expected a number of 16 bits, unsigned, got -1"):
        drive[0x6041] = -1


def test_a_value_that_a_test_sets_is_an_event(emulated_nodes, emulated_bus, canopen_network, faults):
    (drive,) = emulated_nodes("puma260_joint")
    node = canopen_network.add_node(1, str(eds_path("puma260_joint")))
    for subindex, value in ((1, 0x80000281), (2, 255)):
        node.sdo[0x1801][subindex].raw = value
    node.sdo[0x1A01][0].raw = 0
    node.sdo[0x1A01][1].raw = 0x603F0010
    node.sdo[0x1A01][0].raw = 1
    node.sdo[0x1801][1].raw = 0x281
    node.nmt.state = "OPERATIONAL"
    drive[0x603F] = 0x7300
    assert emulated_bus.frames()[-1][:2] == (0x281, b"\x00\x73")
    faults.inject("mute", node=1)
    drive[0x603F] = 0x7500
    assert emulated_bus.frames()[-1][1] != b"\x00\x75", "a mute node says nothing of it"


def test_what_canopen_waits_for_passes_virtual_time(emulated_nodes, canopen_network, faults):
    emulated_nodes("puma260_joint")
    node = canopen_network.add_node(1, load_eds("puma260_joint", 1))
    clock = canopen_network.port.clock
    node.nmt.state = "OPERATIONAL"
    node.sdo[0x1017].raw = 500
    assert node.nmt.wait_for_heartbeat(1) == "OPERATIONAL"
    faults.inject("heartbeat-off", node=1, for_s=3)
    with pytest.raises(NmtError):
        node.nmt.wait_for_heartbeat(2)
    faults.inject("emcy", node=1, code=0x5000, at_s=0.2)
    assert node.emcy.wait(timeout=1).code == 0x5000
    faults.inject("sdo-slow", node=1, ms=250)
    before_ns = clock.now_ns()
    assert node.sdo[0x1018][1].raw == 51806
    assert clock.now_ns() - before_ns == 250_000_000
    faults.clear()
    faults.inject("sdo-slow", node=1, ms=350)
    with pytest.raises(canopen.SdoCommunicationError):
        node.sdo[0x1018][1].raw  # noqa: B018


MASTER = """
@pytest.fixture
def move(emulated_nodes, canopen_network):
    emulated_nodes(DRIVE)
    sdo = canopen_network.add_node(1, str(eds_path(DRIVE))).sdo
    def move(read_mode):
        sdo[0x6060].raw = 1
        if read_mode:
            assert sdo[0x6061].raw == 1
        for word in (0x06, 0x07, 0x0F):
            sdo[0x6040].raw = word
            sdo[0x6041].raw
        canopen_network.pass_time(0.1)
    return move
"""


def test_a_master_is_judged_where_a_test_asks_for_it(run_inside):
    out = run_inside(
        f"""{MASTER}
def test_good(judge, move): move(True)
def test_bad(judge, move): move(False)
def test_not_judged(move): move(False)
def test_allowed(judge, move):
    judge.allow(4)
    move(False)
    assert [row.name[:2] for row in judge.report().rows if row.verdict == "FAIL"] == ["04"]
""",
        outcomes={"passed": 4, "errors": 1},
    )
    out.fnmatch_lines(
        ["*rules that the master broke:*", "FAIL * 04 mode not confirmed", "* hint: *", "(0.000000) 601#*"]
    )
    out.fnmatch_lines(["ERROR *::test_bad*"])


@pytest.mark.canprobe(scene="free", seed=3)
@pytest.mark.fault("node 2: drive-fault on enabled")
def test_a_cell_is_stopped_for_the_fault_of_a_marker(lockstep_cell):
    with pytest.raises(BusError, match="node 2") as stopped:
        lockstep_cell.run()
    assert stopped.value.summary["seed"] == 3
    assert (lockstep_cell.folder / "bus.log").stat().st_size > 0


def test_a_controller_is_tested_on_a_cell(lockstep_cell):
    seen = []

    def step(measurement):
        seen.append(measurement.cycle)
        return Command(done=len(seen) == 20)

    result = lockstep_cell.run(step)
    assert result.summary["completed"] and result.summary["seed"] == 0 and len(seen) == 20
    assert lockstep_cell.run(None, {"task.duration_s": 0.1}).summary["sim_time_s"] < 0.5
    assert not (lockstep_cell.folder / "report.png").exists()


def test_a_fault_that_could_not_be_thrown_fails_its_test(run_inside):
    out = run_inside(
        """
@pytest.mark.fault("node 3: mute")
def test_no_such_node(emulated_nodes): emulated_nodes(DRIVE)

@pytest.mark.fault("node 3: mute")
def test_no_nodes(): pass
""",
        outcomes={"passed": 1, "errors": 2},
    )
    out.fnmatch_lines(["*never thrown, as no such node was powered on: node 3: mute*"])
    out.fnmatch_lines(["*the marker fault needs the fixture emulated_nodes*"])


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("node 1: mote", "*unknown kind 'mote'*"),
        ("node 1: delay mss=2", "*unknown parameter 'mss'*"),
        ("node 1: mute on enabeld", "*unknown event 'enabeld'*"),
        ("node 3: sdo-silen", "*unknown kind 'sdo-silen'; did you mean sdo-silent*"),
    ],
)
def test_an_unknown_fault_is_unknown_before_its_node_is_there(run_inside, text, told):
    text = f'@pytest.mark.fault("{text}")\ndef test_no_nodes(faults): pass'
    out = run_inside(text, outcomes={"errors": 1})
    out.fnmatch_lines([told])
    out.no_fnmatch_line("*never thrown*")


def test_real_devices_and_emulated_ones_do_not_meet(run_inside):
    text = """
@pytest.mark.hardware
def test_hardware(): pass
def test_emulated(emulated_nodes): emulated_nodes(DRIVE)
"""
    run_inside(text, outcomes={"skipped": 1, "passed": 1})
    out = run_inside(text, "--canprobe-bus=neovi", "--canprobe-channel=1", outcomes={"passed": 1, "errors": 1})
    out.fnmatch_lines(["*emulated nodes would answer beside the devices of neovi*"])


def test_a_vcan_of_each_worker_or_a_skip_that_says_what_to_type(run_inside, monkeypatch):
    wanted = []

    def check_interface(channel, setting=None):
        wanted.append(channel)
        raise InterfaceError(f"{channel}: no such interface; type: ip link add dev {channel} type vcan")

    has_socketcan = "canprobe.fieldbus.bus.real.socketcan.has_socketcan"
    monkeypatch.setattr(has_socketcan, lambda: True)
    monkeypatch.setattr("canprobe.fieldbus.bus.real.socketcan.check_interface", check_interface)
    text = """
@pytest.mark.needs_vcan
def test_marked(): pass
def test_asked(vcan): pass
"""
    out = run_inside(text, "-rs", outcomes={"skipped": 2})
    out.fnmatch_lines(["*vcan0: no such interface; type: ip link add dev vcan0 type vcan; or run the tests where *"])
    monkeypatch.setenv("PYTEST_XDIST_WORKER", "gw2")
    run_inside(text, "--canprobe-channel=vcan5", outcomes={"skipped": 2})
    assert wanted == ["vcan0", "vcan0", "vcan7", "vcan7"]
    out = run_inside(text, "-rs", "--canprobe-channel=can0", outcomes={"skipped": 2})
    out.fnmatch_lines(["*can2 is no vcan; name one: --canprobe-channel vcan0*"])
    monkeypatch.setattr("canprobe.fieldbus.bus.real.socketcan.check_interface", lambda channel, setting=None: None)
    run_inside(text, outcomes={"passed": 2})
    monkeypatch.setattr(has_socketcan, lambda: False)
    with_fault = '@pytest.mark.fault("node 1: mute")\ndef test_bus(emulated_nodes): emulated_nodes(DRIVE)'
    out = run_inside(with_fault, "-rs", "--canprobe-bus=vcan", outcomes={"skipped": 1})
    out.fnmatch_lines(["*vcan2: this kernel has no SocketCAN; run the tests where there is one: canprobe vcan -- *"])
