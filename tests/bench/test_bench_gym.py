"""What an episode of the environment costs: a step of 16 cycles, a reset, and environments in processes of their own.

A step is 40 ms of a cell, and a step of a vector that of each environment.
"""

import gymnasium
import numpy as np
import pytest

import canprobe.lab.gym  # noqa: F401 - it registers the environment

NAME = "canprobe.lab.gym:canprobe/TouchScan-v0"
LONG = {"objects": None, "task.duration_s": 600.0, "object.radius_mm": 60}
"""An episode that does not end meanwhile."""
TURN = np.array([[0.4 * np.cos(0.3 * step), 0.4 * np.sin(0.3 * step), 0.0] for step in range(600)], dtype=np.float32)


def stepping(step, actions):
    """Lead the probe round in circles, one step a call."""
    actions = iter(actions)
    return lambda: step(next(actions))


@pytest.mark.parametrize("estimate", [False, True], ids=["without", "estimate"])
def test_step(benchmark, estimate):
    env = gymnasium.make(NAME, estimate=estimate, options=LONG)
    env.reset(seed=1)
    benchmark.pedantic(stepping(env.step, TURN), rounds=500, warmup_rounds=20)
    env.close()


def test_reset(benchmark):
    env = gymnasium.make(NAME, estimate=False)
    benchmark.pedantic(env.reset, rounds=20, warmup_rounds=1)
    env.close()


@pytest.mark.parametrize("processes", [1, 2, 4])
def test_step_in_processes(benchmark, processes):
    envs = gymnasium.make_vec(NAME, num_envs=processes, vectorization_mode="async", estimate=False, options=LONG)
    envs.reset(seed=1)
    benchmark.pedantic(stepping(envs.step, np.stack([TURN] * processes, axis=1)), rounds=300, warmup_rounds=20)
    envs.close()
