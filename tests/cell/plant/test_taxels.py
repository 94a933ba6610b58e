"""Taxel image: geometry against the exact bodies, each imperfection alone, the figures expected of the whole."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.pressure import PressureField, pad_basis, pad_coordinates, pad_direction
from canprobe.cell.plant.taxels import IDEAL_TAXELS, TaxelArray, TaxelConfig

K, R = 1.27e8, 0.040
PLANE, CYLINDER, SADDLE = (0.0, 0.0), (1 / 0.036, 0.0), (1 / 0.06, -1 / 0.08)
PITCH_M = 1.5875e-3
AXIS = (np.arange(16) - 7.5) * PITCH_M
ALONG_U = np.eye(2)
LINEAR_TAXELS = IDEAL_TAXELS.without("threshold")


def turned(angle):
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


def array(config=IDEAL_TAXELS, seed=0):
    return TaxelArray(config, np.random.default_rng(seed), radius_m=R, stiffness_n_m3=K)


def touch(a, force, *, uv=(0.0, 0.0), kappa=CYLINDER, directions=ALONG_U, t_s=0.0):
    depth = depth_for_force(force, kappa, R, K) if force > 0 else -1e-3
    return a.image(uv, depth, kappa, directions, t_s)


def moments(image):
    """Sum, centroid (u, v) and second central moments (uu, uv, vv)."""
    w = image.astype(float)
    u, v = np.meshgrid(AXIS, AXIS)
    total = w.sum()
    cu, cv = (w * u).sum() / total, (w * v).sum() / total
    return total, (cu, cv), [(w * (p - m) * (q - n)).sum() / total for p, m, q, n in
                             ((u, cu, u, cu), (u, cu, v, cv), (v, cv, v, cv))]  # fmt: skip


@given(u=st.floats(-0.0127, 0.0127), v=st.floats(-0.0127, 0.0127))
def test_pad_map_is_equidistant_and_inverts(u, v):
    d = pad_direction(u, v, R)
    assert np.linalg.norm(d) == pytest.approx(1.0)
    assert math.acos(min(1.0, d[2])) * R == pytest.approx(math.hypot(u, v), abs=1e-9)
    assert pad_coordinates(d, R) == pytest.approx((u, v), abs=1e-15)
    e_u, e_v = np.array(pad_basis(d))
    assert np.array((e_u, e_v, d)) @ np.array((e_u, e_v, d)).T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.cross(e_u, e_v) == pytest.approx(d, abs=1e-12)


def test_transported_basis_turns_in_the_plane_of_the_arc_only():
    e_u, e_v = pad_basis(pad_direction(0.01, 0.0, R))
    assert e_v == pytest.approx((0.0, 1.0, 0.0))
    assert e_u == pytest.approx((math.cos(0.25), 0.0, -math.sin(0.25)))


@pytest.mark.parametrize("kappa", [PLANE, CYLINDER, SADDLE], ids=["plane", "cylinder", "saddle"])
@pytest.mark.parametrize("force", [0.5, 4.0])
def test_pressure_sum_is_the_force(kappa, force):
    depth = depth_for_force(force, kappa, R, K)
    means = PressureField(R).mean_pressure((2.1e-3, -1.3e-3), depth, kappa, turned(0.4))
    assert K * PITCH_M**2 * means.sum() == pytest.approx(force, rel=0.015)


def test_second_moments_are_the_winkler_ones():
    c = depth_for_force(2.0, CYLINDER, R, K)
    a2, b2 = c / (0.5 * (1 / R + CYLINDER[0])), c / (0.5 / R)
    _, _, (uu, _, vv) = moments(touch(array(LINEAR_TAXELS), 2.0))
    assert uu - PITCH_M**2 / 12 == pytest.approx(a2 / 6, rel=0.03)
    assert vv - PITCH_M**2 / 12 == pytest.approx(b2 / 6, rel=0.03)


def test_blur_widens_by_its_variance_and_keeps_the_sum():
    sharp, soft = (PressureField(R, blur_pitch=b).mean_pressure((1e-3, 0.0), 4e-4, PLANE, ALONG_U) for b in (0.0, 0.65))
    (s0, c0, m0), (s1, c1, m1) = moments(sharp), moments(soft)
    assert s1 == pytest.approx(s0, rel=1e-6)
    assert c1 == pytest.approx(c0, abs=3e-6)
    assert (m1[0] - m0[0]) / PITCH_M**2 == pytest.approx(0.65**2, rel=0.01)


def test_contact_beside_the_array_blurs_in_from_the_edge_only():
    field = PressureField(R)
    outside = field.mean_pressure((17.5 * PITCH_M / 2, 0.0), 1e-5, PLANE, ALONG_U)
    assert outside[:, 15].sum() > 0.0
    assert outside[:, :11].sum() == 0.0
    assert outside[:, :13].sum() < 1e-3 * outside.sum()
    assert not field.mean_pressure((0.025, 0.0), 4e-4, PLANE, ALONG_U).any()


@pytest.mark.parametrize(
    ("full_scale_pa", "force", "least_mm", "most_mm", "active"),
    [(100e3, 2.0, 0.020, 0.060, (25, 59)), (300e3, 2.0, 0.04, 0.12, (16, 46)), (300e3, 1.0, 0.10, 0.14, (16, 24))],
)
def test_expected_figures_with_everything_on(full_scale_pa, force, least_mm, most_mm, active):
    """Centroid error and active taxels over forty arrays on the cylinder."""
    rng, errors, counts = np.random.default_rng(5), [], []
    for seed in range(40):
        uv = rng.uniform(-1.5e-3, 1.5e-3, 2)
        image = touch(
            array(TaxelConfig(full_scale_pa=full_scale_pa), seed), force, uv=tuple(uv), directions=turned(seed)
        )
        errors.append(math.dist(moments(image)[1], uv))
        counts.append(np.count_nonzero(image))
    assert least_mm < 1e3 * np.mean(errors) < most_mm
    assert active[0] <= np.median(counts) <= active[1]


def test_hysteresis_makes_a_loop_of_a_tenth_of_the_signal_at_any_rate():
    config = replace(LINEAR_TAXELS, hysteresis=0.10)
    sums = {}
    for name, forces in {"up": (1.0,), "down": (3.0, 1.0), "again": (3.0, 1.0, 1.0, 3.0, 1.0)}.items():
        a = array(config)
        for k, force in enumerate(forces):
            image = touch(a, force, t_s=100.0 * k)
        sums[name] = image.astype(float).sum()
    ideal = touch(array(LINEAR_TAXELS), 1.0).astype(float).sum()
    assert (sums["down"] - sums["up"]) / ideal == pytest.approx(0.10, abs=0.015)
    assert sums["up"] < ideal < sums["down"]
    assert sums["again"] == sums["down"]


def test_hysteresis_forgets_when_the_contact_is_lost():
    a = array(TaxelConfig().without("noise", "creep"))
    touch(a, 3.0)
    assert not touch(a, 0.0, t_s=0.005).any()


def test_creep_is_five_percent_per_decade():
    """Over every decade that begins between 0.1 s and 18 s, so that no relaxation is missing or out of place."""
    a = array(replace(LINEAR_TAXELS, creep_per_decade=0.05, adc_bits=12))
    start = touch(a, 1.5, t_s=0.0).astype(float).sum()
    times = 0.1 * 10.0 ** np.arange(0.0, 3.5, 0.25)
    grown = np.array([touch(a, 1.5, t_s=t).astype(float).sum() / start - 1.0 for t in times])
    assert grown[4:] - grown[:-4] == pytest.approx(0.05, abs=0.004)


def test_creep_depends_on_time_not_on_the_number_of_samples():
    often, once = (array(TaxelConfig().without("noise", "hysteresis")) for _ in range(2))
    touch(often, 2.0)
    touch(once, 2.0)
    for k in range(1, 200):
        touch(often, 2.0, t_s=0.01 * k)
    assert np.array_equal(touch(often, 2.0, t_s=2.0), touch(once, 2.0, t_s=2.0))


def test_crosstalk_spreads_over_rows_then_columns_and_keeps_the_sum():
    share = 0.3
    clean = touch(array(LINEAR_TAXELS), 2.0, uv=(2e-3, -1e-3), directions=turned(0.3)) / 255.0
    mixed = touch(array(replace(LINEAR_TAXELS, crosstalk=share)), 2.0, uv=(2e-3, -1e-3), directions=turned(0.3)) / 255.0
    rows = np.array([[(1 - share) * r[j] + share * (r.sum() - r[j]) / 15 for j in range(16)] for r in clean])
    both = np.array([[(1 - share) * c[i] + share * (c.sum() - c[i]) / 15 for i in range(16)] for c in rows.T]).T
    assert mixed == pytest.approx(both, abs=1.5 / 255)
    assert mixed.sum() == pytest.approx(clean.sum(), rel=0.02)
    assert mixed[0].sum() > 0.0
    assert mixed[:, 0].sum() > 0.0


@pytest.mark.parametrize("kappa", [CYLINDER, SADDLE], ids=["cylinder", "saddle"])
def test_leaving_out_samples_beside_the_patch_changes_nothing(kappa):
    part, whole = PressureField(R), PressureField(R)
    whole._span = lambda centre, half, count: (0, count)
    rng = np.random.default_rng(16)
    for _ in range(30):
        uv, angle, depth = rng.uniform(-0.011, 0.011, 2), rng.uniform(0, math.pi), rng.uniform(1e-5, 9e-4)
        images = [f.mean_pressure(tuple(uv), depth, kappa, turned(angle)) for f in (part, whole)]
        assert images[0] == pytest.approx(images[1], abs=1e-12 * depth)


def test_taxel_area_is_the_one_on_the_sphere():
    """Toward the corner the wrapped array's cells shrink: the same force must still come out."""
    field = PressureField(R, blur_pitch=0.0, samples=5)
    depth = depth_for_force(0.4, PLANE, R, K)
    middle, corner = (field.mean_pressure(uv, depth, PLANE, ALONG_U).sum() for uv in ((0.0, 0.0), (7.3e-3, 7.3e-3)))
    assert corner == pytest.approx(middle, rel=3e-3)


def test_gains_are_fixed_by_the_seed_and_within_their_spread():
    first, same, other = array(TaxelConfig(), 1), array(TaxelConfig(), 1), array(TaxelConfig(), 2)
    assert np.array_equal(first.gains, same.gains)
    assert not np.array_equal(first.gains, other.gains)
    assert np.abs(first.gains - 1.0).max() <= 0.05
    assert first.gains.std() == pytest.approx(0.05 / math.sqrt(3), rel=0.1)
    for t in (0.0, 0.005, 0.010):
        assert np.array_equal(touch(first, 2.0, t_s=t), touch(same, 2.0, t_s=t))


def test_idle_array_reads_zero_through_the_threshold():
    a = array(TaxelConfig())
    assert not any(touch(a, 0.0, t_s=0.005 * k).any() for k in range(50))


@pytest.mark.parametrize("bits", [8, 12])
def test_an_adc_rounds_to_its_own_steps(bits):
    """Against the exact pressure: error uniform over one step, so an RMS of a step over the root of 12."""
    a = array(replace(LINEAR_TAXELS, adc_bits=bits))
    step, errors = 255 / (2**bits - 1), []
    for force in np.linspace(0.5, 2.5, 81):
        depth = depth_for_force(force, CYLINDER, R, K)
        exact = a.field.mean_pressure((3e-4, 1e-4), depth, CYLINDER, turned(0.3)) * K / 100e3 * 255
        image = touch(a, force, uv=(3e-4, 1e-4), directions=turned(0.3))
        assert np.abs(image / step - np.rint(image / step)).max() < 1e-9
        errors.append((image - exact)[exact > 0.0])
    errors = np.concatenate(errors)
    assert errors.std() == pytest.approx(step / math.sqrt(12), rel=0.06)
    assert abs(errors.mean()) < 0.05 * step
    assert touch(a, 50.0).max() == 255


def test_a_finer_adc_has_the_same_noise_and_threshold_and_other_figures_less_rounding():
    a = array(TaxelConfig(adc_bits=12).without("creep", "hysteresis"))
    images = np.array([touch(a, 2.0, t_s=0.005 * k) for k in range(400)])
    assert images[:, 6:10, 6:10].std(axis=0).mean() == pytest.approx(0.005 * 255, rel=0.05)
    assert 0.02 * 255 <= images[images > 0].min() < 0.0205 * 255


def test_saturation_bends_then_clips():
    bent = replace(LINEAR_TAXELS, saturation=True)
    for force, low, high in ((0.5, 0.0, 0.002), (3.0, 0.002, 0.05)):
        straight, curved = (touch(array(c), force).astype(float).max() for c in (LINEAR_TAXELS, bent))
        assert low <= 1 - curved / straight + 1 / 255 <= high + 2 / 255
    assert touch(array(bent), 20.0).max() == 255


def test_full_scale_sets_the_counts():
    counts = [touch(array(TaxelConfig(full_scale_pa=fs).without("noise")), 2.0).max() for fs in (100e3, 300e3)]
    assert counts[0] / counts[1] == pytest.approx(3.0, rel=0.06)


def test_dead_taxels_read_zero_whatever_happens():
    dead = ((7, 7), (8, 9), (0, 15))
    a = array(TaxelConfig(dead=dead))
    for k in range(10):
        image = touch(a, 3.0, t_s=0.005 * k)
        assert all(image[i, j] == 0 for i, j in dead)
        assert image[7, 8] > 0


def test_damping_factor_scales_the_pressure():
    plain, pressed = (
        array(IDEAL_TAXELS).image((0.0, 0.0), 3e-4, PLANE, ALONG_U, 0.0, pressure_factor=f) for f in (1.0, 1.2)
    )
    assert pressed.astype(float).sum() / plain.astype(float).sum() == pytest.approx(1.2, rel=0.02)


def test_effects_can_be_switched_off_by_name():
    assert TaxelConfig().without("creep", "blur") == TaxelConfig(creep_per_decade=0.0, blur_pitch=0.0)
    with pytest.raises(ValueError, match="unknown effects wobble; one of noise"):
        TaxelConfig().without("wobble")
