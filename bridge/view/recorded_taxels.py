"""The tactile images of a recorded bus, without the rest of the cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.bus.candump import read_candump
from canprobe.cell.build import TACTILE_DEADLINE_CYCLES
from canprobe.planning import make_plan
from canprobe.protocol.frames import SYNC_ID
from canprobe.protocol.tactile import FrameAssembler, TactileMode
from canprobe.scene import Scene

TaxelFrames = tuple[tuple[float, NDArray[np.uint8]], ...]


def read_taxels(file: Path, scene: Scene) -> TaxelFrames:
    """Tactile frames with the time of their arrival after the first SYNC.

    Args:
        file: a candump log; nothing comes from one that does not exist.
        scene: with a sensor.

    Returns:
        (t_s, (16, 16) uint8 counts) by rising time; empty in features mode.

    Raises:
        UsageError: a line that is not candump's.
    """
    assert scene.sensor is not None
    mode = TactileMode[scene.sensor.mode.upper()]
    if mode is TactileMode.FEATURES or not file.is_file():
        return ()
    plan = make_plan(scene)
    pdos = plan.pdos_of(scene.sensor.node_id, "tpdo")
    cob_ids = [pdo.cob_id for pdo in pdos]
    sizes = [pdo.layout.length for pdo in pdos]
    assembler = FrameAssembler(cob_ids, mode, TACTILE_DEADLINE_CYCLES * plan.sync.period_ns, sizes)
    start: int | None = None
    frames = []
    for t_ns, _, can_id, data in read_candump(file, only={SYNC_ID, *cob_ids}):
        if start is None and can_id == SYNC_ID:
            start = t_ns
        frame = assembler.push(can_id, data, t_ns)
        if frame is not None and start is not None:
            frames.append(((t_ns - start) * 1e-9, frame.taxels))
    return tuple(frames)
