"""One drive that is led by SDO: without SYNC it is enabled, moved and stopped by requests, and polled.

The master's heartbeat goes on meanwhile, so that the drive notices when the master dies.
Source: CiA 402-2, controlword and statusword.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

from canprobe.cell.master.bringup import MODE_DISPLAY
from canprobe.cell.master.entries import read_entry, write_entry
from canprobe.cell.master.watch import NodeWatch
from canprobe.cell.planning.configuration import MODE
from canprobe.cell.planning.model import HEARTBEAT_PRODUCED_MS, MASTER_NODE_ID
from canprobe.cell.planning.node_configuration import NodeConfiguration, Write
from canprobe.cell.scene.hardware import BringUpSettings
from canprobe.errors import CanprobeError, NodeError
from canprobe.fieldbus.bus.port import nothing
from canprobe.fieldbus.bus.pumped import PumpedNetwork
from canprobe.fieldbus.bus.sdo import Dialogue, Dialogues
from canprobe.fieldbus.protocol.cia402 import (
    CONTROLWORD,
    DISABLED_STATES,
    STATUSWORD,
    UNPOWERED_STATES,
    DriveState,
    OperationMode,
    controlword_toward,
    describe_state,
    known_state,
)
from canprobe.fieldbus.protocol.frames import NmtState, pack_heartbeat

POLL_S = 0.01


class SdoLink:
    """Dialogues with one node after the other, and the master's heartbeats meanwhile.

    Args:
        network: pumped; the nodes are operational.
        watch: what the nodes report of themselves.
        times: time-outs and retries.
        supervise: called while time passes; it raises the error of whatever goes wrong.

    Attributes:
        beats: whether heartbeats are sent: nodes that have heard one expect more.
        attend: called as `supervise`, by whoever looks after the drive.
    """

    def __init__(
        self, network: PumpedNetwork, watch: NodeWatch, times: BringUpSettings, supervise: Callable[[], None]
    ) -> None:
        self.watch, self.times, self.clock = watch, times, network.port.clock
        self.beats, self._heartbeat_ns = False, 0
        self._network, self._supervise = network, supervise
        self.attend: Callable[[], None] = nothing

    def hold(self, node_id: int, dialogue: Dialogue) -> Any:
        """Hold a dialogue, and return its result."""
        results: list[Any] = []

        def held() -> Dialogue:
            results.append((yield from dialogue))

        timeout_s, retries = self.times.sdo_s, self.times.retries
        with Dialogues(self._network, {node_id: held()}, timeout_s=timeout_s, retries=retries) as dialogues:
            while waiting := dialogues.waiting:
                self.pump(lambda: bool(waiting[0].inbox), POLL_S)
                dialogues.serve()
        return results[0]

    def keep_alive(self) -> None:
        """Let a little time pass, such as while an operator thinks.

        Raises:
            CanprobeError: a node was lost or reports an error, or the bus fails.
        """
        self.pump(lambda: False, POLL_S)
        self._supervise()
        self.attend()

    def pump(self, done: Callable[[], bool], timeout_s: float) -> None:
        """Wait until `done`, with a heartbeat where one is due."""
        port = self._network.port
        if self.beats and (now_ns := port.clock.now_ns()) >= self._heartbeat_ns:
            self._heartbeat_ns = now_ns + HEARTBEAT_PRODUCED_MS * 1_000_000
            port.send_batch([pack_heartbeat(MASTER_NODE_ID, NmtState.OPERATIONAL)])
        self._network.pump_until(done, timeout_s)


class LedDrive:
    """A drive that is led by SDO.

    Args:
        setup: configuration of the drive.
        link: its SDO channel.
        say: called where the drive was stopped by an error.
    """

    def __init__(self, setup: NodeConfiguration, link: SdoLink, say: Callable[[str], None]) -> None:
        self.setup = setup
        self._link, self._say = link, say

    def read(self, index: int, subindex: int = 0) -> int:
        """The value of an entry."""
        return int(self._link.hold(self.setup.node_id, read_entry(self.setup, index, subindex)))

    def write(self, write: Write) -> None:
        """Write an entry, and read it back."""
        self._link.hold(self.setup.node_id, write_entry(self.setup, write))

    def command(self, word: int) -> None:
        """Write the controlword."""
        self.write(Write(CONTROLWORD, 0, word, "controlword", read_back=False))

    def error(self, what: str) -> NodeError:
        """The error of this drive, with its last EMCY."""
        return self.setup.error(f"{what}{self._link.watch.last_words(self.setup.node_id)}")

    def enable(self, mode: OperationMode) -> None:
        """Enable the drive in a mode."""
        self.write(Write(MODE, 0, mode, "mode of operation"))
        timeout_s, late = self._link.times.enable_s, f"is not in mode {mode} (6061h) after it was written to 6060h"
        self.wait_until(lambda: self.read(MODE_DISPLAY) == mode, timeout_s, lambda: late)
        enabled = DriveState.OPERATION_ENABLED
        self._lead(enabled, frozenset({enabled}), timeout_s)

    def wait_for_bits(
        self, bits: tuple[int, ...], timeout_s: float, what: str, late: str, *, error: int | None = None
    ) -> None:
        """Wait until the statusword has these bits; a time-out, the error bit or a drive that is off is an error."""
        wanted = sum(1 << bit for bit in bits)

        def reached() -> bool:
            word = self.read(STATUSWORD)
            if error is not None and word >> error & 1:
                raise self.error(f"could not {what}: its statusword (6041h) has bit {error}")
            if known_state(word) is not DriveState.OPERATION_ENABLED:
                raise self.error(f"could not {what}: it is {describe_state(word)}")
            return word & wanted == wanted

        self.wait_until(reached, timeout_s, lambda: late)

    def wait_until(
        self, reached: Callable[[], bool], timeout_s: float, late: Callable[[], str], *, supervised: bool = True
    ) -> None:
        """Wait, supervised or with heartbeats alone; `late` has the words of the error after the time-out."""
        until_ns = self._link.clock.now_ns() + round(timeout_s * 1e9)
        while not reached():
            if self._link.clock.now_ns() >= until_ns:
                raise self.error(late())
            if supervised:
                self._link.keep_alive()
            else:
                self._link.pump(lambda: False, POLL_S)

    @contextlib.contextmanager
    def left_disabled(self) -> Iterator[None]:
        """A context on every way out of which the drive is stopped, disabled, and in its mode of the cycle."""
        try:
            yield
        except BaseException:
            failure = self._stop()
            done = "is stopped and disabled" if failure is None else f"could not be stopped ({failure})"
            self._say(f"{self.setup.name} {done}; it is not homed")
            raise
        if failure := self._stop():
            raise failure

    def _stop(self) -> CanprobeError | None:
        """Stop, disable, and leave homing; an interrupt repeats it once. A failure is returned."""
        for _ in range(2):
            try:
                stop_s = self._link.times.stop_s
                with contextlib.suppress(NodeError):  # by 605Ah it may stay in quick stop
                    self._lead(DriveState.QUICK_STOP_ACTIVE, UNPOWERED_STATES, stop_s, supervised=False)
                self._lead(DriveState.SWITCH_ON_DISABLED, DISABLED_STATES, stop_s, supervised=False)
                if self.setup.mode is not None:
                    self.write(Write(MODE, 0, self.setup.mode, "mode of operation"))
            except KeyboardInterrupt:
                continue
            except CanprobeError as error:
                return error
            return None
        return None

    def _lead(
        self, goal: DriveState, states: frozenset[DriveState], timeout_s: float, *, supervised: bool = True
    ) -> None:
        """Bring the drive into one of some states."""
        word = previous = 0

        def arrived() -> bool:
            nonlocal word, previous
            word = self.read(STATUSWORD)
            state = known_state(word)
            if state in states:
                return True
            previous = 0 if state is None else controlword_toward(state, goal, previous)
            self.command(previous)
            return False

        def late() -> str:
            return f"is {describe_state(word)} {timeout_s:g} s after the command for {goal.name}"

        self.wait_until(arrived, timeout_s, late, supervised=supervised)
