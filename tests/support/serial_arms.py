"""Arms of other makes as data: a gantry, a SCARA, five joints, an S-R-S arm of seven; and random chains."""

import math

import numpy as np

from canprobe.mechanics.robot.chain import Chain
from canprobe.mechanics.robot.denavit_hartenberg import from_dh
from canprobe.mechanics.robot.model import ArmModel, Joint

RIGHT = math.pi / 2


def model_of(chain, units=5000.0, turn=2.9, slide=(0.0, 0.6)):
    """The chain with stops, speeds and gears, every other drive counting backwards, no drive at zero."""
    joints = [
        Joint(name, slides, *(slide if slides else (-turn, turn)), 1.0)
        for name, slides in zip(chain.joints, chain.prismatic, strict=True)
    ]
    signs = np.where(np.arange(chain.n) % 2, -1.0, 1.0)
    return ArmModel(chain, tuple(joints), np.diag(signs * units), 100.0 * np.arange(1, chain.n + 1))


def turned(axis):
    """A frame whose z is the given base axis (x, y or z)."""
    T = np.eye(4)
    T[:3, :3] = np.roll(np.eye(3), {"x": 2, "y": 1, "z": 0}[axis], axis=1)
    return T


def gantry():
    """Three linear axes x, y, z; the tool points down."""
    flange = turned("z")
    flange[:3, :3] = np.diag((1.0, -1.0, -1.0))
    fixed = [turned("x"), turned("x").T @ turned("y"), turned("y").T @ turned("z")]
    return model_of(Chain("gantry", ("x", "y", "z"), (True,) * 3, np.array(fixed), flange))


def scara():
    """Two turns, a slide and a turn, all about vertical axes; the tool points down."""
    rows = [(0.25, 0.0, 0.35, 0.0), (0.2, math.pi, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.05, 0.0)]
    return model_of(from_dh(rows, name="scara", prismatic=(False, False, True, False)), slide=(0.0, 0.2))


def five():
    """Base, shoulder, elbow, wrist up and down, wrist to the side; the tool goes on along the arm.

    A roll about the tool, as many arms of five joints have it last, would turn nothing of position and pole.
    """
    rows = [
        (0.0, RIGHT, 0.2, 0.0),
        (0.25, 0.0, 0.0, 0.0),
        (0.2, 0.0, 0.0, 0.0),
        (0.06, RIGHT, 0.0, 0.0),
        (0.1, 0, 0, 0),
    ]
    return model_of(from_dh(rows, name="five", T_last_flange=turned("x")))


def seven():
    """Shoulder and wrist of three crossing axes each, an elbow between."""
    d = (0.34, 0.0, 0.4, 0.0, 0.4, 0.0, 0.126)
    alpha = (-RIGHT, RIGHT, RIGHT, -RIGHT, -RIGHT, RIGHT, 0.0)
    return model_of(from_dh([(0.0, a, di, 0.0) for a, di in zip(alpha, d, strict=True)], name="seven"))


def random_chain(rng, n):
    """Any geometry: transforms drawn at random, parallel and opposite axes among them."""
    prismatic = tuple(bool(x) for x in rng.random(n) < 0.3)
    fixed = np.array([random_transform(rng) for _ in range(n)])
    return Chain("random", tuple(f"j{i}" for i in range(n)), prismatic, fixed, random_transform(rng))


def random_transform(rng):
    T = np.eye(4)
    R, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    R *= np.linalg.det(R)
    kind = rng.integers(5)
    if kind < 2:  # the axis goes on parallel, or turns back
        c, s = math.cos(a := rng.uniform(-3, 3)), math.sin(a)
        R = np.array(((c, -s, 0), (s, c, 0), (0, 0, 1))) @ np.diag((1, 1, 1) if kind else (1, -1, -1))
    T[:3, :3], T[:3, 3] = R, rng.normal(0, 0.2, 3)
    return T
