"""A CiA 402 drive on one axis of the plant: states, faults, options, and which mode is active.

Outside operation enabled the drive holds its position. It stops by itself when the master is lost: in the cyclic modes
when SYNC or targets are missing, in all modes when the heartbeat is. A change of mode under way slows the motion down
by 6084h until the new mode gets a target.
Source: CiA 402-2 (IEC 61800-7-201), finite state automaton, modes of operation.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from functools import partial

from canopen.objectdictionary import ObjectDictionary

from canprobe.fieldbus.drive.cyclic_modes import CyclicPosition, CyclicTorque, CyclicVelocity, InterpolatedPosition
from canprobe.fieldbus.drive.homing import HomingMode
from canprobe.fieldbus.drive.mode import DriveMode
from canprobe.fieldbus.drive.parameters import STAYING_QUICK_STOP_OPTIONS, DriveParameters, check_among
from canprobe.fieldbus.drive.parts import DriveFeedback, DriveLoop, DriveParts, Supervision
from canprobe.fieldbus.drive.profile_position import ProfilePosition
from canprobe.fieldbus.drive.reference import STEP_NS, AxisPlant, Motion
from canprobe.fieldbus.drive.units import FACTOR_INDICES, Delivery
from canprobe.fieldbus.node.dictionary import Value, key_of
from canprobe.fieldbus.node.quirks import Quirks
from canprobe.fieldbus.node.slave_node import Application, OdOf, SlaveNode
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import DriveCommand, DriveState, Event
from canprobe.fieldbus.protocol.emcy import FOLLOWING_ERROR_CODE, HEARTBEAT_LOST_CODE
from canprobe.fieldbus.protocol.frames import NmtState
from canprobe.fieldbus.protocol.sdo import Abort, SdoAbort

MODES: tuple[type[DriveMode], ...] = (
    DriveMode,
    ProfilePosition,
    HomingMode,
    InterpolatedPosition,
    CyclicPosition,
    CyclicVelocity,
    CyclicTorque,
)
_STATUSWORD_KEY = key_of(0x6041)
_VOLATILE_INDICES = frozenset({0x6040, 0x6071, 0x607A, 0x60B0, 0x60B1, 0x60B2, 0x60C1, 0x60FF})
_ABORT_COMMANDS = {2: DriveCommand.DISABLE_VOLTAGE, 3: DriveCommand.QUICK_STOP}  # by 6007h; 1 is a fault, 0 nothing
_ENABLED_STATE = DriveState.OPERATION_ENABLED
STAND_ALONE_DELIVERY = Delivery()
"""State as delivered of a drive that belongs to no cell."""


class DriveApplication(Application):
    """The drive function of one node: its state by the tables of `protocol.cia402`, and one active mode of `modes`.

    The state machine obeys a controlword at once. The bits of the mode wait until all values of the same PDO are
    stored, so that a set-point's target and its bit 4 belong together whatever their order in the mapping.

    Attributes:
        state: state of the finite state automaton.
        parts: motion, feedback, supervision and parameters, which exist from `attach` on.
    """

    def __init__(
        self, axis: int, plant: AxisPlant, *, delivery: Delivery, incremental: bool, noise: Callable[[], float] | None
    ) -> None:
        """Make the drive of one axis.

        Args:
            axis: number of the axis in the plant, 0-based.
            plant: plant, which the nodes share.
            delivery: settings that the EDS does not state.
            incremental: whether the encoder counts from 0 at every power on and node reset, wherever the motor is.
            noise: function for the noise that the encoder adds to a position, counts; None: there is none.
        """
        self._axis, self._plant, self._incremental, self._noise = axis, plant, incremental, noise
        self._delivery = delivery
        self.state = cia402.INITIAL_STATE
        self._command: DriveCommand | None = None  # the present command
        self._word = 0  # the last controlword
        self._idle_word: int | None = None  # the same, if it had no effect and nothing has happened since
        self._word_waits = False  # the active mode has not got it yet
        self._since_ns = 0  # when the mode took over
        self._standstill = False
        self._faults: list[int] = []

    def attach(self, node: SlaveNode) -> None:
        """Connect the drive with the objects of the node."""
        self._node, self._core, self._values = node, node.core, node.dictionary.values
        self._parameters = parameters = DriveParameters(node.dictionary, self._delivery)
        self._motion = motion = Motion(self._axis, self._plant, node.core.timers)
        feedback = DriveFeedback(node, motion, parameters.units, self._noise)
        supervision = Supervision(node, parameters, self._abort_connection)
        loop = DriveLoop(node, motion, parameters)
        fault, show = self._find_fault, self._show
        self.parts = DriveParts(node, motion, parameters, feedback, loop, supervision, fault, show)
        self._modes = _make_modes(self.parts)
        self._mode = self._modes[0]
        self._take_word_soon = node.core.timers.new(self._take_word)
        self._pass_on_soon = node.core.timers.new(self._pass_on)
        node.store.volatile |= _VOLATILE_INDICES
        dictionary = node.dictionary
        for index in FACTOR_INDICES:
            dictionary.on_check(index, self._check_not_moving)
        dictionary.on_write(0x6040, self._controlword)
        dictionary.on_read(0x6041, lambda _sub: self._take_word(self._core.now_ns))
        dictionary.on_check(0x6060, partial(check_among, self._modes))
        dictionary.on_write(0x6060, lambda _sub, value: self._select_mode(int(value)))

    def reset(self, t_ns: int) -> None:
        """Power on: close the brake, forget faults and home; the self-test is passed at once."""
        self._forget_faults()
        self._standstill = self._word_waits = False
        self._parameters.read()
        self.parts.loop.close_brake()
        self.parts.loop.release()
        self.parts.feedback.reset(t_ns)
        here = self._motion.hold(t_ns)
        self._parameters.units.origin = here if self._incremental else 0.0
        for mode in self._modes.values():
            mode.reset()
        self._node.dictionary.put(0x6502, 0, sum(1 << mode - 1 for mode in self._modes if mode))
        self._word, self._command, self.state = 0, None, cia402.INITIAL_STATE
        self._show_mode(self._node.dictionary.number(0x6060))
        self._happen(Event.INITIALISED, t_ns)

    def entered(self, t_ns: int) -> None:
        """Abort the connection at NMT stop and at resets; bit 9 follows operational."""
        if self._core.state in (NmtState.STOPPED, NmtState.INITIALISING):
            self.connection_lost(t_ns)
        self._show()

    def advance(self, t_ns: int) -> None:
        self._plant.advance(t_ns)

    def connection_lost(self, t_ns: int) -> None:
        """React as 6007h says."""
        self._abort_connection(HEARTBEAT_LOST_CODE, t_ns)

    def sync(self, t_ns: int, counter: int) -> None:
        """Let the mode watch and latch, one SYNC after it was enabled at the earliest."""
        self._plant.begin(t_ns)
        counts = self.parts.feedback.measure(t_ns)
        if self._word_waits:
            self._take_word(t_ns)
        if self.state is _ENABLED_STATE and t_ns > self._since_ns:
            self._mode.sync(t_ns, counts)

    def _controlword(self, subindex: int, value: Value) -> None:
        if value == self._idle_word:
            return  # as in every cycle of operation
        word, now_ns, previous = int(value), self._core.now_ns, self._word
        if word != previous:
            self._take_word(now_ns)
            self._word = word
        enabled = self.state is _ENABLED_STATE
        self._obey(word, previous, now_ns)
        if word != previous and enabled and self.state is _ENABLED_STATE:
            self._word_waits = True
            self._take_word_soon.arm(now_ns)

    def _obey(self, word: int, previous: int, t_ns: int) -> None:
        """Change the state as the controlword commands."""
        command = cia402.command_of(word, previous)
        repeated, self._command = command is self._command, command
        goal = None if command is None else cia402.TRANSITIONS.get((self.state, command))
        resumes = self.state is DriveState.QUICK_STOP_ACTIVE and goal is _ENABLED_STATE
        if goal is None or (resumes and (repeated or self._parameters.quick_stop not in STAYING_QUICK_STOP_OPTIONS)):
            self._idle_word = word
            return  # a drive that stopped by itself is not restarted by a controlword that merely repeats
        self._go(goal, t_ns)

    def _take_word(self, t_ns: int) -> None:
        """Give the active mode the controlword that waits, if there is one."""
        waits, self._word_waits = self._word_waits, False
        self._take_word_soon.cancel()
        if waits and self.state is _ENABLED_STATE:
            self._mode.command(self._word, t_ns)

    def _pass_on(self, t_ns: int) -> None:
        """Make transition 4 after 3, when the controlword that switched on also enables."""
        if self.state is DriveState.SWITCHED_ON and self._command is DriveCommand.ENABLE_OPERATION:
            self._go(_ENABLED_STATE, t_ns)

    def _select_mode(self, number: int) -> None:
        mode = self._modes[number]
        if mode is not self._mode and self.state is _ENABLED_STATE:
            t_ns = self._core.now_ns
            self._mode.leave(t_ns)
            self._motion.decelerate(t_ns, self._parameters.deceleration)
            self._mode = mode
            self._start_mode(t_ns)
        self._show_mode(number)

    def _show_mode(self, number: int) -> None:
        shown = number if number in self._modes else 0
        self._mode = self._modes[shown]
        self._node.dictionary.put(0x6061, 0, shown)
        self._show()

    def _start_mode(self, t_ns: int) -> None:
        """Start the active mode: operation is enabled, or the mode is new."""
        self._since_ns = t_ns
        self.parts.supervision.start(self._mode.target, t_ns)
        self._mode.start(self._word, t_ns)

    def _check_not_moving(self, subindex: int, value: Value) -> None:
        if self.state in cia402.POWERED_STATES:
            raise SdoAbort(Abort.DEVICE_STATE)

    def _happen(self, event: Event, t_ns: int) -> None:
        """Change the state by an event in the drive."""
        goal = cia402.AUTOMATIC_TRANSITIONS.get((self.state, event))
        if goal is not None:
            self._go(goal, t_ns)

    def _go(self, new: DriveState, t_ns: int) -> None:
        old, self.state, self._idle_word = self.state, new, None
        self._standstill = False
        if old is _ENABLED_STATE:
            self._mode.leave(t_ns)
            self.parts.loop.close_brake()
        if new is _ENABLED_STATE:
            self._plant.begin(t_ns)
            here = self._motion.hold(t_ns)
            self.parts.loop.open_brake(t_ns)
            self._node.dictionary.put(0x607A, 0, round(self._parameters.units.position(here)))
            self._start_mode(t_ns)
        elif new is DriveState.QUICK_STOP_ACTIVE:
            self._motion.decelerate(t_ns, self._parameters.quick_stop_rate, self._stopped)
        elif new is DriveState.FAULT_REACTION_ACTIVE:
            reacted = partial(self._happen, Event.FAULT_REACTION_DONE)
            self._motion.decelerate(t_ns, self._parameters.fault_rate, reacted)
        elif old is _ENABLED_STATE:
            self._disable(t_ns)
        elif new is DriveState.SWITCHED_ON:
            self._pass_on_soon.arm(t_ns + STEP_NS)
        elif old is DriveState.FAULT:
            self._forget_faults()
        elif old is DriveState.QUICK_STOP_ACTIVE and self._motion.busy:
            self._motion.hold(t_ns)
        if new is not _ENABLED_STATE:
            self.parts.supervision.stop()
        self._show()

    def _disable(self, t_ns: int) -> None:
        """Stop by 605Bh or 605Ch: by the slow-down ramp (1) or the brake at once (0); disable voltage is the brake."""
        parameters = self._parameters
        options = {DriveState.READY_TO_SWITCH_ON: parameters.shutdown, DriveState.SWITCHED_ON: parameters.disable}
        if options.get(self.state) == 1 and parameters.deceleration:
            self._motion.decelerate(t_ns, parameters.deceleration)
        else:
            self._motion.hold(t_ns)

    def _stopped(self, t_ns: int) -> None:
        if self._parameters.quick_stop in STAYING_QUICK_STOP_OPTIONS:
            self._standstill = True
            self._show()
        else:
            self._happen(Event.QUICK_STOP_DONE, t_ns)

    def _abort_connection(self, code: int, t_ns: int) -> None:
        option = self._parameters.abort_connection
        if self.state is not _ENABLED_STATE:
            return
        if option == 1:
            self._find_fault(code, t_ns)
        elif option in _ABORT_COMMANDS:
            self._go(cia402.TRANSITIONS[_ENABLED_STATE, _ABORT_COMMANDS[option]], t_ns)

    def _show(self) -> None:
        """Compose the statusword; a change is an event for the PDOs that carry it."""
        word = (
            self.state.value
            | 1 << cia402.VOLTAGE_ENABLED_BIT
            | (self._core.state is NmtState.OPERATIONAL) << cia402.REMOTE_BIT
            | self._standstill << cia402.TARGET_REACHED_BIT
            | (FOLLOWING_ERROR_CODE in self._faults) << cia402.FOLLOWING_ERROR_BIT
        )
        if self.state is _ENABLED_STATE:
            word |= self._mode.status() | self._mode.limited << cia402.INTERNAL_LIMIT_BIT
        if word != self._values.get(_STATUSWORD_KEY):
            self._node.dictionary.put(0x6041, 0, word)
            self._node.pdos.event(0x6041)

    def inject_fault(self, code: int) -> None:
        """Let the drive detect a fault, at the next `advance`: EMCY `code`, fault reaction, fault."""
        self._core.timers.new(partial(self._find_fault, code)).arm(self._core.now_ns)

    def lose_power(self, t_ns: int) -> None:
        """Go to switch-on disabled: the power stage was cut off."""
        self._go(DriveState.SWITCH_ON_DISABLED, t_ns)

    def forget_homing(self) -> None:
        """Be no longer homed, in the homing mode."""
        for mode in self._modes.values():
            mode.reset()
        self._show()

    def _find_fault(self, code: int, t_ns: int) -> None:
        """Report a fault that is present, show it in 603Fh, and react."""
        self._faults.append(code)
        self._node.dictionary.put(0x603F, 0, code)
        self._node.emcy.report(code)
        self._happen(Event.FAULT_DETECTED, t_ns)

    def _forget_faults(self) -> None:
        """Forget all faults, at power on or fault reset."""
        for code in self._faults:
            self._node.emcy.clear(code)
        self._faults.clear()
        self._node.dictionary.put(0x603F, 0, 0)


def make_drive_node(
    od: ObjectDictionary,
    node_id: int,
    axis: int,
    plant: AxisPlant,
    od_of: OdOf | None = None,
    *,
    delivery: Delivery = STAND_ALONE_DELIVERY,
    quirks: Quirks | None = None,
    incremental: bool = False,
    seed: int = 0,
) -> SlaveNode:
    """Make a drive node on one axis of the plant.

    Args:
        od: parsed EDS of any CiA 402 drive, for this node id.
        node_id: node id, 1–127, or 255 for none.
        axis: number of the axis in the plant, 0-based.
        plant: plant, which all nodes share.
        od_of: parser of the EDS for another node id, where LSS may give the node one.
        delivery: settings that the EDS does not state.
        quirks: difficulties of the node; None: it has none.
        incremental: whether the drive forgets its zero with the power and has to be homed.
        seed: seed of the noise of the encoder.
    """
    sigma = quirks.noise_counts if quirks is not None else 0.0
    noise = partial(random.Random(f"{seed} {axis}").gauss, 0.0, sigma) if sigma else None
    application = DriveApplication(axis, plant, delivery=delivery, incremental=incremental, noise=noise)
    return SlaveNode(od, node_id, application, od_of=od_of, quirks=quirks)


def _make_modes(parts: DriveParts) -> dict[int, DriveMode]:
    """Modes of a drive, by number: the EDS has their objects, and lists them in 6502h if it has that."""
    dictionary = parts.node.dictionary
    claimed = dictionary.number(0x6502) or ~0
    return {
        int(mode.number): mode(parts)
        for mode in MODES
        if not mode.number or (claimed >> mode.number - 1 & 1 and all(key in dictionary for key in mode.needs))
    }
