"""The rule for the bandwidth of a servo behind a dead time, against the sampled loop."""

import pytest

from canprobe.cell.planning.external_arm import HIGHEST, STIFFER
from canprobe.cell.plant.ideal_arm import natural_frequency
from canprobe.lab.studies.linear_loop import ForceLoop, spectral_radius

OMEGA, LAG_S = natural_frequency(30.0), 6.8e-3


@pytest.mark.parametrize(("rate_hz", "delay_ms"), [(125.0, 4.0), (125.0, 40.0), (500.0, 4.0), (500.0, 40.0)])
def test_what_the_plan_allows_settles_and_three_times_it_does_not(rate_hz, delay_ms):
    images = max(1, round(rate_hz / 250.0))
    loop_s = (2 * images + 2) / rate_hz + LAG_S + 1e-3 * delay_ms

    def radius(height_hz):  # half of the dead time each way
        return spectral_radius(ForceLoop(STIFFER, 1.0 / rate_hz, images, height_hz, 0.5e-3 * delay_ms, OMEGA))

    assert radius(HIGHEST / loop_s) < 1.0 < radius(3.0 * HIGHEST / loop_s)
