"""Faults of a CiA 402 drive: its states, its encoder, its brake, its zero and its torque. Source: CiA 402-2."""

from __future__ import annotations

from collections.abc import Sequence

from canprobe.errors import UsageError
from canprobe.fieldbus.drive.drive import DriveApplication
from canprobe.fieldbus.node.dictionary import key_of
from canprobe.fieldbus.protocol.cia402 import DriveState
from canprobe.fieldbus.protocol.frames import Frame
from canprobe.fieldbus.protocol.sdo import Abort
from canprobe.fieldbus.tools.faults.fault import Effect, Fault, Host
from canprobe.fieldbus.tools.faults.service_faults import ObjectAborted

_MODE_INDEX = 0x6060
_MAX_TORQUE_INDEX = 0x6072
_FAULT_STATES = (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE)
_RESTING_STATES = (DriveState.NOT_READY_TO_SWITCH_ON, DriveState.SWITCH_ON_DISABLED, *_FAULT_STATES)


class DriveEffect(Effect):
    """Base class of the faults of a drive."""

    needs = "drive"

    def __init__(self, fault: Fault, host: Host) -> None:
        super().__init__(fault, host)
        if not isinstance(self.node.application, DriveApplication):
            raise UsageError(f"{self.node.name}: fault {fault.kind.name} needs a CiA 402 drive")
        self.drive = self.node.application


class DriveFault(DriveEffect):
    """The drive detects a fault. One that is not resettable comes back at once after a fault reset."""

    name = "drive-fault"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        return self.act(t_ns, lambda: self.drive.inject_fault(int(self.fault.value("code"))))

    def watch(self, t_ns: int) -> Sequence[Frame]:
        if self.fault.value("resettable") or self.drive.state in _FAULT_STATES:
            return ()
        self.host.hits += 1
        return self.begin(t_ns)


class Sto(DriveEffect):
    """Safe torque off: the drive has no power, and leaves switch-on disabled for no command."""

    name = "sto"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        return self.watch(t_ns)

    def watch(self, t_ns: int) -> Sequence[Frame]:
        if self.drive.state in _RESTING_STATES:
            return ()
        return self.act(t_ns, lambda: self.drive.lose_power(t_ns))


class ModeRefused(ObjectAborted):
    """Writes to 6060h are refused: value range exceeded."""

    name = "mode-refused"
    needs = "drive"
    code = Abort.VALUE

    def index(self, data: bytes) -> int:
        return _MODE_INDEX if data[0] >> 5 == 1 else -1


class BrakeStuck(DriveEffect):
    """The motor stays where it is, whatever its reference; at the end it goes on from the next one."""

    name = "brake-stuck"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.drive.parts.motion.block(t_ns)
        return ()

    def end(self, t_ns: int) -> None:
        self.drive.parts.motion.blocked = False


class EncoderFault(DriveEffect):
    """Base class of faults of the encoder."""

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.drive.parts.feedback.distortions.append(self.measured)
        return ()

    def end(self, t_ns: int) -> None:
        self.drive.parts.feedback.distortions.remove(self.measured)

    def measured(self, counts: float) -> float:
        """Counts that are measured in the place of the true ones."""
        return counts


class EncoderJump(EncoderFault):
    """The encoder is wrong by so many counts from the beginning on."""

    name = "encoder-jump"

    def measured(self, counts: float) -> float:
        return counts + self.fault.value("counts")


class EncoderFrozen(EncoderFault):
    """The encoder keeps the last position."""

    name = "encoder-frozen"
    _kept: float | None = None

    def measured(self, counts: float) -> float:
        self._kept = counts if self._kept is None else self._kept
        return self._kept


class HomingLost(DriveEffect):
    """The drive forgets that it was homed: bit 12 of the homing mode is gone."""

    name = "homing-lost"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self.drive.forget_homing()
        return ()


class ZeroShift(DriveEffect):
    """The zero of the drive is elsewhere from the beginning on: every position is reported and taken beside it."""

    name = "zero-shift"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        units = self.drive.parts.parameters.units
        units.origin += self.fault.value("counts") * units.scale
        return ()


class TorqueLimit(DriveEffect):
    """The torque is limited to a share of the rated one, as if 6072h had been written."""

    name = "torque-limit"

    def begin(self, t_ns: int) -> Sequence[Frame]:
        self._before = self.node.dictionary.number(_MAX_TORQUE_INDEX)
        self._limit(int(self.fault.value("permille")))
        return ()

    def end(self, t_ns: int) -> None:
        self._limit(self._before)

    def _limit(self, permille: int) -> None:
        dictionary = self.node.dictionary
        if (entry := dictionary.entries.get(key_of(_MAX_TORQUE_INDEX))) is not None:
            highest = entry.high if entry.high is not None else permille
            dictionary.write_value(entry, min(permille, int(highest)))
