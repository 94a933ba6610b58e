"""Base classes of the modes of operation: halt, and the bits of controlword and statusword.

A mode is active between `start` and `leave`, in operation enabled only. A new mode is a class that derives from
`CyclicMode` if it has a target for every SYNC, or from `ProfiledMode` if it makes its own profile; `modes.MODES` lists
it.
Source: CiA 402-2, controlword bits 4–6, 8 and 9, statusword bits 10–13, halt option code 605Dh.
"""

from __future__ import annotations

from canprobe.fieldbus.drive.parameters import PEAK_TORQUE_PERMILLE
from canprobe.fieldbus.drive.parts import DriveParts
from canprobe.fieldbus.drive.reference import STEP_NS
from canprobe.fieldbus.node.dictionary import Value
from canprobe.fieldbus.protocol import cia402
from canprobe.fieldbus.protocol.cia402 import OperationMode
from canprobe.fieldbus.protocol.emcy import FOLLOWING_ERROR_CODE

REACHED_FLAG = 1 << cia402.TARGET_REACHED_BIT
FOLLOWS_FLAG = 1 << cia402.DRIVE_FOLLOWS_BIT


class DriveMode:
    """Mode 0, none: the drive stands still. It is the base class of the others.

    Attributes:
        number: number of the mode in 6060h; 6502h has bit number - 1 for it.
        needs: dictionary keys of the objects without which the EDS does not describe the mode.
        target: index of the object that a cyclic mode needs in every cycle; None: SYNC and RPDOs are not watched.
        limited: whether a value is limited, statusword bit 11.
        halted: whether halt is commanded, controlword bit 8.
    """

    number = OperationMode.NONE
    needs: tuple[int, ...] = ()
    target: int | None = None

    def __init__(self, parts: DriveParts) -> None:
        self.parts = parts
        self._motion, self._parameters, self._units = parts.motion, parts.parameters, parts.parameters.units
        self._supervision, self._values = parts.supervision, parts.node.dictionary.values
        self.limited = self.halted = False
        self._standstill = False
        self._word = 0

    def reset(self) -> None:
        """Forget everything, at power on."""

    def start(self, word: int, t_ns: int) -> None:
        """Take over; the reference is at rest, or slows down. `word` is the present controlword."""
        self._word = word
        self.limited = self._standstill = False
        self.halted = bool(word >> cia402.HALT_BIT & 1)
        if self.halted:
            self._halt(t_ns)

    def leave(self, t_ns: int) -> None:
        """Give up, as another mode takes over or operation is disabled."""
        self.parts.loop.release()

    def sync(self, t_ns: int, counts: float) -> None:
        """Act on a SYNC; the motor is at `counts`."""

    def status(self) -> int:
        """Bits 10, 12 and 13 of the statusword."""
        return REACHED_FLAG if self._standstill else 0

    def command(self, word: int, t_ns: int) -> None:
        """Act on a new controlword; all values that came with it are stored."""
        changed, self._word = word ^ self._word, word
        if changed >> cia402.HALT_BIT & 1:
            self.halted = bool(word >> cia402.HALT_BIT & 1)
            if self.halted:
                self._halt(t_ns)
            else:
                self._standstill = False
                self.resume(t_ns)
        self.bits(word, changed, t_ns)
        self.parts.show()

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """Act on the bits of the controlword other than halt."""

    def resume(self, t_ns: int) -> None:
        """Go on, as halt is over."""

    def _halt(self, t_ns: int) -> None:
        self._motion.decelerate(t_ns, self._parameters.halt_rate, self._at_standstill)

    def _at_standstill(self, t_ns: int) -> None:
        self._standstill = True
        self.parts.show()

    def _limit(self, limited: bool) -> None:
        if limited is not self.limited:
            self.limited = limited
            self.parts.show()

    def _strains(self) -> bool:
        """Whether the motion takes all of 6072h, or more, which an ideal plant gives nevertheless."""
        limit = self._parameters.max_torque
        return limit < PEAK_TORQUE_PERMILLE and abs(self.parts.feedback.plant_torque()) >= limit

    def _lags(self, t_ns: int, counts: float) -> bool:
        """Watch the following error; return True when it has become a fault."""
        error, supervision = self._motion.demand(t_ns) - counts, self._supervision
        if abs(error) <= self._parameters.following_window:
            supervision.outside_ns = None
            return False
        if supervision.outside_ns is None:
            supervision.outside_ns = t_ns
        if t_ns - supervision.outside_ns < self._parameters.following_timeout_ns:
            return False
        self.parts.fault(FOLLOWING_ERROR_CODE, t_ns)
        return True


class ProfiledMode(DriveMode):
    """A mode that makes its own profile; while its timer runs it checks the motor every `STEP_NS`."""

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._timer = parts.node.core.timers.new(self._look)

    def leave(self, t_ns: int) -> None:
        self._timer.cancel()

    def watch(self, t_ns: int, counts: float) -> None:
        """Act on the motor position `counts`; its following error is no fault."""

    def _look(self, due_ns: int) -> None:
        t_ns = self.parts.node.core.now_ns  # a late timer measures the present motor
        counts = self.parts.feedback.measure(t_ns)
        if not self._lags(t_ns, counts):
            self._timer.arm_next(due_ns, STEP_NS)
            self.watch(t_ns, counts)


class CyclicMode(DriveMode):
    """A mode with a target for every SYNC, until the master counts as lost.

    Attributes:
        repeats: whether the last target is latched again where a new one is missing.
        lags: whether the following error is watched.
    """

    target: int
    repeats, lags = True, False

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._fresh = self._commanded = False
        parts.node.dictionary.on_write(self.target, self._target_written)

    def start(self, word: int, t_ns: int) -> None:
        """Start; nothing is followed until a target comes."""
        self._fresh = self._commanded = False
        super().start(word, t_ns)

    def status(self) -> int:
        """Bit for a drive that follows the command value, unless it is halted."""
        return super().status() if self.halted else FOLLOWS_FLAG

    def sync(self, t_ns: int, counts: float) -> None:
        """Watch the following error and the master, and latch the target."""
        if self.lags and self._lags(t_ns, counts):
            return
        fresh, self._fresh = self._fresh, False
        supervision = self._supervision
        supervision.sync(fresh, t_ns)
        self._commanded = fresh or (self._commanded and self.repeats)
        # `supervision.sync` may have found the master lost just now: the drive brakes, and nothing is latched
        if self._commanded and not self.halted and supervision.watching:
            self.latch(t_ns)

    def latch(self, t_ns: int) -> None:
        """Follow the target from now on."""

    def _target_written(self, subindex: int, value: Value) -> None:
        self._fresh = True
