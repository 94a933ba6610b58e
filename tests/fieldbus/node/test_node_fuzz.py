"""No frame, however broken, makes a node raise, grow, fall silent or enter a state that the tables do not have.

Random and mutated frames; the seed is printed on failure.
"""

from __future__ import annotations

import pytest
from node_fuzz import Watched, rage

from canprobe.fieldbus import load_eds
from canprobe.fieldbus.drive import make_drive_node


@pytest.mark.parametrize("kind", ["tiny", "drive"])
def test_random_and_mutated_frames(kind, make_bench, plant):
    node = make_bench().node if kind == "tiny" else make_drive_node(load_eds("puma260_joint", 5), 5, 0, plant)
    rage(Watched(node), 30_000, seed=20260)
