"""A live view in Foxglove: its WebSocket server, with the same channels as the MCAP file.

A channel without a subscriber costs nothing: no message is made for it. A viewer that cannot follow loses its oldest
messages in the server; neither the cell nor another viewer waits for it.
"""

from __future__ import annotations

from importlib import resources

import foxglove

from canprobe.errors import UsageError
from canprobe.lab.bridge.front import Front, hidden_address
from canprobe.lab.bridge.messages import TOPICS, Encoder, Messages, Topic
from canprobe.lab.bridge.sample import Context, Sample

ORIGINS = ("https://app.foxglove.dev", "https://studio.foxglove.dev", "https://embed.foxglove.dev", "file://")
"""Origins of Foxglove's pages; its desktop application is a page from a file. A page of a website is none."""
LAYOUT = "foxglove_layout.json"
STATIC_EVERY_NS = 1_000_000_000
"""Period of the fixed frames, ns: the protocol keeps no last message for viewers that connect later."""


class FoxgloveSink:
    """Serves one run.

    Args:
        context: plan and settings of the run.

    Raises:
        UsageError: when the address is taken, or does not belong to this machine.
    """

    def __init__(self, context: Context) -> None:
        settings, encoder = context.settings, Encoder()
        room = self._room = foxglove.Context()  # its channels are gone when nobody holds it
        self._channels = {topic.name: _channel(topic, encoder, room) for topic in TOPICS}
        self._messages = Messages(context.plan, encoder, self._is_watched, STATIC_EVERY_NS)
        where = f"{settings.foxglove_host}:{settings.foxglove_port}"
        try:
            self._front = Front(settings.foxglove_host, settings.foxglove_port, settings.origins, ORIGINS)
            hidden = hidden_address()
            self._server = foxglove.start_server(
                name=f"canprobe {context.plan.scene.name}", host=hidden, port=0, context=room
            )
        except (RuntimeError, OSError) as error:
            raise UsageError(f"{where}: {error}; set bridge.foxglove_port, 0 takes any that is free") from error
        self._front.forward_to(hidden, self._server.port)
        # the address for Foxglove's “open connection”, and the layout to import there
        layout = resources.files("canprobe") / "bridge" / LAYOUT
        self.where = f"ws://{settings.foxglove_host}:{self._front.port}, layout {layout}"

    def start(self, epoch_ns: int) -> None:
        """Take the epoch."""
        self._messages.epoch_ns = epoch_ns

    def write(self, sample: Sample) -> None:
        """Send the messages that have a subscriber."""
        for topic, t_ns, data in self._messages.of(sample):
            self._channels[topic.name].log(data, log_time=t_ns)

    def close(self, summary: str | None) -> None:
        """Stop the server."""
        self._front.close()
        self._server.stop()

    def _is_watched(self, topic: Topic) -> bool:
        return self._channels[topic.name].has_sinks()


open_sink = FoxgloveSink


def _channel(topic: Topic, encoder: Encoder, room: foxglove.Context) -> foxglove.Channel:
    schema = foxglove.Schema(
        name=topic.type_name, encoding="ros2msg", data=encoder.definition(topic.type_name).encode()
    )
    return foxglove.Channel(topic.name, schema=schema, message_encoding="cdr", context=room)
