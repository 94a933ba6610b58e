"""The bench as points use it: entries by value, NMT states, EMCY that must come, SYNC."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import NoReturn

from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.protocol.emcy import Emcy, describe, is_no_error
from canprobe.fieldbus.protocol.frames import NMT_GOALS, NMT_ID, RTR_FLAG, SYNC_ID, NmtCommand, NmtState
from canprobe.fieldbus.protocol.sdo import place_text
from canprobe.fieldbus.tools.conform.device import ExaminedDevice
from canprobe.fieldbus.tools.conform.frame_link import BenchTimes
from canprobe.fieldbus.tools.conform.outcome import Deviation, PointNotApplicable
from canprobe.fieldbus.tools.conform.permits import Permits
from canprobe.fieldbus.tools.conform.sdo_client import READ_TYPE, SdoClient, SdoRefused

HEARTBEAT_MS = 50
"""Period of the heartbeat by which points see the NMT state."""
COMMANDS: dict[NmtState, NmtCommand] = {NMT_GOALS[command]: command for command in tuple(NmtCommand)[:3]}
QUEUED_NS = 5_000_000
"""Time in which frames may still come that were queued before a change of the state."""


class Bench(SdoClient):
    """The bench.

    Args:
        port: connection to the bus.
        device: the device.
        permits: gate for what is sent.
        times: how long is waited.

    Attributes:
        bitrate: bit rate of the bus, bit/s.
        fd: whether the bus carries CAN FD frames.
        distributions: measured times by name, ms.
        first_answer: answer to the first read of 1000h, by which is seen that the device serves.
        by_hand: function that asks a person to do something, and returns whether it was done.
        asked: codes of EMCY messages that the point provoked; others fail it.
        standing: codes of errors that the device had before the first point; no point fails for them.
        kept_out: why the device cannot be brought to operational; empty: it can.
    """

    def __init__(self, port: Port, device: ExaminedDevice, permits: Permits, times: BenchTimes) -> None:
        super().__init__(port, device.node_id, permits, times)
        self.device, self.bitrate, self.fd = device, 1_000_000, False
        self.notes = []
        self.asked: set[int] = set()
        self.standing: set[int] = set()
        self.kept_out = ""
        self.distributions: dict[str, tuple[float, ...]] = {}
        self.first_answer = b""
        self.by_hand: Callable[[str], bool] = lambda _: False
        self._changed_ns = 0

    def number(self, index: int, subindex: int = 0) -> int:
        """Read an entry as an unsigned number. Raises Deviation where the device refuses."""
        try:
            return int.from_bytes(self.upload(index, subindex), "little")
        except SdoRefused as refused:
            raise Deviation(f"reading {refused}") from refused

    def put(self, index: int, subindex: int, value: int, size: int = 0) -> None:
        """Write a number in the size of the entry. Raises Deviation where the device refuses."""
        try:
            self.download(index, subindex, self.packed(index, subindex, value, size))
        except SdoRefused as refused:
            raise Deviation(f"writing {value:#x} to {refused}") from refused

    def takes(self, index: int, subindex: int, value: int) -> bool:
        """Whether the device takes a number."""
        with contextlib.suppress(SdoRefused):
            self.download(index, subindex, self.packed(index, subindex, value))
            return True
        return False

    def packed(self, index: int, subindex: int, value: int, size: int = 0) -> bytes:
        """A number in the size of an entry that the device has."""
        size = size or len(self.device.values.get((index, subindex), b""))
        self.require(size, f"the device has no {place_text(index, subindex)}")
        return (value & (1 << 8 * size) - 1).to_bytes(size, "little")

    def need(self, *places: tuple[int, int], written: bool = True) -> None:
        """Check that the device has entries, and lets them be written. Raises PointNotApplicable."""
        for place in places:
            self.require(self.device.has(*place), f"the device has no {place_text(*place)}")
            writable = not written or self.device.writable(*place)
            self.require(writable, f"{place_text(*place)} cannot be written, says the EDS")

    def serves(self, what: str) -> None:
        """Check that a read of 1000h is answered as ever. Raises Deviation."""
        if (answer := self.ask(READ_TYPE)) != self.first_answer:
            self.deviates(f"1000h is answered with {answer.hex(' ')} after {what}")

    def expect(self, holds: object, text: str) -> None:
        """Fail the point unless something holds."""
        if not holds:
            raise Deviation(text)

    def require(self, holds: object, why: str) -> None:
        """End the point unless something holds, without which it cannot be examined on this device."""
        if not holds:
            raise PointNotApplicable(why)

    def deviates(self, text: str) -> NoReturn:
        """Fail the point."""
        raise Deviation(text)

    def does_not_apply(self, why: str) -> NoReturn:
        """End the point, which cannot be examined on this device."""
        raise PointNotApplicable(why)

    def nmt(self, command: int) -> int:
        """Send an NMT command to the device; return when. Raises PointNotApplicable where it cannot be followed."""
        self.require(command != NmtCommand.START or not self.kept_out, f"it needs operational: {self.kept_out}")
        self._changed_ns = self.send(NMT_ID, bytes((command, self.node_id)))
        return self._changed_ns

    def start(self) -> None:
        """Start the device, and let it get ready."""
        self.nmt(NmtCommand.START)
        self.pass_time(0.01)

    def watch_state(self) -> None:
        """Let the device report its state: by heartbeat, or where it has none by guarding.

        Raises:
            PointNotApplicable: it has neither.
        """
        if self.device.writable(0x1017):
            self.put(0x1017, 0, HEARTBEAT_MS)
        elif not self.device.number(0x1017) and self.guarded() is None:
            raise PointNotApplicable("the device reports its state neither by heartbeat nor by guarding")

    def state(self) -> int:
        """NMT state as the device reports it now; call `watch_state` before."""
        period_ms = HEARTBEAT_MS if self.device.writable(0x1017) else self.device.number(0x1017)
        if not period_ms:
            state = self.guarded()
            return self.deviates("no answer to guarding") if state is None else state & 0x7F
        self.taken(self.beat_id)
        for frame in self.coming(self.beat_id, 3e-3 * period_ms + self.times.slack_s):
            if len(frame.data) == 1 and frame.data[0] and frame.t_ns > self._changed_ns + QUEUED_NS:
                return frame.data[0]
        self.deviates(f"no heartbeat within three periods of {period_ms} ms")

    def guarded(self) -> int | None:
        """Answer to guarding: state and toggle bit; None where none comes."""
        self.taken(self.beat_id)
        self.send(self.beat_id | RTR_FLAG)
        frame = self.next(self.beat_id, self.times.silence_s + self.times.slack_s)
        return frame.data[0] if frame is not None and len(frame.data) == 1 else None

    def go(self, state: NmtState) -> None:
        """Command a state, and check that the device reports it; call `watch_state` before."""
        self.nmt(COMMANDS[state])
        if (found := self.state()) != state:
            self.deviates(f"NMT {COMMANDS[state].name.lower()} leads to state {found:02X}h, expected {state:02X}h")

    def settle(self, state: NmtState) -> int:
        """Command a state without looking at it; what was queued before has come when this returns the time of it."""
        t_ns = self.nmt(COMMANDS[state])
        self.pass_time(2 * QUEUED_NS * 1e-9)
        return t_ns

    def reset(self, command: NmtCommand = NmtCommand.RESET_COMMUNICATION) -> int:
        """Reset the device, and wait for its boot-up message; return when it came. Raises Deviation."""
        self.taken(self.beat_id)
        self.nmt(command)
        for frame in self.coming(self.beat_id, self.times.boot_s):
            if frame.data == b"\0":
                return frame.t_ns
        self.deviates(f"no boot-up message within {self.times.boot_s:g} s of {command.name.lower().replace('_', ' ')}")

    def emcy(self, code: int, within_s: float = 0.0) -> tuple[Emcy, int]:
        """An EMCY message that must come; return it and its time. Raises Deviation."""
        self.asked.add(code)
        until_ns = self.now_ns + round((within_s + self.times.slack_s) * 1e9)
        while True:
            for found in self.emergencies:
                if found[0].code == code:
                    self.emergencies.remove(found)
                    return found
            if self.now_ns >= until_ns:
                self.deviates(f"no EMCY {code:04X}h ({describe(code)}) came")
            self.pass_time(min(0.005, (until_ns - self.now_ns) * 1e-9))

    def optional_emcy(self, code: int, within_s: float) -> int:
        """Time of an EMCY message that a device may leave out. Raises PointNotApplicable where it does not come."""
        try:
            return self.emcy(code, within_s)[1]
        except Deviation as error:
            raise PointNotApplicable("the device does not report it; CiA 301 leaves that open") from error

    def errors(self) -> list[Emcy]:
        """EMCY messages that have come and report an error."""
        self.pass_time(0)
        return [emcy for emcy, _ in self.emergencies if not is_no_error(emcy.code)]

    def unasked(self) -> list[Emcy]:
        """EMCY messages that report an error nobody asked for; all are taken."""
        found = [emcy for emcy in self.errors() if emcy.code not in self.asked | self.standing]
        self.emergencies.clear()
        return found

    def sync(self, counter: int | None = None) -> int:
        """Send a SYNC, with a counter or without one; return when."""
        return self.send(SYNC_ID, b"" if counter is None else bytes((counter,)))

    def sync_and_wait(self) -> int:
        """Send a SYNC, and let what it brings come; return when it was sent."""
        t_ns = self.sync()
        self.pass_time(self.times.slack_s)
        return t_ns
