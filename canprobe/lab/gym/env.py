"""`canprobe/TouchScan-v0`: lead the probe over an unknown surface and touch as much of it as possible, evenly."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from canprobe.cell.planning.make import make_plan
from canprobe.cell.planning.model import Plan
from canprobe.cell.scene.load import load_scene
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.cell.session.target import VIRTUAL
from canprobe.errors import UsageError
from canprobe.lab.gym.episode import Episode
from canprobe.lab.gym.observations import KINDS, Kind, Observations
from canprobe.lab.gym.randomise import START_MM, Values, overrides_of
from canprobe.mechanics.touch.checks import checked

DEFAULT_SCENE: Mapping[str, Any] = {
    "object.position_mm": START_MM,
    "task.start_mm": START_MM,
    "task.duration_s": 2.5,
    "task.speed_mm_s": 60.0,
    "task.length_mm": 24.0,
    "task.width_mm": 16.0,
    "task.wavelength_mm": 8.0,
    "task.clearance_mm": 1.5,
    "task.regain_mm": 0.0,
    "task.search_mm": 8.0,
    "arm.torque": False,
}
"""Changes of the default scene to the packaged `cylinder`: a place where the arm reaches round every object of
`OBJECTS`, and a short scan of a wide region at up to 60 mm/s, which ends where contact is lost. Torques of the drives
are a second witness of the force beside the array: without them a step takes a fifth less time, and an approach has to
be told how far it may search."""
VIRTUAL_BUS: Mapping[str, Any] = {"bus.interface": "direct", "outputs.figures": False, "shape.also": ()}
"""Changes of an environment to every scene."""


class TouchScan(gymnasium.Env[Any, NDArray[np.float32]]):
    """Lead the probe over an unknown surface, and touch as much of it as possible with the wanted force.

    Action (3,), each in [−1, 1]: velocity of the contact along x and y of the contact frame, in shares of
    `task.speed_mm_s` (together at most 1), and force set-point, `task.force_n` × (1 + action/2). The cell changes to
    these values evenly within the step. x is the heading of the scan laid into the tangent plane, z the outward normal.

    Reward of a step: area of the region that was touched for the first time, in mm², times exp(−½ (ΔF/σ)²) with ΔF
    the error of the true force at the end of the step and σ 5 % of the wanted force. The region is `task.length_mm` ×
    `task.width_mm` round the first contact; what is within 1.5 mm of the contact counts as touched. Where the
    supervision ends the episode, 20 mm² are subtracted. The return of an episode, in mm², is the area touched well.

    Args:
        scene: scene of a scan: a packaged name, a path or a `Scene`; None for `cylinder` with `DEFAULT_SCENE`.
        observation: `features`, `tactile` or `oracle`, see `Observations`.
        estimate: whether the surface estimator runs in the loop; else its features are missing too.
        control_hz: number of actions a second; each takes a whole number of cycles.
        options: options of every episode; those of `reset` replace them.
        record: folder in which each episode writes the files of a run, in `episode-N`, for `canprobe view`.
        render_mode: None; there is no other.

    Attributes:
        names: names of the entries of an observation's vector, with their units.

    Raises:
        UsageError: when an argument is wrong.
        SceneError, PlanError: when the scene is wrong, or does not fit.
    """

    def __init__(
        self,
        scene: Scene | str | Path | None = None,
        *,
        observation: Kind = "features",
        estimate: bool = True,
        control_hz: float = 25.0,
        options: Values = {"objects": "train"},  # noqa: B006 - it is only read
        record: str | Path | None = None,
        render_mode: None = None,
    ) -> None:
        if observation not in KINDS:
            raise UsageError(f"observation: expected one of {', '.join(KINDS)}, got {observation!r}")
        if render_mode is not None:
            raise UsageError(f"render_mode: expected None, got {render_mode!r}; record episodes and open canprobe view")
        own = load_scene("cylinder", DEFAULT_SCENE) if scene is None else load_scene(scene)
        if own.task.kind != "scan":
            raise UsageError(f'scene: expected task.kind = "scan", got "{own.task.kind}"')
        self._base = load_scene(own, VIRTUAL_BUS)
        self._estimate = estimate
        self._options = dict(options)
        self._record = None if record is None else Path(record)
        plan = self._plan({})
        rate_hz = plan.setup.rate_hz
        self._cycles = round(rate_hz / control_hz) if control_hz > 0 else 0
        if self._cycles < 1 or not math.isclose(self._cycles * control_hz, rate_hz):
            raise UsageError(f"control_hz: expected a whole part of cycle.rate_hz = {rate_hz:g}, got {control_hz:g}")
        self._observations = Observations(observation, plan, shape=estimate)
        self.names, self.observation_space = self._observations.names, self._observations.space
        self.action_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
        self.episode: Episode | None = None
        self._recorded = 0

    def reset(self, *, seed: int | None = None, options: Values | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw a scene, bring its cell up, approach and touch.

        Args:
            seed: seed of all episodes from here on.
            options: values by the keys of a scene file, such as `{"object.radius_mm": 50}`, fixed or drawn (`Uniform`,
                `OneOf`), and `objects`: the name of a set of `OBJECTS`, or None for the object of the scene. They come
                on top of those of the environment; one that names a key of the object starts from that of the scene.

        Returns:
            Observation, and `info` with `overrides`: the drawn values.

        Raises:
            SceneError: when an option is wrong.
            PlanError: when the drawn scene does not fit.
            SafetyStop, BusError: when its object was not touched.
        """
        super().reset(seed=seed)
        self.close()
        asked = dict(options or {})
        if any(key.partition(".")[0] == "object" for key in asked):
            asked = {"objects": None} | asked
        overrides = overrides_of(self._options | asked, self.np_random)
        overrides["scene.seed"] = int(self.np_random.integers(2**31))
        folder = None
        if self._record is not None:
            self._recorded += 1
            folder = self._record / f"episode-{self._recorded:04d}"
        self.episode = Episode(self._plan(overrides), self._cycles, folder)
        return self._observations.observe(self.episode), self.episode.info() | {"overrides": overrides}

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Lead the probe for one step.

        Args:
            action: action (3,), as the class describes it.

        Returns:
            Observation, reward in mm², terminated, truncated, and `info` with the truth.

        Raises:
            UsageError: when no episode is under way, or the action is not three finite numbers.
        """
        episode = self.episode
        if episode is None or episode.over:
            raise UsageError("no episode is under way: call reset()")
        reward = episode.step(np.clip(checked("action", action, (3,)), -1.0, 1.0))
        terminated = episode.reason is not None
        over = episode.over and not terminated
        return self._observations.observe(episode), reward, terminated, over, episode.info()

    def close(self) -> None:
        """Disable the drives and end the cell; `reset` brings another one up."""
        episode, self.episode = self.episode, None
        if episode is not None:
            episode.close()

    def _plan(self, overrides: Mapping[str, Any]) -> Plan:
        scene = load_scene(self._base, overrides)
        if scene.bus.interface not in VIRTUAL:
            raise UsageError(f'bus.interface: expected one of {", ".join(VIRTUAL)}, got "{scene.bus.interface}"')
        return make_plan(resolve(scene if self._estimate else replace(scene, shape=None)))
