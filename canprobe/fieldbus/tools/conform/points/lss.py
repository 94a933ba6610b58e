"""Points 66 to 70 and 73: LSS, on a bus where the device is alone. Source: CiA 305, "LSS services".

Nothing is stored and no bit timing is activated: the device keeps its id and its bit rate.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from canprobe.fieldbus.protocol import lss
from canprobe.fieldbus.protocol.lss import LssCommand, LssState
from canprobe.fieldbus.tools.conform.bench import Bench
from canprobe.fieldbus.tools.conform.point import PointGroup

point = PointGroup("lss", "CiA 305", needs="alone")
_NO_BIT_RATE = 5
"""Index of table 0 that is reserved."""
_ANSWER_S = 0.2


def _ask(bench: Bench, message: bytes, *, silent: bool = False) -> bytes | None:
    """Send a message; return the answer, None where none comes."""
    bench.taken(lss.LSS_ANSWER_ID)
    bench.send(lss.LSS_REQUEST_ID, message)
    frame = bench.next(lss.LSS_ANSWER_ID, bench.times.silence_s if silent else _ANSWER_S)
    if frame is not None and len(frame.data) != lss.LSS_BYTES:
        bench.deviates(f"an LSS answer has {len(frame.data)} bytes, expected {lss.LSS_BYTES}")
    return None if frame is None else frame.data


def _address(bench: Bench) -> tuple[int, ...]:
    bench.need((0x1018, 1), (0x1018, 2), (0x1018, 3), (0x1018, 4), written=False)
    return tuple(bench.device.number(0x1018, n) for n in (1, 2, 3, 4))


def _select(bench: Bench, numbers: tuple[int, ...]) -> bytes | None:
    """Ask for the slave with these numbers; the answer to the last."""
    for n, number in enumerate(numbers[:3]):
        if _ask(bench, lss.pack_number(LssCommand(LssCommand.SELECT_VENDOR + n), number), silent=True) is not None:
            bench.deviates(f"number {n + 1} of switch state selective is answered, expected after number 4")
    return _ask(bench, lss.pack_number(LssCommand.SELECT_SERIAL, numbers[3]))


def _release(bench: Bench) -> None:
    bench.send(lss.LSS_REQUEST_ID, lss.pack_lss(LssCommand.SWITCH_GLOBAL, bytes((LssState.WAITING,))))
    bench.pass_time(0.01)


@contextmanager
def _configuration(bench: Bench) -> Iterator[None]:
    """The device in configuration state; back in waiting state afterwards.

    Raises:
        PointNotApplicable: it does not speak LSS.
    """
    answer = _select(bench, _address(bench))
    try:
        bench.require(answer is not None, "the device does not answer switch state selective, which is point 66")
        yield
    finally:
        _release(bench)


@point(66, "switch state selective", "switch state selective", "44h from the one address alone")
def switch_selective(bench: Bench) -> None:
    """The address of the device, and one with another serial number."""
    numbers = _address(bench)
    if _select(bench, (*numbers[:3], numbers[3] ^ 1)) is not None:
        _release(bench)
        bench.deviates("another serial number is answered")
    if _select(bench, numbers) is None:
        description = bench.device.description
        if description is not None and description.od.device_information.LSS_supported:
            bench.deviates("no answer to its own numbers; the EDS says LSS_Supported=1")
        bench.does_not_apply("the device does not speak LSS")
    answer = _ask(bench, lss.pack_lss(LssCommand.INQUIRE_NODE_ID))
    _release(bench)
    bench.expect(answer is not None, "the device answers no inquiry after it was selected")
    if _ask(bench, lss.pack_lss(LssCommand.INQUIRE_NODE_ID), silent=True) is not None:
        bench.deviates("an inquiry is answered in waiting state")


@point(67, "identify remote slave", "identify remote slave", "4Fh inside the ranges only")
def identify(bench: Bench) -> None:
    """Ranges round the address, and a range of serial numbers beside it."""
    vendor, product, revision, serial = _address(bench)
    with _configuration(bench):
        pass
    for low, high, inside in ((serial, serial, True), ((serial ^ 1) & ~2, (serial ^ 1) & ~2, False)):
        numbers = (vendor, product, revision, revision, low, high)
        for n, number in enumerate(numbers[:5]):
            bench.send(lss.LSS_REQUEST_ID, lss.pack_number(LssCommand(LssCommand.IDENTIFY_VENDOR + n), number))
        answer = _ask(bench, lss.pack_number(LssCommand.IDENTIFY_SERIAL_HIGH, numbers[5]), silent=not inside)
        if inside and (answer is None or answer[0] != LssCommand.IDENTIFIED):
            bench.deviates("the device does not answer identify remote slave with its own numbers")
        bench.expect(inside or answer is None, "the device answers identify remote slave outside the range")


@point(68, "only without an id", "identify non-configured, fastscan", "a device with an id is silent")
def only_without_id(bench: Bench) -> None:
    """Questions to devices without an id."""
    with _configuration(bench):
        pass
    for message in (lss.pack_lss(LssCommand.IDENTIFY_UNCONFIGURED), lss.pack_fastscan(0, lss.PRESENCE_CHECK, 0, 0)):
        if _ask(bench, message, silent=True) is not None:
            bench.deviates(f"command {message[0]:02X}h is answered although the device has an id")


@point(69, "configure node-ID", "configure node-ID", "0 and 128: error 1; the own id: no error")
def configure_node_id(bench: Bench) -> None:
    """Ids that are none, then its own, which changes nothing."""
    with _configuration(bench):
        for node_id, refused in ((0, True), (128, True), (bench.node_id, False)):
            answer = _ask(bench, lss.pack_lss(LssCommand.CONFIGURE_NODE_ID, bytes((node_id,))))
            if answer is None or answer[0] != LssCommand.CONFIGURE_NODE_ID or bool(answer[1]) != refused:
                got = "no answer" if answer is None else answer.hex(" ")
                bench.deviates(f"configure node-ID {node_id}: {got}, expected {'an' if refused else 'no'} error")


@point(70, "configure bit timing", "configure bit timing", "a reserved rate: error 1")
def configure_bit_timing(bench: Bench) -> None:
    """A reserved index; nothing is activated."""
    with _configuration(bench):
        answer = _ask(bench, lss.pack_lss(LssCommand.CONFIGURE_BIT_TIMING, bytes((0, _NO_BIT_RATE))))
        if answer is not None and (answer[0] != LssCommand.CONFIGURE_BIT_TIMING or not answer[1]):
            bench.deviates(f"a reserved bit rate is answered with {answer.hex(' ')}, expected an error")
        bench.expect(answer is not None, "no answer to configure bit timing")


@point(73, "inquire", "inquire services", "the four numbers of 1018h and the node-ID")
def inquire(bench: Bench) -> None:
    """All five inquiries."""
    numbers = _address(bench)
    with _configuration(bench):
        for n, number in enumerate(numbers):
            command = LssCommand(LssCommand.INQUIRE_VENDOR + n)
            answer = _ask(bench, lss.pack_lss(command))
            if answer is None or answer[:5] != lss.pack_number(command, number)[:5]:
                bench.deviates(f"inquiry {command:02X}h does not give {number:#x} of 1018h:{n + 1:02X}")
        answer = _ask(bench, lss.pack_lss(LssCommand.INQUIRE_NODE_ID))
        bench.expect(answer and answer[1] == bench.node_id, "the inquiry of the node-ID does not give the id")
