"""From the centroid on the pad to the contact of the object, and the indentation of the layer."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from canprobe.errors import UsageError
from canprobe.mechanics.touch import contact as c
from canprobe.mechanics.touch.tangent_frames import homogeneous


@given(st.floats(-0.0127, 0.0127), st.floats(-0.0127, 0.0127))
def test_pad_and_direction_are_inverse(u, v):
    d = c.pad_to_direction(u, v, 0.04)
    assert np.linalg.norm(d) == pytest.approx(1.0, abs=1e-15)
    assert math.acos(min(1.0, d[2])) * 0.04 == pytest.approx(math.hypot(u, v), abs=1e-9)  # arc length from the pole
    assert c.direction_to_pad(d, 0.04) == pytest.approx((u, v), abs=1e-14)


def test_sample_goes_through_the_squeezed_layer():
    T = homogeneous(Rotation.from_rotvec([0.2, 0.4, 0.6]).as_matrix(), np.array([0.1, -0.2, 0.4]))
    s = c.contact_sample(t_s=1.5, T_base_probe=T, uv=(2e-3, -1e-3), depth=0.3e-3, radius=0.04, force_n=2.0)
    centre = T[:3, 3]
    assert np.linalg.norm(s.p_base - centre) == pytest.approx(0.0397)
    assert np.allclose((s.p_base - centre) / 0.0397, -s.n_base)  # the object's outward normal faces the centre
    assert np.allclose(T[:3, :3] @ s.r_probe + centre, s.p_base)
    assert np.allclose(T[:3, :3] @ (-s.r_probe / 0.0397), s.n_base)  # inward normal of the probe


class TestIndentation:
    """Winkler layer: `F = ∫ k (δ − A x² − B y²)₊`."""

    @pytest.mark.parametrize("kappa", [(27.8, 0), (20, -15)])
    def test_against_the_integral(self, kappa):
        k, radius, force = 1.27e8, 0.04, 1.7
        d = c.indentation_from_force(force, k, radius, kappa)
        A, B = (0.5 * (1 / radius + x) for x in kappa)
        x = (np.arange(800) + 0.5) / 800 * 2 - 1
        X, Y = np.meshgrid(x * math.sqrt(d / A), x * math.sqrt(d / B))
        pressure = k * np.maximum(d - A * X**2 - B * Y**2, 0)
        cell = 4 * d / math.sqrt(A * B) / 800**2
        assert pressure.sum() * cell == pytest.approx(force, rel=1e-4)

    def test_no_force_no_depth_and_unobserved_counts_as_flat(self):
        assert c.indentation_from_force(-0.1, 1.27e8, 0.04, (0, 0)) == 0.0
        flat = c.indentation_from_force(1.0, 1.27e8, 0.04, (27.8, 0))
        assert c.indentation_from_force(1.0, 1.27e8, 0.04, (27.8, math.nan)) == flat

    def test_tighter_than_the_probe_is_refused(self):
        with pytest.raises(UsageError, match="kappa"):
            c.indentation_from_force(1.0, 1.27e8, 0.04, (0.0, -25.1))
