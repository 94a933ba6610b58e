"""What a drive tells the plant's position loop: the torque limit 6072h and the feed-forwards 60B1h and 60B2h.

The feed-forwards act in the mode that gives them; leaving it takes them back. In cyclic synchronous velocity 60B1h is
part of the target already, and in cyclic synchronous torque both are: there the loop gets none.
Source: CiA 402-2, objects 6072h, 60B1h, 60B2h.
"""

from __future__ import annotations

from canprobe.emulator.drive_motion import AxisPlant
from canprobe.emulator.drive_parameters import PEAK_PERMILLE, DriveParameters
from canprobe.emulator.entries import Value, key_of

_SPEED, _TORQUE = key_of(0x60B1), key_of(0x60B2)


class DriveLoop:
    """Torque limit and feed-forwards of one axis; the plant hears of changes only.

    Args:
        axis: of the plant, 0-based.
        plant: shared with the other drives.
        parameters: of the drive.
        values: of its dictionary.
    """

    def __init__(self, axis: int, plant: AxisPlant, parameters: DriveParameters, values: dict[int, Value]) -> None:
        self._axis, self._plant, self._parameters, self._values = axis, plant, parameters, values
        self._told: tuple[int, float, float] = (PEAK_PERMILLE, 0.0, 0.0)
        self._seen: tuple[Value, Value, int] | None = None

    def feed_forward(self) -> None:
        """Take limit and offsets as they are now: every cycle of a position mode."""
        get, parameters = self._values.get, self._parameters
        seen = get(_SPEED, 0), get(_TORQUE, 0), parameters.max_torque
        if seen != self._seen:
            self._tell(float(seen[0]) * parameters.units.speed_scale, float(seen[1]))
            self._seen = seen

    def feed_torque(self) -> None:
        """Take limit and torque offset: every cycle of a velocity mode."""
        self._tell(0.0, float(self._values.get(_TORQUE, 0)))

    def limit(self) -> None:
        """Take the limit as it is now."""
        self._tell(*self._told[1:])

    def release(self) -> None:
        """Limit only."""
        self._tell(0.0, 0.0)

    def _tell(self, speed: float, torque: float) -> None:
        self._seen = None
        wanted = (self._parameters.max_torque, speed, torque)
        if wanted != self._told:
            self._told = wanted
            self._plant.set_loop(self._axis, *wanted)
