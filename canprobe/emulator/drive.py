"""A CiA 402 drive in cyclic synchronous position mode, on one axis of the plant.

At a SYNC in operation enabled the target received since the last one is latched; the plant reaches it by a straight
ramp over 60C2h, at the next SYNC. Everywhere else the drive holds. It stops by itself when the master dies.
Not here yet: profile position, homing, cyclic velocity and torque; 6502h does not claim them.
Source: CiA 402-2 (IEC 61800-7-201), finite state automaton, cyclic synchronous position mode.
"""

from __future__ import annotations

from canopen.objectdictionary import ObjectDictionary

from canprobe.eds import has_missed_syncs
from canprobe.emulator.aborts import Abort, SdoAbort
from canprobe.emulator.application import Application
from canprobe.emulator.drive_feedback import DriveFeedback
from canprobe.emulator.drive_motion import STEP_NS, AxisPlant, Motion
from canprobe.emulator.drive_parameters import STAYS_STOPPED, DriveParameters
from canprobe.emulator.drive_states import DriveStates
from canprobe.emulator.drive_supervision import Supervision
from canprobe.emulator.entries import Value, key_of
from canprobe.emulator.node import SlaveNode
from canprobe.protocol import cia402
from canprobe.protocol.cia402 import Command, DriveState, Event, OperationMode
from canprobe.protocol.emcy import FOLLOWING_ERROR, HEARTBEAT_LOST
from canprobe.protocol.frames import NmtState

CSP = OperationMode.CYCLIC_SYNC_POSITION
SUPPORTED_MODES = frozenset({OperationMode.NONE, CSP})
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
        self._limited = self._following_error = self._standstill = False
        self._fresh = False
        self._enabled_ns = 0
        self._mode = 0

    def attach(self, node: SlaveNode) -> None:
        """Hang the drive's objects on the node."""
        self._node, self._core = node, node.core
        self._values = node.dictionary.values
        self._parameters = DriveParameters(node.dictionary, self._has_misses)
        self._motion = Motion(self._axis, self._plant, node.core.timers)
        self._feedback = DriveFeedback(node, self._axis, self._plant, self._motion)
        self._states = DriveStates(self._entered_state, lambda: self._parameters.quick_stop in STAYS_STOPPED)
        self._supervision = Supervision(node, self._parameters, self._abort_connection)
        self._pass_on = node.core.timers.new(self._states.pass_on)
        self._fault_timer = node.core.timers.new(self._raise_injected)
        node.store.volatile |= _VOLATILE
        node.dictionary.on_check(0x6060, _check_mode)
        node.dictionary.on_write(0x6060, lambda _sub, value: self._select_mode(int(value)))
        node.dictionary.on_write(0x6040, lambda _sub, word: self._states.controlword(int(word), self._core.now_ns))
        node.dictionary.on_write(0x607A, self._target_written)

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
        """Power on: brake closed, faults forgotten."""
        self._faults.clear()
        self._limited = self._following_error = self._standstill = self._fresh = False
        self._node.dictionary.put(0x6502, 0, 1 << CSP - 1)
        self._node.dictionary.put(0x603F, 0, 0)
        self._parameters.read()
        self._feedback.reset(t_ns)
        self._motion.hold(t_ns)
        self._select_mode(self._node.dictionary.number(0x6060))
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
        """Latch the target, watch the following error and the master."""
        counts = self._feedback.measure(t_ns)
        if self._states.state is not _ENABLED:
            self._fresh = False
            return
        if self._mode == CSP and t_ns > self._enabled_ns:
            if self._supervision.following_error(self._motion.demand(t_ns) - counts, t_ns):
                self._following_error = True
                self._fault(FOLLOWING_ERROR, t_ns)
                return
            self._supervision.sync(self._fresh, t_ns)
            if self._fresh and self._states.state is _ENABLED:
                self._latch(t_ns)
        self._fresh = False

    def _latch(self, t_ns: int) -> None:
        target: int = self._values[_TARGET]  # type: ignore[assignment]
        allowed = self._parameters.clamp(target)
        self._motion.reach(allowed, t_ns, self._parameters.interpolation_ns)
        if (allowed != target) is not self._limited:
            self._limited = allowed != target
            self._show()

    def _target_written(self, subindex: int, value: Value) -> None:
        self._fresh = True

    def _select_mode(self, mode: int) -> None:
        if self._mode == CSP and self._states.state is _ENABLED and mode != CSP:
            self._motion.decelerate(self._core.now_ns, self._parameters.deceleration, _nothing)
        self._mode = mode
        self._node.dictionary.put(0x6061, 0, mode)
        self._show()

    # ------------------------------------------------------------------ states

    def _entered_state(self, old: DriveState, new: DriveState, t_ns: int) -> None:
        self._standstill = False
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
        elif old is DriveState.QUICK_STOP_ACTIVE and self._motion.stopping:
            self._motion.hold(t_ns)
        if new is not _ENABLED:
            self._supervision.stop()
        self._show()

    def _enable(self, t_ns: int) -> None:
        here = self._motion.hold(t_ns)
        self._values[_TARGET] = round(here)
        self._enabled_ns, self._fresh, self._limited = t_ns, False, False
        self._supervision.start(t_ns)

    def _disable(self, new: DriveState, t_ns: int) -> None:
        """605Bh and 605Ch: on the slow-down ramp (1) or by the brake at once (0); disable voltage is the brake."""
        options = {
            DriveState.READY_TO_SWITCH_ON: self._parameters.shutdown,
            DriveState.SWITCHED_ON: self._parameters.disable,
        }
        rate = self._parameters.deceleration if options.get(new) == 1 else 0
        if rate:
            self._motion.decelerate(t_ns, rate, _nothing)
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
        follows = state is _ENABLED and self._mode == CSP
        word = (
            cia402.statusword_of(state)
            | 1 << cia402.VOLTAGE_ENABLED
            | (self._core.state is NmtState.OPERATIONAL) << cia402.REMOTE
            | self._standstill << cia402.TARGET_REACHED
            | self._limited << cia402.INTERNAL_LIMIT
            | follows << cia402.DRIVE_FOLLOWS
            | self._following_error << cia402.FOLLOWING_ERROR
        )
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


def _check_mode(subindex: int, value: Value) -> None:
    if value not in SUPPORTED_MODES:
        raise SdoAbort(Abort.VALUE)


def _nothing(t_ns: int) -> None:
    return None
