"""Where a scene or a command goes: interface, channels and bit rate as one object, put into a scene by one function."""

from __future__ import annotations

from dataclasses import dataclass, replace

from canprobe.errors import UsageError
from canprobe.scene.model import DIRECT, Scene
from canprobe.scene.rules import need_scene, with_values

LOCKSTEP = "lockstep"
VIRTUAL = frozenset({LOCKSTEP, DIRECT})
"""Interfaces in this process, in virtual time."""


@dataclass(frozen=True, slots=True)
class Target:
    """A bus.

    Attributes:
        interface: `lockstep`, `direct` (no bus), `socketcan` or another interface of python-can.
        channel: of the interface.
        bitrate: bit/s.
        sensor_channel: of the sensor's bus; None leaves it where the scene has it.
    """

    interface: str
    channel: str
    bitrate: int
    sensor_channel: str | None = None

    @classmethod
    def over(
        cls,
        scene: Scene,
        interface: str | None = None,
        channel: str | None = None,
        bitrate: int | None = None,
        sensor_channel: str | None = None,
    ) -> Target:
        """The bus of a scene, with what is given in the place of its values.

        Raises:
            UsageError: this is no scene, or a value is none that its file could have.
        """
        need_scene(scene)
        bus = with_values(scene.bus, interface=interface, channel=channel, bitrate=bitrate)
        return cls(bus.interface, bus.channel, bus.bitrate, sensor_channel)

    def applied_to(self, scene: Scene) -> Scene:
        """The scene on this bus."""
        bus = replace(scene.bus, interface=self.interface, channel=self.channel, bitrate=self.bitrate)
        sensor = scene.sensor and with_values(scene.sensor, channel=self.sensor_channel)
        return replace(scene, bus=bus, sensor=sensor)


def need_real_bus(scene: Scene, command: str) -> None:
    """Refuse a command that needs a bus which other processes can reach.

    Raises:
        UsageError: the scene's bus lives inside one run, or it has none.
    """
    refuse_virtual(scene.bus.interface, command)


def refuse_virtual(interface: str, command: str) -> None:
    """Refuse an interface that ends with its run.

    Raises:
        UsageError: it is one.
    """
    if interface == LOCKSTEP:
        raise UsageError(f"{command}: a lockstep bus lives inside one run; name a real interface with --bus")
    if interface == DIRECT:
        raise UsageError(f"{command}: there is no bus in --bus direct; name a real interface with --bus")
