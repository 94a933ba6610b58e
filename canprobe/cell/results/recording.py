"""A recording of images as a CSV file, one row an image; with the pose of the probe, where there is one.

    t_s, T00, T01, … T23, p0_0, p0_1, …

`t_s` is the instant at which the array was sampled, s. `T00` to `T23` are the first three rows of the pose (4, 4) of
the probe in base at that instant, m; without a pose they are left out. `p0_0` … are the counts of the taxels.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from canprobe.fieldbus.bus.files import writing
from canprobe.mechanics.types import Floats


@contextlib.contextmanager
def recording(path: Path) -> Iterator[Callable[..., None]]:
    """A file that is recorded; the block gets the function that adds a row.

    Rows stand in the file as they come, so that what ends the block leaves all before it. An older file is replaced.

    Raises:
        ResultsError: the file cannot be written.
    """
    with writing(path):
        file = path.open("w", encoding="ascii", newline="\n")

    def add(t_s: float, image: NDArray[np.uint8], T_base_probe: Floats | None = None) -> None:
        pose = [] if T_base_probe is None else [f"{entry:.8f}" for entry in T_base_probe[:3].flat]
        with writing(path):
            if file.tell() == 0:
                of_pose = [f"T{i}{j}" for i, j in np.ndindex(3, 4)][: len(pose)]
                print("t_s", *of_pose, *[f"p{i}_{j}" for i, j in np.ndindex(image.shape)], sep=",", file=file)
            print(f"{t_s:.6f}", *pose, *image.flat, sep=",", file=file, flush=True)

    with file:
        yield add
