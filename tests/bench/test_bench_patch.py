"""Costs of the patch as a second sensor. Run with --benchmark-only; skipped by default.

Goal on an idle machine: moments + add + an eighth of fuse (one answer in eight frames) at most 60 us a tactile frame.
"""

import math

import numpy as np
import pytest

from canprobe.scene.calibrations import load_calibration
from canprobe.touch.contact import ContactSample
from canprobe.touch.estimate.fit import make_estimator
from canprobe.touch.pad import Pad
from canprobe.touch.patch.curvature import PatchCurvature, patch_estimate, with_patch
from canprobe.touch.patch.image_model import make_image_model, make_patch_calibration
from canprobe.touch.patch.moments import MomentImage

CALIBRATION = load_calibration("inch16")
PATCH = make_patch_calibration(CALIBRATION, Pad())
MODEL = make_image_model(CALIBRATION, PATCH, seen=8)
MOMENTS = MODEL.moments((0.0, 0.0, 27.8), 2.0)


def touch(i):
    T = np.eye(4)
    T[:3, :3] = np.diag([1.0, -1.0, -1.0])
    T[:3, 3] = [i * 1.25e-4, 0.0, 0.0396]
    return ContactSample(
        i * 5e-3, np.array([i * 1.25e-4, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), T, np.array([0.0, 0.0, 0.0396]), 2.0,
        moments=MOMENTS,
    )  # fmt: skip


@pytest.fixture
def patch():
    found = PatchCurvature(MODEL)
    for i in range(100):
        found.add(touch(i))
    return found


def test_bench_moments(benchmark):
    axis = np.arange(16) - 7.5
    field = 120.0 * np.maximum(1.0 - (axis / 2.6) ** 2 - (axis[:, None] / 3.7) ** 2, 0.0)
    assert benchmark(MomentImage(PATCH).moments, field.astype(np.uint8)) is not None


def test_bench_add(benchmark, patch):
    benchmark(patch.add, touch(100))


def test_bench_fuse(benchmark, patch):
    motion = make_estimator("recursive", sigma_point=1e-4, sigma_normal=4e-3)
    for i in range(300):
        motion.add(touch(i))
    estimate = motion.estimate()
    answer = benchmark(lambda: with_patch(estimate, patch.fuse(estimate.T_frame_contact, estimate.evidence), 0.02))
    assert answer.method == "recursive+patch"
    assert math.isclose(answer.kappa[0], 27.8, abs_tol=0.5)


def test_bench_patch_alone(benchmark, patch):
    assert benchmark(patch_estimate, touch(100), patch, 0.02).rank == 3
