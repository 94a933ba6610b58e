"""Learn how fast to go and how hard to press: a policy of five numbers, by the cross-entropy method.

The path is given: lanes over the region, for the policy and the baselines alike. Needs the extra `gym`; copy the file
and go on from here. Run it with `python -m canprobe.lab.examples.learn_touch_scan`.
"""

# %% A policy that follows a path over the region of the environment
import argparse
import signal
import sys
from collections.abc import Sequence
from multiprocessing import Pool
from typing import Any

import gymnasium
import numpy as np

import canprobe.lab.gym  # it registers the environment

Floats = np.ndarray[Any, Any]
LANES = [(11, 0), (11, 3), (-11, 3), (-11, 6), (11, 6), (11, -3), (-11, -3), (-11, 0), (-2, 0), (-11, -6), (11, -6)]
"""Corners of the path, mm along the heading and across it."""
NAMES = ["speed", "slower by the error of the force", "slower by the turn", "correct the force", "more force at speed"]


class Agent:
    """Follows the lanes; `theta` (5,) says how fast and how hard, see `NAMES`."""

    def __init__(self, theta: Floats, names: Sequence[str]) -> None:
        self.theta, self.at = theta, {name: i for i, name in enumerate(names)}
        self.corner, self.normal = 0, np.full(2, np.nan)

    def act(self, observation: Floats) -> Floats:
        """The action for an observation."""
        place, normal, (wanted, force) = (
            np.array([observation[self.at[name]] for name in names])
            for names in (
                ("along_mm", "across_mm"),
                ("normal_along", "normal_across"),
                ("wanted_force_n", "force_n"),
            )
        )
        if np.hypot(*(LANES[self.corner] - place)) < 2.0 and self.corner < len(LANES) - 1:
            self.corner += 1
        way = LANES[self.corner] - place
        turn = np.nan_to_num(np.hypot(*(normal - self.normal)))
        error = (force - wanted) / wanted
        base, by_error, by_turn, correct, at_speed = self.theta
        speed = 1 / (1 + np.exp(-base + 10 * by_error * abs(error) + 10 * by_turn * turn))
        press = 0.1 * at_speed * speed - 0.5 * correct * error
        self.normal = normal
        return np.array([*(speed * way / np.hypot(*way)), press], dtype=np.float32)


def fixed(speed: float) -> Floats:
    """The policy that keeps to a speed, as a share of the highest, and to the wanted force."""
    return np.array([np.log(speed / (1 - speed)), 0, 0, 0, 0])


# %% Episodes, on every processor
def open_environment() -> None:
    """Open the environment, once in each process."""
    globals()["env"] = gymnasium.make("canprobe/TouchScan-v0", estimate=False)


def start_worker() -> None:
    """Begin a process of the pool, which leaves Ctrl-C to its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    open_environment()


def episode_return(job: tuple[Floats, int, str]) -> float:
    """The area that one episode touched well, mm²; a job is (theta, seed, objects)."""
    theta, seed, objects = job
    env = globals()["env"]
    observation, _ = env.reset(seed=seed, options={"objects": objects})
    agent, total, over = Agent(theta, env.unwrapped.names), 0.0, False
    while not over:
        observation, reward, terminated, truncated, _ = env.step(agent.act(observation))
        total, over = total + reward, terminated or truncated
    return total


def returns(pool: Any, thetas: Sequence[Floats] | Floats, seeds: Sequence[int], objects: str) -> Floats:
    """Returns of episodes (thetas, seeds)."""
    jobs = [(theta, seed, objects) for theta in thetas for seed in seeds]
    return np.array(pool.map(episode_return, jobs, chunksize=1)).reshape(len(thetas), len(seeds))


# %% Learn it, and compare it with the wanted force at fixed speeds
def learn(pool: Any, seed: int, generations: int, population: int, episodes: int) -> Floats:
    """The mean of the last elite (5,)."""
    rng = np.random.default_rng(seed)
    mean, sigma = fixed(0.6), np.ones(5)
    for generation in range(generations):
        thetas = mean + sigma * rng.standard_normal((population, 5))
        scores = returns(pool, thetas, rng.integers(2**31, size=episodes).tolist(), "train").mean(axis=1)
        elite = thetas[np.argsort(scores)[-max(2, population // 3) :]]
        mean, sigma = elite.mean(axis=0), 0.8 * elite.std(axis=0) + 0.2 * sigma
        print(f"seed {seed}, generation {generation}: {scores.mean():.0f} mm², best {scores.max():.0f}", flush=True)
    return mean


def main(arguments: Sequence[str] | None = None) -> None:
    """Train from several seeds, and test on episodes that no training has seen."""
    parser = argparse.ArgumentParser(description="Learn how fast to go and how hard to press.")
    for name, default in {"seeds": 5, "generations": 3, "population": 8, "episodes": 3, "test": 6}.items():
        parser.add_argument(f"--{name}", type=int, default=default, help="[%(default)s]")
    args = parser.parse_args(arguments)
    with Pool(2, start_worker) as pool:
        learned = [learn(pool, seed, args.generations, args.population, args.episodes) for seed in range(args.seeds)]
        for theta in learned:
            print("; ".join(f"{name} {value:.2f}" for name, value in zip(NAMES, theta, strict=True)))
        for objects in canprobe.lab.gym.OBJECTS:
            test = range(10_000, 10_000 + args.test)
            for speed in (0.3, 0.4, 0.6, 0.8):
                mean = returns(pool, [fixed(speed)], test, objects).mean()
                print(f"{objects}: fixed force, {speed:.0%} of the highest speed: {mean:.1f} mm²", flush=True)
            means = returns(pool, learned, test, objects).mean(axis=1)
            print(f"{objects}: learned: {means.mean():.1f} mm², seeds {np.round(means, 1).tolist()}", flush=True)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        sys.exit(130)
