"""The pytest plugin: test your own master, firmware or controller against emulated nodes.

It is loaded where canprobe is installed, and costs a test session nothing until a fixture is asked for: everything
but this file is imported then.

    def test_position(emulated_nodes, canopen_network, faults):
        emulated_nodes("drive.eds")
        drive = canopen_network.add_node(1, "drive.eds")
        faults.inject("sdo-slow", node=1, ms=200)
        ...

What a test gets is made for it alone. What may be chosen stands in a fixture that a conftest.py overrides, an option
``--canprobe-NAME``, an environment variable ``CANPROBE_NAME``, or a key ``canprobe_NAME`` of the ini file; the first of
them in this order counts. docs/testing.md lists all of it.
"""

from __future__ import annotations

import os
import re
from collections import deque
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import pytest

if TYPE_CHECKING:
    import canopen

    from canprobe.cell.results.lockstep_cell import LockstepCell
    from canprobe.fieldbus.tools.emulated_bus import EmulatedBus, EmulatedNode
    from canprobe.fieldbus.tools.faults.injection import PlannedFaults
    from canprobe.fieldbus.tools.faults.motor_faults import FaultyMotor
    from canprobe.fieldbus.tools.judged_bus import JudgedBus

LOCKSTEP, VCAN = "lockstep", "vcan"
EMULATED_INTERFACES = (LOCKSTEP, VCAN, "virtual", "udp_multicast")
"""Buses that hold no devices but emulated ones."""
_FRAMES_SHOWN = 50


class _Choice(NamedTuple):
    default: str
    metavar: str
    help: str


_CHOICES = {
    "bus": _Choice(LOCKSTEP, "BUS", "lockstep (virtual time), vcan, or an interface of python-can"),
    "channel": _Choice("", "CHANNEL", "its channel; by default the vcan of the worker, or canprobe-WORKER"),
    "bitrate": _Choice("1000000", "BIT/S", "its bit rate, where the interface needs one"),
    "node": _Choice("1", "ID", "node id of the first node"),
    "eds": _Choice("", "FILE", "EDS file of the nodes, where a test names none"),
    "seed": _Choice("0", "N", "seed of faults and emulation"),
    "log": _Choice("", "DIR", "folder for the candump log of each test; by default pytest's temporary one"),
}
_MARKERS = (
    "canprobe(scene=, seed=): scene of the fixture lockstep_cell, and seed of this test",
    'fault(text): throw a fault when the nodes are powered on, such as "node 3: mute at 1 s"',
    "needs_vcan: skip this test where there is no vcan",
    "hardware: run this test only on a bus with real devices (--canprobe-bus and --canprobe-channel)",
)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add an option and an ini key for each choice."""
    group = parser.getgroup("canprobe")
    for name, choice in _CHOICES.items():
        text = f"{choice.help} [{choice.default or 'none'}]"
        group.addoption(f"--canprobe-{name}", metavar=choice.metavar, default=None, help=text)
        parser.addini(f"canprobe_{name}", text, default=None)


def pytest_configure(config: pytest.Config) -> None:
    """Register the markers."""
    for marker in _MARKERS:
        config.addinivalue_line("markers", marker)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Skip what needs a vcan or a real bus where there is none."""
    if item.get_closest_marker("needs_vcan") is not None and (why := _missing_vcan(item.config)):
        pytest.skip(why)
    if item.get_closest_marker("fault") is not None and "faults" not in getattr(item, "fixturenames", ()):
        pytest.fail("the marker fault needs the fixture emulated_nodes, lockstep_cell or faults", pytrace=False)
    if item.get_closest_marker("hardware") is not None and _chosen(item.config, "bus") in EMULATED_INTERFACES:
        pytest.skip("needs real devices; type: pytest --canprobe-bus socketcan --canprobe-channel can0")


class _Record:
    """What the failure of a test shows: its seed, its faults, and the last frames of its buses."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.faults: PlannedFaults | None = None
        self.start_ns = 0
        self.logs: list[Callable[[], Path]] = []

    def text(self) -> str:
        lines = [f"seed: {self.seed}"]
        if self.faults is not None:
            lines += ["faults:", *(f"  {line}" for line in self.faults.timeline(self.start_ns))]
        for flushed in self.logs:
            path = flushed()
            count, last = 0, deque[str](maxlen=_FRAMES_SHOWN)
            if path.is_file():
                with path.open(encoding="ascii") as file:
                    for count, frame in enumerate(file, 1):  # noqa: B007 - the number of all
                        last.append(frame)
            lines += [f"log: {path}, {count} frames, the last ones:", *(f"  {frame.rstrip()}" for frame in last)]
        return "\n".join(lines)


_RECORD = pytest.StashKey[_Record]()
_PASSED = pytest.StashKey[bool]()
"""Whether the test itself has passed, before what its fixtures say at its end."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add a section to the report of a failure."""
    report = yield
    record = item.stash.get(_RECORD, None)
    item.stash[_PASSED] = report.when == "call" and report.passed
    if report.failed and record is not None:
        report.sections.append(("canprobe", record.text()))
    return report


@pytest.fixture
def canprobe_bus(pytestconfig: pytest.Config) -> str:
    """Kind of the bus: ``lockstep``, ``vcan``, or an interface of python-can. Override it in a conftest.py."""
    return _chosen(pytestconfig, "bus")


@pytest.fixture
def canprobe_eds(pytestconfig: pytest.Config) -> str:
    """Name or path of the EDS file of nodes for which a test names none. Override it in a conftest.py."""
    return _chosen(pytestconfig, "eds")


@pytest.fixture
def canprobe_seed(request: pytest.FixtureRequest) -> int:
    """Seed of faults and emulation; the marker ``canprobe(seed=)`` goes before it. Override it in a conftest.py."""
    marked = _marked(request, "seed")
    return _chosen_number(request.config, "seed") if marked is None else int(marked)


@pytest.fixture(scope="session")
def vcan(pytestconfig: pytest.Config) -> str:
    """Name of a vcan that is up, one for each worker of pytest-xdist: vcan0, vcan1, …"""
    if why := _missing_vcan(pytestconfig):
        pytest.skip(why)
    return _vcan_channel(pytestconfig)


@pytest.fixture
def emulated_bus(request: pytest.FixtureRequest, canprobe_bus: str) -> Iterator[EmulatedBus]:
    """The bus of the test, with a candump log; `EmulatedBus.port` is for frames by hand."""
    from canprobe.fieldbus.tools.emulated_bus import ServedBus, VirtualTimeBus

    log = _folder(request) / "bus.log"
    bus: EmulatedBus
    if canprobe_bus == LOCKSTEP:
        bus = VirtualTimeBus(log)
    else:
        channel = _channel(request, canprobe_bus)
        interface = "socketcan" if canprobe_bus == VCAN else canprobe_bus
        bus = ServedBus(interface, channel, _chosen_number(request.config, "bitrate"), log)

    def flushed() -> Path:
        bus.flush()
        return log

    with bus:
        record = _record_of(request)
        record.start_ns = bus.start_ns
        record.logs.append(flushed)
        yield bus
        record.logs.remove(flushed)


@pytest.fixture
def emulated_nodes(
    request: pytest.FixtureRequest, canprobe_bus: str, canprobe_eds: str, faults: PlannedFaults
) -> Callable[..., list[EmulatedNode]]:
    """Puts emulated nodes on the bus of the test: ``emulated_nodes("drive.eds", "io.eds", first_id=3)``.

    A path is looked for beside the test first. Without a name `canprobe_eds` is taken. Of a node that it returns
    ``node[0x6401, 1] = 1234`` sets a value, as the device itself does, and ``node.emcy(0x5000)`` reports an error.
    """
    emulated_bus = _bus_without_devices(request, canprobe_bus)

    def add(*eds: str | Path, first_id: int | None = None) -> list[EmulatedNode]:
        from canprobe.errors import UsageError

        if not (files := eds or ((canprobe_eds,) if canprobe_eds else ())):
            raise UsageError(
                'emulated_nodes: expected an EDS file: emulated_nodes("drive.eds"), or --canprobe-eds FILE'
            )
        first = _chosen_number(request.config, "node") if first_id is None else first_id
        nodes = emulated_bus.add_nodes([(_beside(request, name), first + n) for n, name in enumerate(files)])
        faults.attach(emulated_bus.inject, emulated_bus.end, nodes)
        return nodes

    return add


@pytest.fixture
def emulated_motors(
    request: pytest.FixtureRequest, canprobe_bus: str, faults: PlannedFaults
) -> Callable[..., list[FaultyMotor]]:
    """Puts motors that speak no CANopen on the bus of the test: ``emulated_motors("damiao:dm4310", first_id=1)``.

    Motor 1 answers on 11h, motor 2 on 12h. Of a motor that it returns ``motor.motor.joint`` is what it turns.
    """
    emulated_bus = _bus_without_devices(request, canprobe_bus)

    def add(*names: str, first_id: int = 1) -> list[FaultyMotor]:
        from canprobe.fieldbus.motor.on_bus import motors_on_bus
        from canprobe.fieldbus.tools.faults.motor_faults import FaultyMotor

        ids = [first_id + n for n in range(len(names))]
        motors = [FaultyMotor(motor) for motor in motors_on_bus(names, ids, [0x10 + one for one in ids])]
        emulated_bus.power_on(motors)
        faults.attach(emulated_bus.inject, emulated_bus.end, motors)
        return motors

    return add


def _bus_without_devices(request: pytest.FixtureRequest, interface: str) -> EmulatedBus:
    if interface not in EMULATED_INTERFACES:
        why = f"emulated nodes would answer beside the devices of {interface}"
        pytest.fail(f"{why}: mark the test hardware, or take --canprobe-bus vcan", pytrace=False)
    return cast("EmulatedBus", request.getfixturevalue("emulated_bus"))


@pytest.fixture
def canopen_network(emulated_bus: EmulatedBus) -> canopen.Network:
    """A network of canopen-python on the bus of the test; ``pass_time(seconds)`` lets time pass on any bus."""
    return emulated_bus.network()


@pytest.fixture
def faults(request: pytest.FixtureRequest, canprobe_seed: int) -> Iterator[PlannedFaults]:
    """Throws faults at the emulated nodes of the test; those of markers are thrown when the nodes are powered on."""
    from canprobe.fieldbus.tools.faults.injection import PlannedFaults
    from canprobe.fieldbus.tools.faults.motor_faults import MOTOR_FAULTS

    if "lockstep_cell" in request.fixturenames:
        from canprobe.cell.emulated.array_faults import CELL_FAULTS as KINDS
    else:
        from canprobe.fieldbus.tools.faults.registry import BUS_FAULTS as KINDS
    thrown = PlannedFaults(canprobe_seed, {**MOTOR_FAULTS, **KINDS})
    _record_of(request).faults = thrown
    for marker in reversed(list(request.node.iter_markers("fault"))):
        thrown.inject(*marker.args, **marker.kwargs)
    yield thrown
    if thrown.waiting and request.node.stash.get(_PASSED, False):
        pytest.fail(f"never thrown, as no such node was powered on: {'; '.join(thrown.waiting)}", pytrace=False)


@pytest.fixture
def judge(request: pytest.FixtureRequest, emulated_bus: EmulatedBus) -> Iterator[JudgedBus]:
    """Judges the master on the bus of the test by the rules of ``canprobe judge``; what they find fails the test."""
    from canprobe.fieldbus.tools.judged_bus import JudgedBus
    from canprobe.fieldbus.tools.reports import row_text

    judged = JudgedBus(emulated_bus, _chosen_number(request.config, "bitrate"))
    yield judged
    if found := judged.findings():
        lines = [line for row in found for line in (row_text(row), f"       hint: {row.hint}", *row.came)]
        pytest.fail("\n".join(["rules that the master broke:", *lines]), pytrace=False)


@pytest.fixture
def lockstep_cell(request: pytest.FixtureRequest, canprobe_seed: int, faults: PlannedFaults) -> LockstepCell:
    """Runs the cell of the marker ``canprobe(scene=)`` in virtual time; by default the packaged scene ``free``."""
    from canprobe.cell.results.lockstep_cell import LockstepCell

    scene = _beside(request, _marked(request, "scene") or "free")
    cell = LockstepCell(scene, canprobe_seed, _folder(request), faults)
    _record_of(request).logs.append(lambda: cell.folder / "bus.log")
    return cell


def _chosen(config: pytest.Config, name: str) -> str:
    """What the user chose: the option, else the environment, else the ini file, else the default."""
    option, ini = config.getoption(f"--canprobe-{name}"), config.getini(f"canprobe_{name}")
    found = (option, os.environ.get(f"CANPROBE_{name.upper()}"), ini, _CHOICES[name].default)
    return str(next(value for value in found if value is not None))


def _chosen_number(config: pytest.Config, name: str) -> int:
    text = _chosen(config, name)
    try:
        return int(text, 0)
    except ValueError:
        raise pytest.UsageError(f"--canprobe-{name}: expected a whole number, got {text!r}") from None


def _marked(request: pytest.FixtureRequest, name: str) -> Any:
    """Value of the nearest marker `canprobe` that has it; None where none has."""
    return next((m.kwargs[name] for m in request.node.iter_markers("canprobe") if name in m.kwargs), None)


def _beside(request: pytest.FixtureRequest, name: str | Path) -> str | Path:
    """The file beside the test, if there is one; else the name as it is."""
    beside: Path = request.path.parent / name
    return beside if beside.is_file() else name


def _folder(request: pytest.FixtureRequest) -> Path:
    """A folder for what the test leaves."""
    name = re.sub(r"[^\w.-]+", "_", request.node.nodeid)
    if chosen := _chosen(request.config, "log"):
        folder = Path(chosen, name)
        folder.mkdir(parents=True, exist_ok=True)
        return folder
    factory: pytest.TempPathFactory = request.getfixturevalue("tmp_path_factory")
    return factory.mktemp(name[-60:])


def _record_of(request: pytest.FixtureRequest) -> _Record:
    """What the failure of this test will show."""
    seed = request.getfixturevalue("canprobe_seed")
    return cast(_Record, request.node.stash.setdefault(_RECORD, _Record(seed)))


def _worker() -> int | None:
    """Number of this worker of pytest-xdist, from 0; None without it."""
    match = re.fullmatch(r"gw(\d+)", os.environ.get("PYTEST_XDIST_WORKER", ""))
    return int(match[1]) if match else None


def _channel(request: pytest.FixtureRequest, bus: str) -> str:
    """Channel of the test's bus, if it is not in virtual time."""
    chosen, worker = _chosen(request.config, "channel"), _worker()
    if bus == VCAN:
        return cast(str, request.getfixturevalue("vcan"))
    if bus not in EMULATED_INTERFACES and worker is not None:
        raise pytest.UsageError(f"--canprobe-bus {bus}: its devices serve one test at a time; type: pytest -n0")
    if not chosen and bus != "virtual":
        raise pytest.UsageError(f"--canprobe-bus {bus}: expected its channel too: --canprobe-channel CHANNEL")
    return f"{chosen or 'canprobe'}-{worker or 0}" if bus == "virtual" else chosen


def _vcan_channel(config: pytest.Config) -> str:
    """Name of this worker's vcan: that of the user counted up."""
    name, number = re.fullmatch(r"(.*?)(\d*)", _chosen(config, "channel") or "vcan0").groups()  # type: ignore[union-attr]
    return f"{name}{int(number or 0) + (_worker() or 0)}"


def _missing_vcan(config: pytest.Config) -> str:
    """Why this worker has no vcan, and what to type; empty where it has one."""
    from canprobe.errors import InterfaceError
    from canprobe.fieldbus.bus.real.link import VIRTUAL_KINDS
    from canprobe.fieldbus.bus.real.socketcan import check_interface, has_socketcan

    channel = _vcan_channel(config)
    if not channel.startswith(VIRTUAL_KINDS):
        return f"{channel} is no vcan; name one: --canprobe-channel vcan0"
    elsewhere = "run the tests where there is one: canprobe vcan -- python -m pytest"
    if not has_socketcan():
        return f"{channel}: this kernel has no SocketCAN; {elsewhere}"
    try:
        check_interface(channel)
    except InterfaceError as error:
        return f"{error}; or {elsewhere}"
    return ""
