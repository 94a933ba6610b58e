"""A CiA 402 drive on one axis of the plant: states, faults and options; what a mode does is in `drive_modes`.

Outside operation enabled the drive holds. It stops by itself when the master dies: in the cyclic modes when SYNC or
targets are missing, in all modes when the heartbeat is. A change of mode under way slows the motion down by 6084h
until the new mode is given a target.
Source: CiA 402-2 (IEC 61800-7-201), finite state automaton, modes of operation.
"""

from __future__ import annotations

from canopen.objectdictionary import ObjectDictionary

from canprobe.eds import has_missed_syncs
from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.application import Application
from canprobe.emulator.drive_feedback import DriveFeedback
from canprobe.emulator.drive_mode import DriveParts
from canprobe.emulator.drive_modes import make_modes, supported_bits
from canprobe.emulator.drive_motion import STEP_NS, AxisPlant, Motion
from canprobe.emulator.drive_parameters import STAYS_STOPPED, DriveParameters
from canprobe.emulator.drive_states import DriveStates
from canprobe.emulator.drive_supervision import Supervision
from canprobe.emulator.drive_units import FACTORS
from canprobe.emulator.entries import Value, key_of
from canprobe.emulator.node import SlaveNode
from canprobe.protocol import cia402
from canprobe.protocol.cia402 import POWERED_STATES, Command, DriveState, Event
from canprobe.protocol.emcy import FOLLOWING_ERROR, HEARTBEAT_LOST
from canprobe.protocol.frames import NmtState

_TARGET, _STATUSWORD = key_of(0x607A), key_of(0x6041)
_VOLATILE = frozenset({0x6040, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60FF})
_ABORT_COMMANDS = {2: Command.DISABLE_VOLTAGE, 3: Command.QUICK_STOP}  # of 6007h; 1 is a fault, 0 nothing
_ENABLED = DriveState.OPERATION_ENABLED


class DriveApplication(Application):
    """The drive function of one node."""

    def __init__(self, axis: int, plant: AxisPlant, has_misses: bool = False) -> None:
        """Make the drive of one axis.

        Args:
            axis: of the plant, 0-based.
            plant: shared with the other nodes.
            has_misses: see `DriveParameters`.
        """
        self._has_misses = has_misses
        self._axis, self._plant = axis, plant
        self._faults: list[int] = []
        self._following_error = self._standstill = False
        self._enabled_ns = 0
        self._word = 0
        self._word_waits = False

    def attach(self, node: SlaveNode) -> None:
        """Hang the drive's objects on the node."""
        self._node, self._core = node, node.core
        self._values, dictionary, timers = node.dictionary.values, node.dictionary, node.core.timers
        self._parameters = DriveParameters(dictionary, self._has_misses)
        self._motion = Motion(self._axis, self._plant, timers)
        self._feedback = DriveFeedback(node, self._axis, self._plant, self._motion, self._parameters.units)
        self._states = DriveStates(self._entered_state, lambda: self._parameters.quick_stop in STAYS_STOPPED)
        self._supervision = Supervision(node, self._parameters, self._abort_connection)
        self._modes = make_modes(self._parts())
        self._active = self._modes[0]
        self._pass_on = timers.new(self._states.pass_on)
        self._fault_timer = timers.new(self._raise_injected)
        self._word_timer = timers.new(self._take_word)
        node.store.volatile |= _VOLATILE
        for index in FACTORS:
            dictionary.on_check(index, self._check_not_moving)
        dictionary.on_check(0x6060, self._check_mode)
        dictionary.on_write(0x6060, lambda _sub, value: self._select_mode(int(value)))
        dictionary.on_write(0x6040, self._controlword)
        dictionary.on_read(0x6041, lambda _sub: self._take_word(self._core.now_ns))

    def _parts(self) -> DriveParts:
        return DriveParts(
            node=self._node,
            axis=self._axis,
            plant=self._plant,
            parameters=self._parameters,
            motion=self._motion,
            feedback=self._feedback,
            supervision=self._supervision,
            show=self._show,
            fault=self._fault,
        )

    @property
    def state(self) -> DriveState:
        """State of the finite state automaton."""
        return self._states.state

    def inject_fault(self, code: int) -> None:
        """Let the drive detect a fault now: EMCY `code`, fault reaction, fault. Goes out at the next `advance`."""
        self._faults.append(code)
        self._fault_timer.arm(self._core.now_ns)

    # ------------------------------------------------------------------ the node's events

    def reset(self, t_ns: int) -> None:
        """Power on: brake closed, faults and home forgotten."""
        self._faults.clear()
        self._following_error = self._standstill = self._word_waits = False
        self._word = 0
        self._node.dictionary.put(0x6502, 0, supported_bits(self._modes))
        self._node.dictionary.put(0x603F, 0, 0)
        self._parameters.read()
        for mode in self._modes.values():
            mode.reset()
        self._feedback.reset(t_ns)
        self._motion.hold(t_ns)
        self._show_mode(self._node.dictionary.number(0x6060))
        self._states.reset(t_ns)

    def entered(self, t_ns: int) -> None:
        """NMT stop and the resets abort the connection; bit 9 follows operational."""
        if self._core.state in (NmtState.STOPPED, NmtState.INITIALISING):
            self.connection_lost(t_ns)
        self._show()

    def advance(self, t_ns: int) -> None:
        """The plant moves on."""
        self._plant.advance(t_ns)

    def connection_lost(self, t_ns: int) -> None:
        """Act by 6007h."""
        self._abort_connection(HEARTBEAT_LOST, t_ns)

    def sync(self, t_ns: int, counter: int) -> None:
        """The mode watches and latches, one SYNC after it was enabled at the earliest."""
        counts = self._feedback.measure(t_ns)
        if self._word_waits:
            self._take_word(t_ns)
        if self._states.state is _ENABLED and t_ns > self._enabled_ns:
            self._active.sync(t_ns, counts)

    # ------------------------------------------------------------------ controlword and mode

    def _controlword(self, subindex: int, value: Value) -> None:
        """States change at once; the bits of the mode wait until all values of the same PDO are stored."""
        states = self._states
        if value == states.idle_word:
            return  # as in every cycle of operation
        word, now_ns = int(value), self._core.now_ns
        if word == self._word:
            states.controlword(word, now_ns)
            return
        self._take_word(now_ns)
        self._word = word
        enabled = states.state is _ENABLED
        states.controlword(word, now_ns)
        if enabled and states.state is _ENABLED:
            self._word_waits = True
            self._word_timer.arm(now_ns)

    def _take_word(self, t_ns: int) -> None:
        waits, self._word_waits = self._word_waits, False
        self._word_timer.cancel()
        if waits and self._states.state is _ENABLED:
            self._active.command(self._word, t_ns)

    def _select_mode(self, mode: int) -> None:
        t_ns, new = self._core.now_ns, self._modes[mode]
        if new is not self._active and self._states.state is _ENABLED:
            self._active.leave(t_ns)
            self._motion.decelerate(t_ns, self._parameters.deceleration)
            self._show_mode(mode)
            self._start_mode(t_ns)
        self._show_mode(mode)

    def _show_mode(self, mode: int) -> None:
        self._active = self._modes.get(mode, self._modes[0])
        self._node.dictionary.put(0x6061, 0, mode if mode in self._modes else 0)
        self._show()

    def _start_mode(self, t_ns: int) -> None:
        self._enabled_ns = t_ns
        self._supervision.start(self._active.target, t_ns)
        self._active.start(self._word, t_ns)

    def _check_mode(self, subindex: int, value: Value) -> None:
        if value not in self._modes:
            raise SdoAbort(Abort.VALUE)

    def _check_not_moving(self, subindex: int, value: Value) -> None:
        if self._states.state in POWERED_STATES:
            raise SdoAbort(Abort.DEVICE_STATE)

    # ------------------------------------------------------------------ states

    def _entered_state(self, old: DriveState, new: DriveState, t_ns: int) -> None:
        self._standstill = False
        if old is _ENABLED:
            self._active.leave(t_ns)
        if new is _ENABLED:
            self._enable(t_ns)
        elif new is DriveState.QUICK_STOP_ACTIVE:
            self._motion.decelerate(t_ns, self._parameters.quick_stop_rate, self._stopped)
        elif new is DriveState.FAULT_REACTION_ACTIVE:
            self._motion.decelerate(t_ns, self._parameters.fault_rate, self._reacted)
        elif old is _ENABLED:
            self._disable(new, t_ns)
        elif new is DriveState.SWITCHED_ON:
            self._pass_on.arm(t_ns + STEP_NS)
        elif old is DriveState.FAULT:
            self._forget_fault()
        elif old is DriveState.QUICK_STOP_ACTIVE and self._motion.busy:
            self._motion.hold(t_ns)
        if new is not _ENABLED:
            self._supervision.stop()
        self._show()

    def _enable(self, t_ns: int) -> None:
        here = self._motion.hold(t_ns)
        self._values[_TARGET] = round(self._parameters.units.position(here))
        self._start_mode(t_ns)

    def _disable(self, new: DriveState, t_ns: int) -> None:
        """605Bh and 605Ch: on the slow-down ramp (1) or by the brake at once (0); disable voltage is the brake."""
        options = {
            DriveState.READY_TO_SWITCH_ON: self._parameters.shutdown,
            DriveState.SWITCHED_ON: self._parameters.disable,
        }
        rate = self._parameters.deceleration if options.get(new) == 1 else 0
        if rate:
            self._motion.decelerate(t_ns, rate)
        else:
            self._motion.hold(t_ns)

    def _stopped(self, t_ns: int) -> None:
        if self._parameters.quick_stop in STAYS_STOPPED:
            self._standstill = True
            self._show()
        else:
            self._states.event(Event.QUICK_STOP_DONE, t_ns)

    def _reacted(self, t_ns: int) -> None:
        self._states.event(Event.FAULT_REACTION_DONE, t_ns)

    # ------------------------------------------------------------------ faults

    def _abort_connection(self, code: int, t_ns: int) -> None:
        option = self._parameters.abort_connection
        if self._states.state is not _ENABLED:
            return
        if option == 1:
            self._fault(code, t_ns)
        elif command := _ABORT_COMMANDS.get(option):
            self._states.force(command, t_ns)

    def _fault(self, code: int, t_ns: int) -> None:
        self._faults.append(code)
        self._following_error = self._following_error or code == FOLLOWING_ERROR
        self._node.dictionary.put(0x603F, 0, code)
        self._node.emcy.report(code)
        self._states.event(Event.FAULT_DETECTED, t_ns)

    def _raise_injected(self, due_ns: int) -> None:
        codes, self._faults = self._faults, []
        for code in codes:
            self._fault(code, due_ns)

    def _forget_fault(self) -> None:
        for code in self._faults:
            self._node.emcy.clear(code)
        self._faults.clear()
        self._following_error = False
        self._node.dictionary.put(0x603F, 0, 0)

    def _show(self) -> None:
        state = self._states.state
        word = (
            cia402.statusword_of(state)
            | 1 << cia402.VOLTAGE_ENABLED
            | (self._core.state is NmtState.OPERATIONAL) << cia402.REMOTE
            | self._standstill << cia402.TARGET_REACHED
            | self._following_error << cia402.FOLLOWING_ERROR
        )
        if state is _ENABLED:
            word |= self._active.status() | self._active.limited << cia402.INTERNAL_LIMIT
        if word != self._values.get(_STATUSWORD):
            self._node.dictionary.put(0x6041, 0, word)
            self._node.pdos.event(0x6041)


def make_drive_node(od: ObjectDictionary, node_id: int, axis: int, plant: AxisPlant) -> SlaveNode:
    """A drive node on one axis of the plant.

    Args:
        od: of `puma260_joint.eds` or another CiA 402 EDS, for this node id.
        node_id: 1–127.
        axis: of the plant, 0-based.
        plant: shared by all nodes.
    """
    return SlaveNode(od, node_id, DriveApplication(axis, plant, has_missed_syncs(od)))
