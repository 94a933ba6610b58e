"""The tactile images of a recorded bus, without the rest of the cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.candump import read_candump
from canprobe.cell.build import make_tactile
from canprobe.planning import make_plan
from canprobe.scene import Scene
from canprobe.scene_resolve import resolve

TaxelFrames = tuple[tuple[float, NDArray[np.uint8]], ...]


def read_taxels(file: Path, scene: Scene) -> TaxelFrames:
    """Tactile frames with the time of their arrival, on the clock of the log.

    Args:
        file: a candump log; nothing comes from one that does not exist.
        scene: with a sensor.

    Returns:
        (t_s, (16, 16) uint8 counts) by rising time; empty in features mode.

    Raises:
        UsageError: a line that is not candump's.
    """
    assert scene.sensor is not None
    if scene.sensor.mode == "features" or not file.is_file():
        return ()
    receiver = make_tactile(make_plan(resolve(scene)))
    assert receiver is not None
    frames = []
    for t_ns, _, can_id, data in read_candump(file, only=frozenset(receiver.cob_ids)):
        frame = receiver.assembler.push(can_id, data, t_ns)
        if frame is not None:
            frames.append((t_ns * 1e-9, frame.taxels))
    return tuple(frames)
