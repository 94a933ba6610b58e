"""The bus of a scene or a command: interface, channels and bit rate as one object, applied to a scene or opened."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from canprobe.cell.session.links import ExpectedLink, check_links, need_controllers
from canprobe.errors import BusError, UsageError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port
from canprobe.fieldbus.bus.real.adapters import SOCKETCAN, check_interface_name

if TYPE_CHECKING:
    from canprobe.cell.master.options import Say
    from canprobe.cell.scene.model import Scene

LOCKSTEP, DIRECT = "lockstep", "direct"
VIRTUAL = (LOCKSTEP, DIRECT)
"""Interfaces in this process, in virtual time."""


@dataclass(frozen=True, slots=True)
class Target:
    """The bus of a run or a command.

    Attributes:
        interface: `lockstep`, `direct` (no bus), `socketcan` or another interface of python-can.
        channel: channel of the interface, which replaces the scene's `bus.channel`.
        bitrate: bit rate, bit/s.
        others: names that replace the scene's other channels; a channel that is not listed stays.
    """

    interface: str
    channel: str
    bitrate: int
    others: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def over(
        cls,
        scene: Scene,
        bus: str | None = None,
        channel: str | Mapping[str, str] | None = None,
        bitrate: int | None = None,
    ) -> Target:
        """The bus of a scene, with the given values in the place of its own.

        Args:
            scene: the scene.
            bus, bitrate: replace the scene's interface and bit rate.
            channel: replaces `bus.channel`; or a mapping from each channel of the scene to another name.

        Raises:
            UsageError: when the scene names no such channel, or a value would be refused in its file.
        """
        from canprobe.cell.scene.load import load_scene

        others = dict(channel) if isinstance(channel, Mapping) else {}
        if unknown := sorted(str(name) for name in others if name not in scene.channels):
            raise UsageError(f"channel: the scene has no channel {unknown[0]}, only {', '.join(scene.channels)}")
        others = {name: load_scene(scene, {"bus.channel": other}).bus.channel for name, other in others.items()}
        main = others.pop(scene.bus.channel, None) if isinstance(channel, Mapping) else channel
        given = (("interface", bus), ("channel", main), ("bitrate", bitrate))
        new = {f"bus.{key}": value for key, value in given if value not in (None, getattr(scene.bus, key))}
        settings = load_scene(scene, new).bus if new else scene.bus
        check_interface_name(settings.interface, VIRTUAL)
        return cls(settings.interface, settings.channel, settings.bitrate, others)

    def applied_to(self, scene: Scene) -> Scene:
        """The scene on this bus."""
        bus = replace(scene.bus, interface=self.interface, channel=self.channel, bitrate=self.bitrate)
        names: dict[str | None, str] = {scene.bus.channel: self.channel}
        names.update(self.others.items())

        def placed(part: Any) -> Any:
            return part and replace(part, channel=names.get(part.channel, part.channel))

        joints = {name: placed(joint) for name, joint in scene.joints.items()}
        return replace(scene, bus=bus, joints=joints, sensor=placed(scene.sensor), carrier=placed(scene.carrier))


def refuse_virtual(interface: str, command: str) -> None:
    """Refuse an interface that ends with its run.

    Raises:
        UsageError: when the interface is lockstep or direct.
    """
    if interface in VIRTUAL:
        what = "a lockstep bus lives inside one run" if interface == LOCKSTEP else "there is no bus in --bus direct"
        raise UsageError(
            f"{command}: {what}; name a real one, such as --bus {SOCKETCAN} --channel can0 (`canprobe adapters` lists"
            " those here)"
        )


@contextlib.contextmanager
def open_bus(target: Target, say: Say, data_bitrate: int | None = None) -> Iterator[Port]:
    """A port of a bus without a scene, of CAN FD where a data bit rate is given; a wrong setting is only a warning."""
    from canprobe.fieldbus.bus.real.opening import open_port

    interface, channel = target.interface, target.channel
    check_links(interface, {channel: ExpectedLink(target.bitrate, of_scene=False)}, say, must=False)
    port = open_port(interface, channel, target.bitrate, MonotonicClock(), data_bitrate=data_bitrate)
    try:
        yield port
    except BusError as error:
        need_controllers(interface, {channel: port}, error)
        raise
    finally:
        port.close()
