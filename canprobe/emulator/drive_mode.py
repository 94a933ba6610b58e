"""What every mode of operation shares: the drive's parts, the controlword's own bits, halt, and the statusword's.

A mode lives between `start` and `leave`, in operation enabled only.
Source: CiA 402-2, controlword bits 4–6, 8 and 9, statusword bits 10–13, halt option code 605Dh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from canprobe.emulator.drive_feedback import DriveFeedback
from canprobe.emulator.drive_loop import DriveLoop
from canprobe.emulator.drive_motion import AxisPlant, Motion
from canprobe.emulator.drive_parameters import PEAK_PERMILLE, DriveParameters
from canprobe.emulator.drive_supervision import Supervision
from canprobe.emulator.node import SlaveNode
from canprobe.protocol import cia402
from canprobe.protocol.emcy import FOLLOWING_ERROR

REACHED = 1 << cia402.TARGET_REACHED
FOLLOWS = 1 << cia402.DRIVE_FOLLOWS


@dataclass(frozen=True, slots=True)
class DriveParts:
    """What a mode works with.

    Attributes:
        show: the mode's part of the statusword may have changed.
        fault: `fault(code, t_ns)`.
    """

    node: SlaveNode
    axis: int
    plant: AxisPlant
    parameters: DriveParameters
    motion: Motion
    feedback: DriveFeedback
    supervision: Supervision
    loop: DriveLoop
    show: Callable[[], None]
    fault: Callable[[int, int], None]


class DriveMode:
    """Mode 0, none: it stands still. Base of the others.

    Attributes:
        target: index of the object that a cyclic mode lives by; None: SYNC and RPDOs are not watched.
        limited: statusword bit 11.
        halted: controlword bit 8.
    """

    target: int | None = None

    def __init__(self, parts: DriveParts) -> None:
        self.parts = parts
        self._motion, self._parameters, self._units = parts.motion, parts.parameters, parts.parameters.units
        self._supervision, self._values = parts.supervision, parts.node.dictionary.values
        self.limited = self.halted = False
        self._standstill = False
        self._word = 0

    def reset(self) -> None:
        """Power on."""

    def start(self, word: int, t_ns: int) -> None:
        """The mode takes over; the reference stands, or slows down. `word` is the present controlword."""
        self._word = word
        self.limited = self._standstill = False
        self.halted = bool(word >> cia402.HALT & 1)
        if self.halted:
            self._halt(t_ns)

    def leave(self, t_ns: int) -> None:
        """Another mode takes over, or operation is disabled."""
        self.parts.loop.release()

    def sync(self, t_ns: int, counts: float) -> None:
        """A SYNC; the motor is at `counts`."""

    def status(self) -> int:
        """Bits 10, 12 and 13 of the statusword."""
        return REACHED if self._standstill else 0

    def command(self, word: int, t_ns: int) -> None:
        """The controlword changed; all values that came with it are stored."""
        changed, self._word = word ^ self._word, word
        if changed >> cia402.HALT & 1:
            self.halted = bool(word >> cia402.HALT & 1)
            if self.halted:
                self._halt(t_ns)
            else:
                self._standstill = False
                self.resume(t_ns)
        self.bits(word, changed, t_ns)
        self.parts.show()

    def bits(self, word: int, changed: int, t_ns: int) -> None:
        """The controlword's bits beside halt."""

    def resume(self, t_ns: int) -> None:
        """Halt is over."""

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
        """Whether the motion takes all of 6072h, or more, which an ideal plant gives all the same."""
        limit = self._parameters.max_torque
        return limit < PEAK_PERMILLE and abs(self.parts.feedback.plant_torque()) >= limit

    def _look(self) -> tuple[int, float] | None:
        """For a mode's timer: now, and where the motor is; None when the following error has become a fault."""
        t_ns = self.parts.node.core.now_ns  # a late timer sees the motor of now
        counts = self.parts.feedback.measure(t_ns)
        return None if self._lags(t_ns, counts) else (t_ns, counts)

    def _lags(self, t_ns: int, counts: float) -> bool:
        """Watch the following error; True when it has become a fault."""
        if not self._supervision.following_error(self._motion.demand(t_ns) - counts, t_ns):
            return False
        self.parts.fault(FOLLOWING_ERROR, t_ns)
        return True


class CyclicMode(DriveMode):
    """A mode with a target for every SYNC; without one it keeps the last, until the master is taken for dead."""

    target: int

    def __init__(self, parts: DriveParts) -> None:
        super().__init__(parts)
        self._fresh = self._commanded = False
        parts.node.dictionary.on_write(self.target, self._target_written)

    def start(self, word: int, t_ns: int) -> None:
        """Nothing is followed until a target comes."""
        self._fresh = self._commanded = False
        super().start(word, t_ns)

    def status(self) -> int:
        """The drive follows the command value, unless halted."""
        return super().status() if self.halted else FOLLOWS

    def sync(self, t_ns: int, counts: float) -> None:
        """Watch the master, latch the target."""
        fresh, self._fresh = self._fresh, False
        self._supervision.sync(fresh, t_ns)
        self._commanded = self._commanded or fresh
        if self._commanded and not self.halted and self._supervision.watching:
            self.latch(t_ns)

    def latch(self, t_ns: int) -> None:
        """Follow the target from now on."""

    def _target_written(self, subindex: int, value: object) -> None:
        self._fresh = True
