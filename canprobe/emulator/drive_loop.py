"""What a drive tells the plant's position loop: the torque limit 6072h and the feed-forwards 60B1h and 60B2h.

The feed-forwards act in the mode that gives them; leaving it takes them back. In cyclic synchronous velocity 60B1h is
part of the target already, and in cyclic synchronous torque both are: there the loop gets none.
Source: CiA 402-2, objects 6072h, 60B1h, 60B2h.
"""

from __future__ import annotations

from canprobe.emulator.dictionary import Dictionary
from canprobe.emulator.drive_motion import AxisPlant
from canprobe.emulator.drive_parameters import PEAK_PERMILLE, DriveParameters
from canprobe.emulator.entries import Value

_LIMIT, _SPEED, _TORQUE = 0x6072, 0x60B1, 0x60B2


class DriveLoop:
    """Torque limit and feed-forwards of one axis; the plant hears of changes only.

    Attributes:
        changed: a position mode has to `feed_forward` in this cycle.

    Args:
        axis: of the plant, 0-based.
        plant: shared with the other drives.
        parameters: of the drive.
        dictionary: of the drive.
    """

    def __init__(self, axis: int, plant: AxisPlant, parameters: DriveParameters, dictionary: Dictionary) -> None:
        self._axis, self._plant, self._parameters, self._number = axis, plant, parameters, dictionary.number
        self._told: tuple[int, float, float] = (PEAK_PERMILLE, 0.0, 0.0)
        self.changed = True
        for index in (_SPEED, _TORQUE):
            dictionary.on_write(index, self._written)
        dictionary.on_write(_LIMIT, lambda _sub, _value: self._tell(*self._told[1:]))

    def feed_forward(self) -> None:
        """Take limit and offsets as they are now."""
        self._tell(self._number(_SPEED) * self._parameters.units.speed_scale, float(self._number(_TORQUE)))
        self.changed = False

    def feed_torque(self) -> None:
        """Take limit and torque offset: every cycle of a velocity mode."""
        self._tell(0.0, float(self._number(_TORQUE)))

    def release(self) -> None:
        """Limit only."""
        self._tell(0.0, 0.0)

    def _written(self, subindex: int, value: Value) -> None:
        self.changed = True

    def _tell(self, speed: float, torque: float) -> None:
        self.changed = True
        wanted = (self._parameters.max_torque, speed, torque)
        if wanted != self._told:
            self._told = wanted
            self._plant.set_loop(self._axis, *wanted)
