"""Elastic contact: the integral of the pressure, its inverse, damping that never pulls."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.cell.plant.elastic_contact import NO_CONTACT, depth_for_force, elastic_contact, relative_curvatures

K, R = 1.27e8, 0.040
PLANE, CYLINDER, SADDLE = (0.0, 0.0), (1 / 0.036, 0.0), (1 / 0.06, -1 / 0.08)
SURFACES = pytest.mark.parametrize("kappa", [PLANE, CYLINDER, SADDLE], ids=["plane", "cylinder", "saddle"])


def half_axes(depth, kappa):
    """Of the patch, along the directions of both curvatures."""
    return [math.sqrt(depth / half) for half in relative_curvatures(kappa, R)]


@SURFACES
def test_force_is_the_integral_over_the_patch(kappa):
    depth = 0.4e-3
    c = elastic_contact(depth, kappa, R, K)
    axis = np.linspace(-12e-3, 12e-3, 1201)
    x, y = np.meshgrid(axis, axis)
    gap = 0.5 * (1 / R + kappa[0]) * x**2 + 0.5 * (1 / R + kappa[1]) * y**2
    pressure = K * np.maximum(depth - gap, 0.0)
    cell = (axis[1] - axis[0]) ** 2
    assert c.force == pytest.approx(pressure.sum() * cell, rel=1e-4)
    a, b = half_axes(depth, kappa)
    assert math.pi * a * b == pytest.approx(np.count_nonzero(pressure) * cell, rel=2e-3)


@given(force=st.floats(1e-3, 50.0), k1=st.floats(-20.0, 200.0), k2=st.floats(-20.0, 200.0))
def test_depth_for_force_is_the_inverse(force, k1, k2):
    kappa = (max(k1, k2), min(k1, k2))
    assert elastic_contact(depth_for_force(force, kappa, R, K), kappa, R, K).force == pytest.approx(force, rel=1e-12)


def test_damping_adds_while_loading_and_never_pulls():
    still = elastic_contact(3e-4, PLANE, R, K)
    loading = elastic_contact(3e-4, PLANE, R, K, depth_rate=0.01, damping=0.3)
    leaving = elastic_contact(3e-4, PLANE, R, K, depth_rate=-0.01, damping=0.3)
    torn_off = elastic_contact(3e-4, PLANE, R, K, depth_rate=-5.0, damping=0.3)
    assert loading.force == pytest.approx(still.force * (1 + 1.5 * 0.3 * 0.01))
    assert leaving.force == pytest.approx(still.force * (1 - 1.5 * 0.3 * 0.01))
    assert loading.force / still.force == pytest.approx(loading.damping_factor)
    assert torn_off.force == 0.0


def test_no_contact_without_depth():
    assert elastic_contact(0.0, PLANE, R, K) is NO_CONTACT
    assert elastic_contact(-1e-3, PLANE, R, K, depth_rate=1.0, damping=1.0).force == 0.0


def test_a_hollow_as_tight_as_the_probe_is_refused_with_its_radius():
    with pytest.raises(ValueError, match=r"radius 39\.00 mm is not wider than the probe \(40\.00 mm\)"):
        elastic_contact(1e-4, (0.0, -1 / 0.039), R, K)
