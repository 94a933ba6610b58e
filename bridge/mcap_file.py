"""One MCAP file for a run: ROS 2 messages with their definitions, and scene, EDS, DBC and summary as attachments.

Source: MCAP specification, well-known profile `ros2`, message encoding `cdr`, schema encoding `ros2msg`; channel
metadata as rosbag2_storage_mcap writes it.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import Writer

from canprobe import __version__
from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import SAVED_AS
from canprobe.errors import ResultsError, UsageError
from canprobe.fieldbus.bus.files import make_folder
from canprobe.fieldbus.eds.packaged import eds_file
from canprobe.lab.bridge.database import plan_database
from canprobe.lab.bridge.messages import CLOCK, TOPICS, Encoder, Messages, Topic
from canprobe.lab.bridge.sample import Context, Sample


class McapSink:
    """Writes `run.mcap` into the run's folder.

    Args:
        context: plan and settings of the run.
    """

    def __init__(self, context: Context) -> None:
        if context.out is None:
            raise UsageError("it writes a file, and this run has no folder: name one (out=, --out)")
        make_folder(context.out)
        self._context = context
        self._path = context.out / str(BRIDGES["mcap"].output)
        self._part = self._path.with_suffix(".mcap.part")  # a run that breaks off leaves no file that looks whole
        self._encoder = Encoder()
        self._messages = Messages(context.plan, self._encoder, lambda topic: topic is not CLOCK)
        self._file = self._part.open("wb")
        self._writer = Writer(self._file)
        self._writer.start(profile="ros2", library=f"canprobe {__version__}")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._counts = Counter[str]()
        self._last_ns = 0
        self.where = str(self._path)

    def start(self, epoch_ns: int) -> None:
        """Take the epoch, and register every channel, even those that will have no message."""
        self._messages.epoch_ns = epoch_ns
        for topic in TOPICS:
            if topic is not CLOCK:
                self._channels[topic.name] = self._register(topic)

    def write(self, sample: Sample) -> None:
        """Write the messages of a sample."""
        with self._or_none():
            for topic, t_ns, data in self._messages.of(sample):
                self._counts[topic.name] += 1
                self._writer.add_message(self._channels[topic.name], t_ns, data, t_ns, self._counts[topic.name])
                self._last_ns = max(self._last_ns, t_ns)

    def close(self, summary: str | None) -> None:
        """Attach scene and summary, write the index, and give the file its name."""
        attachments = _attachments(self._context.plan, self._path.parent, summary)
        with self._or_none():
            for name, media_type, content in attachments:
                self._writer.add_attachment(self._last_ns, self._last_ns, name, media_type, content)
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()
            os.replace(self._part, self._path)

    @contextlib.contextmanager
    def _or_none(self) -> Iterator[None]:
        """Remove the file where it cannot be written (full disk), and raise ResultsError."""
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.close()  # what it still holds cannot be written either
            self._part.unlink(missing_ok=True)
            raise ResultsError(f"{self._path}: cannot be written: {error.strerror or error}") from error

    def _register(self, topic: Topic) -> int:
        schema = self._schemas.get(topic.type_name)
        if schema is None:
            text = self._encoder.definition(topic.type_name).encode()
            schema = self._schemas[topic.type_name] = self._writer.register_schema(topic.type_name, "ros2msg", text)
        type_hash = self._encoder.type_hash(topic.type_name)
        metadata = {"offered_qos_profiles": _qos_yaml(topic), "topic_type_hash": type_hash}
        return self._writer.register_channel(topic.name, "cdr", schema, metadata)


open_sink = McapSink


def _qos_yaml(topic: Topic) -> str:
    """Quality of service as rosbag2 stores it, so that a replay offers it again."""
    return (
        "- history: keep_last\n"
        f"  depth: {topic.depth}\n"
        f"  reliability: {'best_effort' if topic.best_effort else 'reliable'}\n"
        f"  durability: {'transient_local' if topic.transient else 'volatile'}\n"
        "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
        "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
        "  liveliness: automatic\n"
        "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
        "  avoid_ros_namespace_conventions: false\n"
    )


def _attachments(plan: Plan, folder: Path, summary: str | None) -> Iterator[tuple[str, str, bytes]]:
    """Name, media type and content of each attachment; without a summary that of the folder, if any."""
    yield SAVED_AS, "application/toml", plan.files[SAVED_AS]
    for eds in dict.fromkeys(node.eds for node in plan.nodes):
        path = eds_file(eds)
        yield path.name, "text/plain", path.read_bytes()
    if importlib.util.find_spec("cantools") is not None:
        yield f"{plan.scene.name}.dbc", "text/plain", plan_database(plan).as_dbc_string().encode("cp1252")
    if summary is not None:
        yield "summary.json", "application/json", summary.encode()
    elif (folder / "summary.json").is_file():
        yield "summary.json", "application/json", (folder / "summary.json").read_bytes()
