"""Points 1 to 7: NMT. Source: CiA 301, "Network management"."""

from __future__ import annotations

from canprobe.fieldbus.protocol.frames import NMT_ID, NmtCommand, NmtState
from canprobe.fieldbus.protocol.pdo import TPDOS
from canprobe.fieldbus.tools.conform.bench import QUEUED_NS
from canprobe.fieldbus.tools.conform.frame_link import CameFrame
from canprobe.fieldbus.tools.conform.pdo_bench import PdoBench
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import READ_TYPE

point = PointGroup("nmt", "CiA 301", needs="nmt")
_STATES = (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED)
_PACE_S = 0.02


@point(1, "boot-up", "NMT boot-up", "700h+id with 00h, then pre-operational")
def boot_up(bench: PdoBench) -> None:
    """After a reset the device announces itself once, and is pre-operational."""
    before = bench.boots
    bench.reset()
    bench.watch_state()
    state = bench.state()
    if state == NmtState.OPERATIONAL and not bench.device.number(0x1F80) & 4:
        bench.notes.append("the device starts by itself (1F80h)")
    elif state != NmtState.PRE_OPERATIONAL:
        bench.deviates(f"state {state:02X}h after the boot-up, expected 7Fh")
    bench.expect(bench.boots == before + 1, f"{bench.boots - before} boot-up messages after one reset")


@point(1, "power on", "NMT boot-up", "700h+id with 00h after the power came back")
def power_on(bench: PdoBench) -> None:
    """The device announces itself when it gets its power, which a person switches."""
    before = bench.boots
    if not bench.by_hand(f"switch node {bench.node_id} off and on, then confirm"):
        bench.does_not_apply("it needs somebody who switches the device off and on")
    bench.pass_time(bench.times.boot_s)
    bench.expect(bench.boots != before, "no boot-up message after the power came back")


@point(2, "reset communication", "NMT node control", "82h boots again from every state; 1017h has its power-on value")
def reset_communication(bench: PdoBench) -> None:
    """82h from pre-operational, operational and stopped."""
    bench.reset()
    default = bench.number(0x1017) if bench.device.has(0x1017) else 0
    for state in _STATES:
        bench.watch_state()
        bench.go(state)
        bench.reset()
        if bench.device.writable(0x1017) and (found := bench.number(0x1017)) != default:
            bench.deviates(f"1017h is {found} after the reset, {default} after the one before")


@point(2, "reset node", "NMT node control", "81h boots again from every state")
def reset_node(bench: PdoBench) -> None:
    """81h, where the user permits that application objects are reset."""
    for state in _STATES:
        if state is not NmtState.PRE_OPERATIONAL:
            bench.watch_state()
            bench.go(state)
        bench.reset(NmtCommand.RESET_NODE)


@point(3, "wrong commands", "NMT node control", "commands that do not exist, or of another length, change nothing")
def wrong_commands(bench: PdoBench) -> None:
    """In each state: unknown specifiers, and valid ones with a byte too many or too few."""
    wrong = [bytes((specifier, bench.node_id)) for specifier in (0x00, 0x03, 0x7F, 0x83, 0xFF)]
    wrong += [bytes((specifier, bench.node_id, 0)) for specifier in (0x01, 0x02, 0x80, 0x82)]
    short = [b"", b"\x01", b"\x02", b"\x80"] if bench.permits.surroundings.alone else []
    bench.watch_state()
    for state in _STATES:
        bench.go(state)
        for data in (*wrong, *short):
            bench.send(NMT_ID, data)
        bench.pass_time(2 * QUEUED_NS * 1e-9)
        if (found := bench.state()) != state:
            bench.deviates(f"state {found:02X}h after wrong commands in state {state:02X}h")


@point(4, "initialisation", "NMT initialisation", "nothing is served before the boot-up")
def initialisation(bench: PdoBench) -> None:
    """SDO requests from the reset on: none is answered before the boot-up message."""
    beat_id, answer_id = bench.beat_id, bench.answer_id
    bench.taken(beat_id)
    bench.taken(answer_id)
    started_ns = bench.nmt(NmtCommand.RESET_COMMUNICATION)
    frames: list[CameFrame] = []
    until_ns = started_ns + round(bench.times.boot_s * 1e9)
    while not any(frame.can_id == beat_id for frame in frames) and bench.now_ns < until_ns:
        bench.send(bench.request_id, READ_TYPE)
        bench.pass_time(_PACE_S)
        frames += [*bench.taken(answer_id), *(frame for frame in bench.taken(beat_id) if frame.data == b"\0")]
    booted_ns = next((frame.t_ns for frame in frames if frame.can_id == beat_id), None)
    if booted_ns is None:
        bench.deviates(f"no boot-up message within {bench.times.boot_s:g} s")
    # an answer right behind the command may have been under way, one right before the boot-up have won the arbitration
    between = range(started_ns + QUEUED_NS, booted_ns - QUEUED_NS)
    if early := [frame.t_ns for frame in frames if frame.can_id == answer_id and frame.t_ns in between]:
        after_ms, before_ms = (early[0] - started_ns) * 1e-6, (booted_ns - early[0]) * 1e-6
        bench.deviates(
            f"an SDO request is answered {after_ms:.1f} ms after the reset command and {before_ms:.1f} ms before the"
            " boot-up"
        )


@point(5, "stopped", "NMT stopped", "SDO requests are not answered in stopped")
def stopped(bench: PdoBench) -> None:
    """SDO is silent in stopped, and served again in pre-operational."""
    bench.watch_state()
    bench.go(NmtState.STOPPED)
    bench.expect(bench.ignores(bench.request_id, READ_TYPE), "an SDO request is answered in stopped")
    bench.go(NmtState.PRE_OPERATIONAL)
    bench.serves("the return to pre-operational")


@point(6, "PDOs", "NMT states", "TPDOs come in operational only: neither SYNC nor remote request brings one elsewhere")
def pdos_in_operational(bench: PdoBench) -> None:
    """SYNC and remote requests in pre-operational and stopped; frames that were queued before may still come."""
    tpdos = bench.device.valid_pdos(TPDOS)
    bench.require(tpdos, "the device has no valid TPDO")
    for state in (NmtState.PRE_OPERATIONAL, NmtState.STOPPED):
        bench.nmt(NmtCommand.START)
        changed_ns = bench.settle(state)
        with_sync = not bench.permits.surroundings.lacks("sync")
        for _ in range(2):
            if with_sync:
                bench.sync()
            bench.request_pdos(tpdos)
        bench.pass_time(bench.times.silence_s)
        frames = [frame for can_id in tpdos for frame in bench.taken(can_id) if frame.t_ns > changed_ns + QUEUED_NS]
        if frames:
            bench.deviates(f"TPDO {frames[0].can_id:03X}h comes in {state.name.lower().replace('_', '-')}")
    bench.nmt(NmtCommand.PRE_OPERATIONAL)


@point(7, "operational", "NMT state machine", "01h leads to operational, and the device stays there")
def reaches_operational(bench: PdoBench) -> None:
    """What was seen before the first point; points that need operational do not apply where it is not reached."""
    bench.expect(not bench.kept_out, f"{bench.kept_out}; end this error, and examine the device again")


@point(
    7,
    "transitions",
    "NMT state machine",
    "01h, 02h and 80h lead to their states from every state, and error control reports them",
)
def transitions(bench: PdoBench) -> None:
    """Every transition between the three states."""
    bench.watch_state()
    for before in _STATES:
        for after in _STATES:
            bench.go(before)
            bench.go(after)
    bench.go(NmtState.PRE_OPERATIONAL)
