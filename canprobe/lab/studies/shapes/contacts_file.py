"""The file of contacts: what every method gets, with the truth that it is scored against."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from canprobe.cell.npz import read_npz, write_npz
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.scene.setup import Touch
from canprobe.cell.tasks.from_plan import SIGMA_NORMAL_RAD, centroid_coupling
from canprobe.lab.studies.shapes.implicit import Touched
from canprobe.lab.studies.shapes.scans import samples_of
from canprobe.mechanics.touch.contact import ContactSample
from canprobe.mechanics.types import Floats


class ShapeContacts(NamedTuple):
    """Contacts of a shape, for a method.

    Attributes:
        samples: contacts in the order of time, with their stated noise.
        touched: their places, normals and noise, base.
        task: the scan's setup: array, calibration, probe, speed; the estimators' model of the sensor.
    """

    samples: list[ContactSample]
    touched: Touched
    task: Touch

    def until(self, seconds: float) -> ShapeContacts:
        """The contacts of the first seconds of the scan."""
        count = sum(sample.t_s <= self.samples[0].t_s + seconds for sample in self.samples)
        return self._replace(samples=self.samples[:count], touched=self.touched.some(slice(count)))


def write_contacts(path: Path, shapes: Mapping[str, Mapping[str, Any]]) -> str:
    """Write the file of contacts; its SHA-256."""
    write_npz(path, {f"{name}/{key}": np.asarray(v) for name, columns in shapes.items() for key, v in columns.items()})
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_columns(path: Path, name: str) -> dict[str, Floats]:
    """Columns of a shape."""
    prefix = f"{name}/"
    return {k.removeprefix(prefix): v for k, v in read_npz(path, "contacts").items() if k.startswith(prefix)}


def read_contacts(path: Path, name: str) -> ShapeContacts:
    """The contacts of a shape with the setup that was stated for all of them."""
    columns = read_columns(path, name)
    samples = samples_of(columns)
    task = resolve(load_scene("cylinder")).task
    assert isinstance(task, Touch)
    sigma = np.hypot(columns["sigma"][:, 0], columns["sigma"][:, 2])
    height = np.where(np.isnan(columns["sigma"][:, 3]), sigma, columns["sigma"][:, 3])
    normal = np.hypot(SIGMA_NORMAL_RAD, sigma * centroid_coupling(task.probe))
    return ShapeContacts(samples, Touched(columns["p_base"], columns["n_base"], height, normal), task)
