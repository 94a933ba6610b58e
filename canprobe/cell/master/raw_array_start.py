"""Start and stop of an array of raw frames, which is no node and has no NMT state."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from canprobe.cell.master.array import RawReceiver
from canprobe.errors import BusError
from canprobe.fieldbus.bus.joined import send_on
from canprobe.fieldbus.bus.pumped import PumpedNetwork


class RawArrayStart:
    """Starts an array of raw frames, and stops what it started.

    Args:
        array: receiver of its images.
        network: that its frames arrive by.
        boot_up_s: time for it to start.
        say: called with each step.
    """

    def __init__(
        self, array: RawReceiver, network: PumpedNetwork, boot_up_s: float, say: Callable[[str], None]
    ) -> None:
        self._array = array
        self._network = network
        self._boot_up_s = boot_up_s
        self._say = say
        self._started = False

    def start(self) -> None:
        """Start the array, and wait for as many images as its tare takes, at least one.

        Raises:
            BusError: they do not come.
        """
        array, port = self._array, self._network.port
        wire, clock = array.wire, port.clock
        self._say(f"start the array on {array.channel}")
        self._started = True
        send_on(port, array.channel, wire.start)
        if wire.sampling == "sync":
            return  # its images begin with the cycle
        if wire.tare_images:
            self._say(f"tare the array: {wire.tare_images} images, with nothing on it")
        needed, period_s = max(1, wire.tare_images), 1.0 / array.rate_hz
        end_ns = clock.now_ns() + round(1e9 * (self._boot_up_s + 2.0 * needed * period_s))
        while array.images < needed:
            if clock.now_ns() >= end_ns:
                first, last = min(array.cob_ids), max(array.cob_ids)
                ids = f"{first:03X}h" if first == last else f"{first:03X}h-{last:03X}h"
                raise BusError(
                    f"{array.channel}: the array sent {array.images} of {needed} images of its frames {ids} in time"
                    f" ({array.torn} were not whole); check its power, its channel (sensor.channel), and wire.ids,"
                    " wire.frames and wire.start of its array file"
                )
            if wire.poll:
                send_on(port, array.channel, wire.poll)
            self._network.pump_until(partial(array.has, array.images + 1), 1.5 * period_s)

    def stop(self) -> None:
        """Stop the array if it was started."""
        if self._started:
            send_on(self._network.port, self._array.channel, self._array.wire.stop)
