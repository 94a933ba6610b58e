"""Points 93 to 98: frames that are no service of the device. It ignores them, and works on.

Source: CiA 301, "Service data object" (eight bytes), "Restricted CAN-IDs"; ISO 11898-1 (formats).
"""

from __future__ import annotations

from canprobe.fieldbus.protocol import frames
from canprobe.fieldbus.protocol.lss import LSS_REQUEST_ID
from canprobe.fieldbus.protocol.pdo import RPDOS, TPDOS
from canprobe.fieldbus.protocol.sdo import pack_request
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.point import PointGroup
from canprobe.fieldbus.tools.conform.sdo_client import READ_TYPE

point = PointGroup("hostile", "CiA 301")
format_point = PointGroup("hostile", "ISO 11898-1")
_FD_BYTES = 12
_PACE_S = 0.02


@point(93, "SDO of every length", "SDO: eight bytes", "0 to 7 bytes are not answered")
def sdo_lengths(bench: Bench) -> None:
    """A request cut to 0 to 7 bytes. Some devices answer shorter requests on purpose, which is noted."""
    answered = [length for length in range(8) if not bench.ignores(bench.request_id, READ_TYPE[:length])]
    bench.expect(not any(length < 4 for length in answered), f"requests of {answered} bytes are answered")
    if answered:
        bench.notes.append(f"requests of {answered} bytes are answered, as for old PLCs")
    bench.serves("short requests")


@point(94, "remote requests", "CAN data frames", "remote requests for SDO and EMCY are ignored")
def remote_requests(bench: Bench) -> None:
    """Remote requests under every identifier of the device but guarding and TPDOs."""
    for can_id in (bench.request_id, bench.answer_id, frames.EMCY_BASE + bench.node_id):
        bench.expect(bench.ignores(can_id | frames.RTR_FLAG), f"a remote request for {can_id:03X}h is answered")
    bench.serves("remote requests")


@point(95, "29-bit frames", "CAN base frames", "frames with 29 bits are another device's", needs="alone nmt")
def extended_frames(bench: Bench) -> None:
    """The identifiers of SDO and NMT in 29 bits, as they are and above the 11 bits."""
    bench.watch_state()
    for shift in (0, 18):
        can_id = bench.request_id << shift | frames.EFF_FLAG
        if not bench.ignores(can_id, READ_TYPE):
            bench.deviates(f"an SDO request with identifier {can_id & ~frames.EFF_FLAG:08X}h is answered")
        bench.send(frames.NMT_ID << shift | frames.EFF_FLAG, bytes((frames.NmtCommand.STOP, bench.node_id)))
        if (state := bench.state()) != frames.NmtState.PRE_OPERATIONAL:
            bench.deviates(f"an NMT command in 29 bits leads to state {state:02X}h")
    bench.serves("29-bit frames")


@point(96, "every SDO command", "SDO command specifiers", "an answer of eight bytes or none; then it serves")
def every_command(bench: Bench) -> None:
    """All 256 command bytes with 1000h, which cannot be written; what may begin a transfer is aborted."""
    value = bench.device.values.get((0x1000, 0), bytes(4))
    for command in range(256):
        bench.taken(bench.answer_id)
        if command >> 5 == 1 and command & 2 and (4 - (command >> 2 & 3) if command & 1 else 4) != len(value):
            continue  # a value that is shorter than that of 1000h
        bench.send(bench.request_id, pack_request(command, 0x1000, 0, value))
        frame = bench.next(bench.answer_id, _PACE_S)
        if frame is not None and len(frame.data) != 8:
            bench.deviates(f"command {command:02X}h is answered with {len(frame.data)} bytes")
    bench.abort(0x1000)
    while not bench.is_silent():
        pass  # answers that come late
    bench.serves("all command bytes")


@format_point(97, "CAN FD frames", "FD format", "an FD frame is no SDO request", needs="alone")
def fd_frames(bench: Bench) -> None:
    """A request in a frame of twelve bytes, where the bus carries such frames."""
    bench.require(bench.fd, "the bus carries no CAN FD frames")
    if not bench.ignores(bench.request_id, READ_TYPE.ljust(_FD_BYTES, b"\0")):
        bench.deviates("an SDO request of twelve bytes is answered")
    bench.serves("CAN FD frames")


@point(99, "own frames", "CAN base frames", "data frames with 11 bits only", needs="alone")
def own_frames(bench: Bench) -> None:
    """What came so far, where nobody else is on the bus."""
    if bench.odd_ids:
        texts = [f"{can_id:08X}h" for can_id in sorted(bench.odd_ids)]
        bench.deviates(f"remote requests or frames with 29 bits come: {', '.join(texts[:4])} (with flags)")


@point(
    98,
    "identifiers of nobody",
    "CAN identifiers",
    "frames of every length under other identifiers are ignored",
    needs="alone nmt",
)
def other_identifiers(bench: Bench) -> None:
    """Every 16th identifier that is no service of the device, with 0 to 8 bytes."""
    bench.watch_state()
    own = {*bench.device.valid_pdos(RPDOS), *bench.device.valid_pdos(TPDOS)}
    lengths = 0
    for can_id in range(0x103, 0x7E0, 16):
        is_service = can_id & ~0x7F in (frames.HEARTBEAT_BASE, frames.SDO_RX_BASE)
        if is_service or can_id & 0x7F == bench.node_id or can_id in own:
            continue
        bench.send(can_id, bytes(range(lengths % 9)))
        lengths += 1
    for length in range(8):
        bench.send(LSS_REQUEST_ID, bytes(length))
    bench.pass_time(0.01)
    if (state := bench.state()) != frames.NmtState.PRE_OPERATIONAL:
        bench.deviates(f"state {state:02X}h after frames under identifiers of nobody")
    bench.serves("frames under identifiers of nobody")
