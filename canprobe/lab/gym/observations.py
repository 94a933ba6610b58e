"""Observations of an agent, with the bounds of their spaces."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from gymnasium import spaces

from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.setup import Touch
from canprobe.lab.gym.episode import SECTORS, Episode
from canprobe.mechanics.touch.contact import direction_to_pad
from canprobe.mechanics.touch.pad import COUNTS_MAX
from canprobe.mechanics.types import Floats

Kind = Literal["features", "tactile", "oracle"]
KINDS: tuple[Kind, ...] = ("features", "tactile", "oracle")


FARTHEST_MM = 50.0
"""Largest observed distance from the first contact."""


class Observations:
    """The observations of one kind.

    Args:
        kind: `features`, which the master measures; `tactile`, the same and the last image; `oracle`, the features and
            what is true.
        plan: plan of the scene; another scene of the same cell has the same spaces.
        shape: whether there is a surface estimator.

    Attributes:
        names: names of the entries of the vector, in order, with their units.
        space: bounds in these units.
    """

    def __init__(self, kind: Kind, plan: Plan, *, shape: bool) -> None:
        setup, task = plan.setup, plan.setup.task
        assert isinstance(task, Touch) and task.scan is not None
        force, speed, near = setup.limits.force_max, 1e3 * task.scan.speed, FARTHEST_MM
        pad, bend = 1e3 * task.array.pad.reach_m, 2.0 / task.probe.radius
        bounds = {
            "wanted_force_n": (0.0, force),
            "force_set_point_n": (0.0, force),
            "force_n": (0.0, force),
            "force_spread_n": (0.0, force),
            "pad_u_mm": (-pad, pad),
            "pad_v_mm": (-pad, pad),
            "velocity_x_mm_s": (-speed, speed),
            "velocity_y_mm_s": (-speed, speed),
            **_where("", near),
            "touched_share": (0.0, 1.0),
            **{f"left_{360 * sector // SECTORS}_deg": (0.0, 1.0) for sector in range(SECTORS)},
        }
        if shape:
            bounds |= {**_curvature("estimated_", bend), "estimated": (0.0, 1.0)}
        if kind == "oracle":
            bounds |= {"true_force_n": (0.0, force), **_where("true_", near), **_curvature("true_", bend)}
        self._low, self._high = np.array(list(bounds.values()), dtype=np.float32).T
        self._kind, self._shape, self._pad = kind, shape, task.array.pad.shape
        self.names = tuple(bounds)
        vector = spaces.Box(self._low, self._high, dtype=np.float32)
        both = spaces.Dict({"features": vector, "taxels": spaces.Box(0.0, 1.0, self._pad, np.float32)})
        self.space: spaces.Space[Any] = both if kind == "tactile" else vector

    def observe(self, episode: Episode) -> Any:
        """An element of the space: the task in contact, or as it was last, and the true state of the plant."""
        task = episode.task
        truth: Mapping[str, Any] = episode.truth
        contact = task.last_contact
        along, across, up = (task.axes @ (contact.p_base - episode.origin)).tolist()
        values: list[float] = [
            task.wanted_force,
            task.targets["target_force_n"],
            float(np.mean(episode.forces)),
            float(np.std(episode.forces)),
            *(1e3 * uv for uv in direction_to_pad(contact.r_probe, task.sensing.radius)),
            *(1e3 * v for v in task.velocity),
            *(1e3 * along, 1e3 * across, 1e3 * up),
            *(task.axes[:2] @ contact.n_base).tolist(),
            episode.coverage.share,
            *episode.coverage.left(np.array((along, across))).tolist(),
        ]
        if self._shape:  # estimated curvature, and the share of it that was observed
            estimate, found = task.estimate, [0.0] * 4
            if estimate is not None:
                found[:3] = _in_frame(estimate.curvature_tensor_base(), task.frame(contact.n_base))
                found[3] = float(np.mean(estimate.observed))
            values += found
        if self._kind == "oracle":
            tensor = truth["kappa"][0] * np.outer(truth["direction1"], truth["direction1"])
            tensor += truth["kappa"][1] * np.outer(truth["direction2"], truth["direction2"])
            values += [
                truth["force"],
                *(1e3 * task.axes @ (truth["contact_point"] - episode.origin)).tolist(),
                *(task.axes[:2] @ truth["contact_normal"]).tolist(),
                *_in_frame(tensor, task.frame(truth["contact_normal"])),
            ]
        vector = np.clip(np.array(values, dtype=np.float32), self._low, self._high)
        if self._kind != "tactile":
            return vector
        taxels = np.zeros(self._pad) if task.taxels is None else task.taxels
        return {"features": vector, "taxels": (taxels / COUNTS_MAX).astype(np.float32)}


def _where(which: str, near: float) -> dict[str, tuple[float, float]]:
    """A contact's place and normal in the scan plane and across it."""
    places = {f"{which}{axis}_mm": (-near, near) for axis in ("along", "across", "up")}
    return places | {f"{which}normal_{axis}": (-1.0, 1.0) for axis in ("along", "across")}


def _curvature(which: str, bend: float) -> dict[str, tuple[float, float]]:
    return {f"{which}k_{axes}_per_m": (-bend, bend) for axes in ("xx", "xy", "yy")}


def _in_frame(tensor: Floats, frame: Floats) -> list[float]:
    """A tensor (3, 3) of base as xx, xy, yy in the frame of rows x, y, z."""
    x, y, _ = frame
    return [float(x @ tensor @ x), float(x @ tensor @ y), float(y @ tensor @ y)]
