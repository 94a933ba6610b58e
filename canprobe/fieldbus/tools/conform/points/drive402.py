"""Points 48 to 55: CiA 402 drives. Source: CiA 402-2, "Finite state automaton", "Modes of operation".

Without `--motion` the power stage stays off: 6041h and 6502h are read. With it the automaton is walked through with the
target at the actual position, so that the axis holds; homing takes the present position as home.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveCommand, DriveState, OperationMode
from canprobe.fieldbus.protocol.sdo import Abort
from canprobe.fieldbus.tools.conform import accepted
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import SdoRefused

point = PointGroup("drive402", "CiA 402-2", needs="drive")
AUTOMATON = "finite state automaton"
_WORDS = {command: pattern for _, pattern, command in cia402.CONTROLWORD_PATTERNS}
_WAY_UP = (DriveCommand.SHUTDOWN, DriveCommand.SWITCH_ON, DriveCommand.ENABLE_OPERATION)
_STATES = tuple(DriveState)[1:5]
"""States on the way up, from SWITCH_ON_DISABLED to OPERATION_ENABLED."""
_REACH_S = 2.0
_PRESENT_POSITION = (37, 35)
"""Homing methods that take the present position as home."""


def _reach(bench: Bench, state: DriveState, what: str) -> None:
    """Wait for a state of the drive. Raises Deviation."""
    until_ns = bench.now_ns + round(_REACH_S * 1e9)
    while cia402.known_state(word := bench.number(cia402.STATUSWORD)) is not state:
        found = cia402.describe_state(word)
        bench.expect(bench.now_ns < until_ns, f"{what}: the drive is {found}, expected {state.name}")
        bench.pass_time(0.01)


def _command(bench: Bench, command: DriveCommand) -> None:
    bench.put(cia402.CONTROLWORD, 0, _WORDS[command], 2)


@contextmanager
def _at_rest(bench: Bench, mode: int = 0) -> Iterator[None]:
    """The drive switched off in a mode, with its target where it is; switched off afterwards, whatever happens."""
    modes = _supported(bench)
    mode = mode or next((m for m in (OperationMode.PROFILE_POSITION, 8, 9, 10, 3, 7) if modes >> m - 1 & 1), 0)
    bench.require(mode and (not modes or modes >> mode - 1 & 1), f"6502h does not list mode {mode}")
    _off(bench)
    bench.put(cia402.MODE, 0, mode, 1)
    bench.put(cia402.TARGET_POSITION, 0, bench.number(cia402.POSITION), 4)
    try:
        yield
    finally:
        _off(bench)


def _supported(bench: Bench) -> int:
    """6502h; 0 where the drive has none."""
    try:
        return int.from_bytes(bench.upload(cia402.SUPPORTED_MODES), "little")
    except SdoRefused:
        return 0


def _off(bench: Bench) -> None:
    """Disable the voltage, and reset a fault that is there."""
    bench.put(cia402.CONTROLWORD, 0, 0, 2)
    if cia402.known_state(bench.number(cia402.STATUSWORD)) is DriveState.FAULT:
        bench.does_not_apply("the drive is in FAULT; reset it first")
    _reach(bench, DriveState.SWITCH_ON_DISABLED, "disable voltage")


def _go(bench: Bench, state: DriveState) -> None:
    _off(bench)
    for command in _WAY_UP[: _STATES.index(state)]:
        _command(bench, command)
    _reach(bench, state, "on the way up")


@point(48, "statusword", "6041h", "the bits of a state, the power stage off")
def statusword(bench: Bench) -> None:
    """The bits of 6041h are those of a state."""
    word = bench.number(cia402.STATUSWORD)
    bench.expect(cia402.known_state(word) is not None, f"6041h is {word:04X}h, which is no state")


@point(53, "supported modes", "6502h", "6061h shows one of them or 0; what differs from the EDS is noted")
def supported_modes(bench: Bench) -> None:
    """6502h beside the EDS, and the mode that 6061h shows."""
    entry = bench.device.described(cia402.SUPPORTED_MODES)
    bench.require(entry is not None or bench.device.description is None, "the EDS describes no 6502h")
    modes = bench.number(cia402.SUPPORTED_MODES)
    if entry is not None and isinstance(entry.default, int) and entry.default and entry.default != modes:
        bench.notes.append(f"6502h is {modes:08X}h, the EDS says {entry.default:08X}h")
    mode = bench.number(cia402.MODE_DISPLAY)
    if 0 < mode < 33 and not modes >> mode - 1 & 1:
        bench.deviates(f"6061h shows mode {mode}, which 6502h does not list")


@point(53, "mode display", "6060h 6061h", "6061h follows 6060h; other modes are refused", needs="motion")
def mode_display(bench: Bench) -> None:
    """Every mode from 1 to 10, with the power stage off."""
    modes = _supported(bench)
    _off(bench)
    for mode in range(1, 11):
        if not modes >> mode - 1 & 1:
            codes = (*accepted.VALUE, Abort.PARAMETER_INCOMPATIBLE, Abort.UNSUPPORTED_ACCESS)
            what = f"mode {mode}, which 6502h does not list"
            bench.must_refuse_write(cia402.MODE, 0, bytes((mode,)), codes, what)
            continue
        bench.put(cia402.MODE, 0, mode, 1)
        bench.pass_time(0.05)
        bench.expect((shown := bench.number(cia402.MODE_DISPLAY)) == mode, f"6061h is {shown} after mode {mode}")


@point(49, "transitions", AUTOMATON, "every command leads where the table says", needs="motion")
def transitions(bench: Bench) -> None:
    """Every command that does something, in every state up to operation enabled; quick stop is point 51."""
    with _at_rest(bench):
        for (source, command), goal in cia402.TRANSITIONS.items():
            if source not in _STATES or command not in _WORDS or goal is DriveState.QUICK_STOP_ACTIVE:
                continue
            _go(bench, source)
            _command(bench, command)
            if (source, command) == (DriveState.READY_TO_SWITCH_ON, DriveCommand.ENABLE_OPERATION):
                goal = DriveState.OPERATION_ENABLED  # noqa: PLW2901 - through switched on, by itself
            _reach(bench, goal, f"{command.name} in {source.name}")


@point(50, "illegal commands", AUTOMATON, "commands without a transition change nothing", needs="motion")
def illegal_commands(bench: Bench) -> None:
    """Commands that have no transition, in the states below operation enabled."""
    with _at_rest(bench):
        for source in (DriveState.SWITCH_ON_DISABLED, DriveState.READY_TO_SWITCH_ON, DriveState.SWITCHED_ON):
            for command in _WORDS:
                if (source, command) in cia402.TRANSITIONS:
                    continue
                _go(bench, source)
                _command(bench, command)
                bench.pass_time(0.05)
                _reach(bench, source, f"{command.name} in {source.name}")


@point(51, "quick stop", "605Ah", "5 to 8 stay in quick stop active, others switch off", needs="motion")
def quick_stop(bench: Bench) -> None:
    """Quick stop at rest, with the option that the drive has."""
    option = bench.number(0x605A) if bench.device.described(0x605A) is not None else 2
    stays = option in (5, 6, 7, 8)
    with _at_rest(bench):
        _go(bench, DriveState.OPERATION_ENABLED)
        _command(bench, DriveCommand.QUICK_STOP)
        goal = DriveState.QUICK_STOP_ACTIVE if stays else DriveState.SWITCH_ON_DISABLED
        _reach(bench, goal, f"quick stop with 605Ah = {option}")


@point(54, "handshake of profile position", "profile position", "bit 12 follows bit 4 of 6040h", needs="motion")
def handshake(bench: Bench) -> None:
    """A set-point where the axis is: it is acknowledged, and the acknowledgement goes with bit 4."""
    with _at_rest(bench, OperationMode.PROFILE_POSITION):
        _go(bench, DriveState.OPERATION_ENABLED)
        for word, acknowledged in ((0x1F, 1), (0x0F, 0)):
            bench.put(cia402.CONTROLWORD, 0, word, 2)
            bench.pass_time(0.05)
            if (found := bench.number(cia402.STATUSWORD) >> cia402.SETPOINT_ACKNOWLEDGE_BIT & 1) != acknowledged:
                bench.deviates(f"bit 12 of 6041h is {found} after controlword {word:04X}h")


@point(55, "homing", "homing", "bit 12 comes, bit 13 does not", needs="motion")
def homing(bench: Bench) -> None:
    """Method 37 or 35, which takes the present position as home."""
    with _at_rest(bench, OperationMode.HOMING):
        if not any(bench.takes(cia402.HOMING_METHOD, 0, method) for method in _PRESENT_POSITION):
            bench.does_not_apply("the drive has no homing method that takes the present position")
        _go(bench, DriveState.OPERATION_ENABLED)
        bench.put(cia402.CONTROLWORD, 0, 0x1F, 2)
        until_ns = bench.now_ns + round(_REACH_S * 1e9)
        while not (word := bench.number(cia402.STATUSWORD)) >> cia402.HOMING_ATTAINED_BIT & 1:
            if word >> cia402.HOMING_ERROR_BIT & 1 or bench.now_ns >= until_ns:
                bench.deviates(f"homing is not attained: 6041h is {word:04X}h")
            bench.pass_time(0.01)
        bench.expect(not word >> cia402.HOMING_ERROR_BIT & 1, f"homing is attained with an error: 6041h is {word:04X}h")
