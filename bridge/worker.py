"""The process of one bridge: it reads records of the cell from stdin, makes samples, and answers with lines of JSON.

The lines are `{"ready": where}`, then requests of the other tool, then `{"done": n}` with their number, or
`{"error": text}` at any time. Where stdin ends without a last record the cell is gone, and the sink is closed too.
A file is done when it is closed. A live view is done before that: a viewer that does not read delays its close.
"""

from __future__ import annotations

import importlib
import json
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path

from canprobe.cell.planning.bridges import BRIDGES
from canprobe.cell.planning.make import make_plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import BridgeSettings
from canprobe.cell.scene.resolve import resolve
from canprobe.errors import CanprobeError, ResultsError
from canprobe.lab.bridge.pipe import read_records, unpack_observation
from canprobe.lab.bridge.process import END
from canprobe.lab.bridge.sample import Context, Sink
from canprobe.lab.bridge.sampling import SampleSource

NICE = 10
"""Niceness of the process: the cell and its nodes have priority over a bridge."""


def run(name: str, scene: str, out: Path | None, records: Iterator[bytes], fd: int) -> int:
    """Serve one bridge to the end of its records.

    Args:
        name: name of the bridge.
        scene: path of the scene's file.
        out: folder of the run; None where no files are written.
        records: observations; the last record may be the end.
        fd: file descriptor on which lines are written back.

    Returns:
        The exit status: 0, or 1 after an error, which was written back.
    """

    def send(document: dict[str, object]) -> None:
        os.write(fd, (json.dumps(document) + "\n").encode())

    try:
        plan = make_plan(resolve(load_scene(scene)))
        context = Context(plan, plan.scene.bridge or BridgeSettings(), out, send)
        sink: Sink = importlib.import_module(f"canprobe.lab.bridge.{BRIDGES[name].module}").open_sink(context)
        send({"ready": sink.where})
        received, summary = _serve(sink, SampleSource(context.plan), records)
        done: dict[str, object] = {"done": received}
        if BRIDGES[name].live:
            send(done)
        sink.close(summary)
        if not BRIDGES[name].live:
            send(done)
    except BrokenPipeError:
        return 1  # the cell is gone, and the sink is closed
    except (CanprobeError, OSError) as error:
        send({"error": str(error), "unwritten": isinstance(error, ResultsError)})
        return 1
    except Exception as error:  # a line for the cell, the whole for whoever looks for it
        traceback.print_exc()
        send({"error": repr(error)})
        return 1
    return 0


def _serve(sink: Sink, source: SampleSource, records: Iterator[bytes]) -> tuple[int, str | None]:
    """Give the sink every sample; returns their number, and the summary."""
    received = 0
    for record in records:
        body = record[1:]
        if record[:1] == END:
            return received, body.decode() or None
        if not received:
            sink.start(int.from_bytes(body[:8], "little"))
        sink.write(source.sample(unpack_observation(body[8:])))
        received += 1
    return received, None


def main() -> int:
    """The process: Ctrl-C is for the cell, which ends this one by the end of its records.

    Its arguments are those of `run`: name, scene and folder, which may be missing.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.nice(NICE)
    fd = os.dup(1)
    os.dup2(2, 1)  # what a library prints does not mix with the lines back
    name, scene, *out = sys.argv[1:]
    return run(name, scene, Path(out[0]) if out else None, read_records(sys.stdin.buffer), fd)


if __name__ == "__main__":
    sys.exit(main())
