"""A real bus without a scene, opened for a command; none of a cell is imported for it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING

from canprobe.cell.session.links import ExpectedLink, check_links, need_controllers
from canprobe.errors import BusError
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.fieldbus.bus.port import Port

if TYPE_CHECKING:
    from canprobe.cell.master.options import Say
    from canprobe.cell.session.target import Target


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
