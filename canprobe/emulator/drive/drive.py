"""A CiA 402 drive on one axis of the plant: states, faults, options, and which mode is active.

Outside operation enabled the drive holds. It stops by itself when the master dies: in the cyclic modes when SYNC or
targets are missing, in all modes when the heartbeat is. A change of mode under way slows the motion down by 6084h
until the new mode is given a target.
Source: CiA 402-2 (IEC 61800-7-201), finite state automaton, modes of operation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from canopen.objectdictionary import ObjectDictionary

from canprobe.emulator.drive.mode import DriveFaults, DriveFeedback, DriveLoop, DriveMode, DriveParts, Supervision
from canprobe.emulator.drive.modes import CyclicPosition, CyclicTorque, CyclicVelocity, Homing, ProfilePosition
from canprobe.emulator.drive.parameters import FACTORS, STAYS_STOPPED, DriveParameters
from canprobe.emulator.drive.reference import STEP_NS, AxisPlant, Motion
from canprobe.emulator.node.dictionary import Abort, SdoAbort, Value, key_of
from canprobe.emulator.node.slave_node import Application, OdOf, SlaveNode
from canprobe.protocol import cia402
from canprobe.protocol.cia402 import (
    AUTOMATIC_TRANSITIONS,
    INITIAL_STATE,
    POWERED_STATES,
    TRANSITIONS,
    Command,
    DriveState,
    Event,
    OperationMode,
    command_of,
)
from canprobe.protocol.frames import HEARTBEAT_LOST, NmtState

# The table of modes of operation: number → what it needs of the EDS, and the class that does it.
#
# Source: CiA 402-2, objects 6060h, 6061h, 6502h.

MODES: dict[OperationMode, tuple[type[DriveMode], tuple[int, ...]]] = {
    OperationMode.NONE: (DriveMode, ()),
    OperationMode.PROFILE_POSITION: (ProfilePosition, (0x607A, 0x6081)),
    OperationMode.HOMING: (Homing, (0x6098,)),
    OperationMode.CYCLIC_SYNC_POSITION: (CyclicPosition, (0x607A,)),
    OperationMode.CYCLIC_SYNC_VELOCITY: (CyclicVelocity, (0x60FF,)),
    OperationMode.CYCLIC_SYNC_TORQUE: (CyclicTorque, (0x6071,)),
}


def make_modes(parts: DriveParts) -> dict[int, DriveMode]:
    """The modes that a drive offers: known here, their objects in the EDS, and claimed by its 6502h if it has one."""
    dictionary = parts.node.dictionary
    claimed = dictionary.number(0x6502) or ~0
    return {
        int(mode): make(parts)
        for mode, (make, needs) in MODES.items()
        if not mode or (claimed >> mode - 1 & 1 and all(dictionary.has_index(index) for index in needs))
    }


def supported_bits(modes: Iterable[int]) -> int:
    """Object 6502h: bit n-1 for mode n."""
    return sum(1 << mode - 1 for mode in modes if mode)


# Which mode of operation is active, and when it sees the controlword.
#
# The state machine obeys a controlword at once. The bits of the mode wait until all values of the same PDO are stored,
# so that a set-point's target and its bit 4 belong together whatever their order in the mapping.
# Source: CiA 402-2, objects 6060h, 6061h, 6502h; controlword 6040h.


class ModeSelection:
    """The modes of a drive, one of them active.

    Attributes:
        active: the present mode; it works in operation enabled.
        word: the last controlword.
        word_waits: the active mode has not seen it yet.
        since_ns: when the mode took over.
    """

    def __init__(self, parts: DriveParts, enabled: Callable[[], bool]) -> None:
        """`enabled()` tells whether operation is."""
        self._parts, self._enabled = parts, enabled
        self._modes = make_modes(parts)
        self.active = self._modes[0]
        self.word = self.since_ns = 0
        self.word_waits = False
        self._core = parts.node.core
        self._timer = self._core.timers.new(self.take_word)
        dictionary = parts.node.dictionary
        dictionary.on_check(0x6060, self._check)
        dictionary.on_write(0x6060, lambda _sub, value: self._select(int(value)))
        dictionary.on_read(0x6041, lambda _sub: self.take_word(self._core.now_ns))

    def reset(self) -> None:
        """Power on."""
        self.word, self.word_waits = 0, False
        for mode in self._modes.values():
            mode.reset()
        dictionary = self._parts.node.dictionary
        dictionary.put(0x6502, 0, supported_bits(self._modes))
        self._show(dictionary.number(0x6060))

    def start(self, t_ns: int) -> None:
        """The active mode takes over: operation is enabled, or the mode is new."""
        self.since_ns = t_ns
        self._parts.supervision.start(self.active.target, t_ns)
        self.active.start(self.word, t_ns)

    def keep_word(self, word: int) -> None:
        """A new controlword, before the state machine gets it."""
        self.take_word(self._core.now_ns)
        self.word = word

    def let_word_wait(self) -> None:
        """The new controlword left operation enabled; the mode sees it soon, at the same time."""
        self.word_waits = True
        self._timer.arm(self._core.now_ns)

    def take_word(self, t_ns: int) -> None:
        """Let the active mode see the controlword that waits, if one does."""
        waits, self.word_waits = self.word_waits, False
        self._timer.cancel()
        if waits and self._enabled():
            self.active.command(self.word, t_ns)

    def _select(self, mode: int) -> None:
        changes = self._modes[mode] is not self.active
        if changes and self._enabled():
            t_ns = self._core.now_ns
            self.active.leave(t_ns)
            self._parts.motion.decelerate(t_ns, self._parts.parameters.deceleration)
            self.active = self._modes[mode]
            self.start(t_ns)
        self._show(mode)

    def _show(self, mode: int) -> None:
        shown = mode if mode in self._modes else 0
        self.active = self._modes[shown]
        self._parts.node.dictionary.put(0x6061, 0, shown)
        self._parts.show()

    def _check(self, subindex: int, value: Value) -> None:
        if value not in self._modes:
            raise SdoAbort(Abort.VALUE)


# The drive's finite state automaton, on the tables of `protocol.cia402`; what a state does is the drive's.
#
# Source: CiA 402-2, "Finite state automaton".

Entered = Callable[[DriveState, DriveState, int], None]


class DriveStates:
    """State, controlword edges, and the two transitions that need more than the table.

    Attributes:
        state: present state.
        command: the command that stands, or None.
        idle_word: the last controlword, if it did nothing and nothing has happened since; it need not be given again.
        resumable: whether a quick stop may be left for operation (605Ah = 5, 6).
    """

    def __init__(self, entered: Entered, resumable: Callable[[], bool]) -> None:
        """`entered(old, new, t_ns)` is called after every change of state."""
        self._entered, self.resumable = entered, resumable
        self.state = INITIAL_STATE
        self.command: Command | None = None
        self._previous = 0
        self.idle_word: int | None = None

    def reset(self, t_ns: int) -> None:
        """Power on: self-test passed at once."""
        self.state, self.command, self._previous = INITIAL_STATE, None, 0
        self.idle_word = None
        self.event(Event.INITIALISED, t_ns)

    def controlword(self, word: int, t_ns: int) -> None:
        """A controlword was received."""
        command = command_of(word, self._previous)
        repeated, self.command, self._previous = command is self.command, command, word
        goal = None if command is None else TRANSITIONS.get((self.state, command))
        resumes = self.state is DriveState.QUICK_STOP_ACTIVE and goal is DriveState.OPERATION_ENABLED
        if goal is None or (resumes and (repeated or not self.resumable())):
            self.idle_word = word
            return  # a drive that stopped by itself is not restarted by a controlword that merely repeats
        self._go(goal, t_ns)

    def pass_on(self, t_ns: int) -> None:
        """Transition 4 after 3, when the controlword that switched on also enables."""
        if self.state is DriveState.SWITCHED_ON and self.command is Command.ENABLE_OPERATION:
            self._go(DriveState.OPERATION_ENABLED, t_ns)

    def event(self, event: Event, t_ns: int) -> None:
        """Something in the drive changes the state."""
        goal = AUTOMATIC_TRANSITIONS.get((self.state, event))
        if goal is not None:
            self._go(goal, t_ns)

    def force(self, command: Command, t_ns: int) -> None:
        """The drive commands itself (abort connection, 6007h)."""
        goal = TRANSITIONS.get((self.state, command))
        if goal is not None:
            self._go(goal, t_ns)

    def _go(self, goal: DriveState, t_ns: int) -> None:
        old, self.state, self.idle_word = self.state, goal, None
        self._entered(old, goal, t_ns)


# A CiA 402 drive on one axis of the plant: states, faults and options; what a mode does is in `modes`.

_TARGET, _STATUSWORD = key_of(0x607A), key_of(0x6041)
_VOLATILE = frozenset({0x6040, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60FF})
_ABORT_COMMANDS = {2: Command.DISABLE_VOLTAGE, 3: Command.QUICK_STOP}  # of 6007h; 1 is a fault, 0 nothing
_ENABLED = DriveState.OPERATION_ENABLED


class DriveApplication(Application):
    """The drive function of one node."""

    def __init__(self, axis: int, plant: AxisPlant) -> None:
        """Make the drive of one axis.

        Args:
            axis: of the plant, 0-based.
            plant: shared with the other nodes.
        """
        self._axis, self._plant = axis, plant
        self._standstill = False

    def attach(self, node: SlaveNode) -> None:
        """Hang the drive's objects on the node."""
        self._node, self._core = node, node.core
        self._values, dictionary, timers = node.dictionary.values, node.dictionary, node.core.timers
        self._parameters = DriveParameters(dictionary)
        self._motion = Motion(self._axis, self._plant, timers)
        self._feedback = DriveFeedback(node, self._axis, self._plant, self._motion, self._parameters.units)
        self._faults = DriveFaults(node, lambda t_ns: self._states.event(Event.FAULT_DETECTED, t_ns))
        self._states = DriveStates(self._entered_state, lambda: self._parameters.quick_stop in STAYS_STOPPED)
        self._supervision = Supervision(node, self._parameters, self._abort_connection)
        self._loop = DriveLoop(self._axis, self._plant, self._parameters, dictionary)
        self._modes = ModeSelection(self._parts(), lambda: self._states.state is _ENABLED)
        self._pass_on = timers.new(self._states.pass_on)
        node.store.volatile |= _VOLATILE
        for index in FACTORS:
            dictionary.on_check(index, self._check_not_moving)
        dictionary.on_write(0x6040, self._controlword)

    def _parts(self) -> DriveParts:
        return DriveParts(
            node=self._node,
            axis=self._axis,
            plant=self._plant,
            parameters=self._parameters,
            motion=self._motion,
            feedback=self._feedback,
            supervision=self._supervision,
            loop=self._loop,
            show=self._show,
            fault=self._faults.find,
        )

    @property
    def state(self) -> DriveState:
        """State of the finite state automaton."""
        return self._states.state

    def inject_fault(self, code: int) -> None:
        """Let the drive detect a fault now: EMCY `code`, fault reaction, fault. Goes out at the next `advance`."""
        self._faults.inject(code)

    # ------------------------------------------------------------------ the node's events

    def reset(self, t_ns: int) -> None:
        """Power on: brake closed, faults and home forgotten."""
        self._faults.reset()
        self._standstill = False
        self._parameters.read()
        self._loop.release()
        self._feedback.reset(t_ns)
        self._motion.hold(t_ns)
        self._modes.reset()
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
        counts, modes = self._feedback.measure(t_ns), self._modes
        if modes.word_waits:
            modes.take_word(t_ns)
        if self._states.state is _ENABLED and t_ns > modes.since_ns:
            modes.active.sync(t_ns, counts)

    def _controlword(self, subindex: int, value: Value) -> None:
        states, modes = self._states, self._modes
        if value == states.idle_word:
            return  # as in every cycle of operation
        word, now_ns = int(value), self._core.now_ns
        if word == modes.word:
            states.controlword(word, now_ns)
            return
        modes.keep_word(word)
        enabled = states.state is _ENABLED
        states.controlword(word, now_ns)
        if enabled and states.state is _ENABLED:
            modes.let_word_wait()

    def _check_not_moving(self, subindex: int, value: Value) -> None:
        if self._states.state in POWERED_STATES:
            raise SdoAbort(Abort.DEVICE_STATE)

    # ------------------------------------------------------------------ states

    def _entered_state(self, old: DriveState, new: DriveState, t_ns: int) -> None:
        self._standstill = False
        if old is _ENABLED:
            self._modes.active.leave(t_ns)
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
            self._faults.forget()
        elif old is DriveState.QUICK_STOP_ACTIVE and self._motion.busy:
            self._motion.hold(t_ns)
        if new is not _ENABLED:
            self._supervision.stop()
        self._show()

    def _enable(self, t_ns: int) -> None:
        here = self._motion.hold(t_ns)
        self._values[_TARGET] = round(self._parameters.units.position(here))
        self._modes.start(t_ns)

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

    def _abort_connection(self, code: int, t_ns: int) -> None:
        option = self._parameters.abort_connection
        if self._states.state is not _ENABLED:
            return
        if option == 1:
            self._faults.find(code, t_ns)
        elif command := _ABORT_COMMANDS.get(option):
            self._states.force(command, t_ns)

    def _show(self) -> None:
        state = self._states.state
        word = (
            cia402.statusword_of(state)
            | 1 << cia402.VOLTAGE_ENABLED
            | (self._core.state is NmtState.OPERATIONAL) << cia402.REMOTE
            | self._standstill << cia402.TARGET_REACHED
            | self._faults.following_error << cia402.FOLLOWING_ERROR
        )
        if state is _ENABLED:
            word |= self._modes.active.status() | self._modes.active.limited << cia402.INTERNAL_LIMIT
        if word != self._values.get(_STATUSWORD):
            self._node.dictionary.put(0x6041, 0, word)
            self._node.pdos.event(0x6041)


def make_drive_node(
    od: ObjectDictionary, node_id: int, axis: int, plant: AxisPlant, od_of: OdOf | None = None
) -> SlaveNode:
    """A drive node on one axis of the plant.

    Args:
        od: of `puma260_joint.eds` or another CiA 402 EDS, for this node id.
        node_id: 1–127, or 255 for none.
        axis: of the plant, 0-based.
        plant: shared by all nodes.
        od_of: the EDS for another node id, where LSS may give the node one.
    """
    return SlaveNode(od, node_id, DriveApplication(axis, plant), od_of=od_of)
