"""Nodes of a cell on a plant of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest
from node_bench import FakePlant, bench, drive, make_bench, rig, tiny_od  # noqa: F401


@dataclass
class FakeCellPlant(FakePlant):
    """Motors that are where their reference is, and an image set by hand."""

    image: np.ndarray = field(default_factory=lambda: np.zeros((16, 16), np.uint8))
    sampled: list[int] = field(default_factory=list)
    config: SimpleNamespace = field(default_factory=lambda: SimpleNamespace(model=None))

    def sample_image(self, t_ns: int) -> np.ndarray:
        self.sampled.append(t_ns)
        return self.image.copy()

    def state(self) -> int:
        return self.t_ns

    def truths(self, states: Sequence[int]) -> dict[str, np.ndarray]:
        return {"q": np.outer(states, np.full(6, 1e-9)), "force": np.full(len(states), 2.0)}


@pytest.fixture
def plant() -> FakeCellPlant:
    """A plant of numbers."""
    return FakeCellPlant()
