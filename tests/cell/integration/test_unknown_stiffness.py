"""The layer in the plant is another than the scene says: the servo feels it at the touch and keeps the force."""

from __future__ import annotations

import statistics
from dataclasses import replace

import pytest

import canprobe
from canprobe.cell.scene.model import PlantSettings

NOMINAL = 1.27e8  # N/m³: 9.4 kN/m at 2 N on the cylinder
pytestmark = pytest.mark.slow(reason="whole touches of a servo")


@pytest.mark.timeout(400)
@pytest.mark.parametrize(
    ("share", "fidelity", "seconds", "rms_percent", "most_n"),
    [
        (0.181, "ideal", 2.0, 10.0, 3.0),
        (4.5, "ideal", 2.0, 10.0, 3.0),
        (18.0, "ideal", 2.0, 20.0, 3.5),
        (18.0, "dynamic", 6.0, 20.0, 3.5),
    ],
    ids=["4 kN/m", "20 kN/m", "40 kN/m", "40 kN/m, dynamic arm"],
)
def test_force_is_kept_without_retuning(share, fidelity, seconds, rms_percent, most_n):
    """Up to 20 kN/m there is no overshoot above 1.5 of the target, approach included.

    At 40 kN/m one count of an encoder is up to 1.1 N, which must not make the stiffness that is felt a doubtful one.
    There the dynamic arm errs by 20 to 21 % over the first two seconds, while the curvature is learned, by 17 to 18 %
    over six and 16 % over a whole scan. Its highest force depends on the seed, from 3.1 to 3.7 N: the limit is that of
    the median of nine, which is 3.4 N.
    """
    scene = canprobe.load_scene("cylinder")
    plant = replace(scene.plant or PlantSettings(), stiffness_n_m3=share * NOMINAL, fidelity=fidelity)
    assert scene.shape is not None
    scene = replace(scene, plant=plant, shape=replace(scene.shape, also=()))
    highest = []
    for seed in range(9 if fidelity == "dynamic" else 1):
        result = canprobe.run(scene, bus="direct", files=False, duration_s=seconds, seed=seed)
        contact = result.summary["contact"]
        assert contact["contact_fraction"] == 1.0
        assert 100 * contact["force_rms_error_n"] / 2.0 < rms_percent
        highest.append(result.truth["force_n"].max())
    assert statistics.median(highest) < most_n


def test_the_first_answer_of_the_estimator_does_not_jerk_a_stiff_arm():
    """The curvature is 0 until it is known. Taken up at once it turned the probe by 12 mrad in a cycle: 25 N."""
    scene = canprobe.load_scene("cylinder")
    assert scene.shape is not None and scene.sensor is not None
    scene = replace(
        scene,
        plant=replace(scene.plant or PlantSettings(), fidelity="dynamic"),
        shape=replace(scene.shape, also=()),
        sensor=replace(scene.sensor, mode="features"),
        task=replace(scene.task, clearance_mm=0.5),
        bus=replace(scene.bus, timed=False),
    )
    result = canprobe.run(scene, bus="direct", files=False, duration_s=1.0)
    assert result.truth["force_n"].max() < 3.0
