"""Chains against products of their matrices, central differences, and Pinocchio on arms that we did not describe."""

import math

import numpy as np
import pytest
from published_puma import MODELS
from serial_arms import five, gantry, random_chain, scara, seven

from canprobe.errors import PlanError
from canprobe.mechanics.robot.chain import (
    Chain,
    ending_in,
    forward,
    forward_jacobian,
    jacobian,
    link_transforms,
    point_velocity,
    pose_of,
    posture,
)
from canprobe.mechanics.robot.denavit_hartenberg import from_dh

TOOL = np.array([[0.36, 0.48, -0.8, 0.01], [-0.8, 0.6, 0.0, -0.02], [0.48, 0.64, 0.6, 0.08], [0.0, 0.0, 0.0, 1.0]])
CHAINS = {model.name: model.chain for model in (*MODELS.values(), gantry(), scara(), five(), seven())}
CHAINS |= {f"random {n}": random_chain(np.random.default_rng(n), n) for n in range(1, 9)}
EACH = pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)


def product(chain, q):
    """T_base_flange by multiplying every matrix."""
    T = np.eye(4)
    for fixed, slides, value in zip(chain.fixed, chain.prismatic, q, strict=True):
        motion = np.eye(4)
        if slides:
            motion[2, 3] = value
        else:
            motion[:2, :2] = (math.cos(value), -math.sin(value)), (math.sin(value), math.cos(value))
        T = T @ fixed @ motion
    return T @ chain.T_last_flange


def postures(chain, count=20):
    return np.random.default_rng(1).uniform(-math.pi, math.pi, (count, chain.n))


@EACH
def test_forward_is_the_product_of_matrices(chain):
    for q in postures(chain):
        assert forward(chain, q) == pytest.approx(product(chain, q), abs=3e-15 * (10 + np.abs(q).max()))
        links = np.linalg.multi_dot([np.eye(4), *link_transforms(chain, q), np.eye(4)])
        assert links == pytest.approx(product(chain, q), abs=1e-13)


@EACH
def test_jacobian_matches_central_differences(chain):
    h = 1e-6
    for q in postures(chain, 5):
        T, J = forward_jacobian(chain, q, TOOL)
        assert pytest.approx(product(chain, q) @ TOOL, abs=1e-13) == T
        assert J.shape == (6, chain.n)
        for i, step in enumerate(h * np.eye(chain.n)):
            rate = (product(chain, q + step) - product(chain, q - step)) @ TOOL / (2 * h)
            spin = rate[:3, :3] @ T[:3, :3].T
            assert J[:3, i] == pytest.approx(rate[:3, 3], abs=2e-9)
            assert J[3:, i] == pytest.approx((spin[2, 1], spin[0, 2], spin[1, 0]), abs=2e-9)


@EACH
def test_points_move_as_the_jacobian_says(chain):
    rng = np.random.default_rng(2)
    for q in postures(chain, 5):
        at, (T, J) = posture(ending_in(chain, TOOL), q), forward_jacobian(chain, q, TOOL)
        place, qd = tuple(T[:3, 3]), rng.normal(size=chain.n)
        assert pose_of(at) == pytest.approx(T, abs=1e-14)
        assert jacobian(at, place) == pytest.approx(J, abs=1e-14)
        assert point_velocity(at, place, qd) == pytest.approx(J[:3] @ qd, abs=1e-13)
        assert point_velocity(at, place, qd.tolist()) == point_velocity(at, place, qd)


def elementary(theta, d, a, alpha):
    """Rz, Tz, Tx, Rx as matrices of their own."""
    rz, tz, tx, rx = (np.eye(4) for _ in range(4))
    rz[:2, :2] = (math.cos(theta), -math.sin(theta)), (math.sin(theta), math.cos(theta))
    rx[1:3, 1:3] = (math.cos(alpha), -math.sin(alpha)), (math.sin(alpha), math.cos(alpha))
    tz[2, 3], tx[0, 3] = d, a
    return rz, tz, tx, rx


@pytest.mark.parametrize("convention", ["standard", "modified"])
def test_rows_mean_their_convention(convention):
    rng = np.random.default_rng(4)
    rows, prismatic = rng.uniform(-1.5, 1.5, (7, 4)), (False, True, False, True, False, False, True)
    mount, flange = (np.linalg.multi_dot(elementary(*rng.normal(size=4))) for _ in range(2))
    chain = from_dh(rows, convention, prismatic=prismatic, T_base_mount=mount, T_last_flange=flange)
    for q in postures(chain, 5):
        T = mount
        for (a, alpha, d, theta), slides, value in zip(rows, prismatic, q, strict=True):
            turn, rise = (theta, d + value) if slides else (theta + value, d)
            rz, tz, tx, rx = elementary(turn, rise, a, alpha)
            T = T @ (rz @ tz @ tx @ rx if convention == "standard" else rx @ tx @ rz @ tz)
        assert forward(chain, q) == pytest.approx(T @ flange, abs=1e-13)


BENT = np.eye(4)
BENT[0, 1] = 1e-6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"joints": ()}, "expected 1 to 8 joints, got 0"),
        ({"joints": tuple("abcdefghi")}, "expected 1 to 8 joints, got 9"),
        ({"joints": ("a", "a")}, "a name of its own"),
        ({"prismatic": (False,)}, "expected 2 joint types"),
        ({"fixed": np.array([np.eye(4), BENT])}, "transform to b is not a rotation"),
        ({"T_last_flange": np.diag((1.0, 1.0, -1.0, 1.0))}, "transform to flange is not a rotation"),
        ({"T_last_flange": np.full((4, 4), np.nan)}, "transform to flange is not a rotation"),
    ],
)
def test_what_is_no_chain_is_refused(change, message):
    good = {
        "name": "two",
        "joints": ("a", "b"),
        "prismatic": (False, True),
        "fixed": np.array([np.eye(4)] * 2),
        "T_last_flange": np.eye(4),
    }
    Chain(**good)
    with pytest.raises(PlanError, match=message):
        Chain(**(good | change))


@pytest.mark.parametrize("rows", [[(0.0, 0.0, 0.0)], [0.0, 0.0, 0.0, 0.0]])
def test_rows_have_four_columns(rows):
    with pytest.raises(PlanError, match="rows"):
        from_dh(rows)
    with pytest.raises(PlanError, match="convention"):
        from_dh([(0, 0, 0, 0)], "other")
