"""Study `pipeline`: scores of exact answers, and a short scan with the whole sensor on."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

from canprobe.cli import main
from canprobe.studies.pipeline import contact_errors, findings, row_of, scored

TIMES = np.arange(0.0, 5.0, 0.0025)
TRUTH = {
    "kappa": np.tile([30.0, -10.0], (len(TIMES), 1)),
    "direction1": np.tile([0.6, 0.8, 0.0], (len(TIMES), 1)),
    "direction2": np.tile([-0.8, 0.6, 0.0], (len(TIMES), 1)),
    "contact_point": np.stack([0.025 * TIMES, 0 * TIMES, 0 * TIMES], axis=1),
    "contact_normal": np.tile([0.0, 0.0, 1.0], (len(TIMES), 1)),
}


def test_an_answer_is_scored_in_its_own_axes():
    """The frame's x axis along the first principal direction, z inward: K is diagonal there."""
    T = np.eye(4)
    T[:3, :3] = np.array([[0.6, 0.8, 0.0], [0.8, -0.6, 0.0], [0.0, 0.0, -1.0]]).T
    estimate = SimpleNamespace(T_frame_contact=T, K=np.diag([31.0, -12.0]), covariance=np.diag([1.0, 4.0, 4.0]))
    assert scored(SimpleNamespace(t_s=1.0, estimate=estimate), TRUTH, TIMES) == pytest.approx([1, 0, -2, 1, 2, 2, 2.0])


def test_errors_of_contacts_are_found_with_how_long_they_last():
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 4.9, 0.005)
    decay = np.exp(-0.125 / 2.0)  # samples 0.125 mm apart, errors that last 2 mm
    tilt = np.zeros((len(t), 2))
    for i in range(1, len(t)):
        tilt[i] = decay * tilt[i - 1] + 2e-3 * np.sqrt(1 - decay**2) * rng.normal(size=2)
    samples = []
    for s, (u, v) in zip(t, tilt, strict=True):
        n = np.array([u, v, np.sqrt(1 - u * u - v * v)])
        samples.append(SimpleNamespace(t_s=s, p_base=np.array([0.025 * s, 0.0, 20e-6 * rng.normal()]), n_base=n))
    found = contact_errors(samples, TRUTH, TIMES)
    assert found["height"] == pytest.approx(20e-6, rel=0.1)
    assert found["tilt"] == pytest.approx(2e-3, rel=0.25)
    assert found["lasts"] == pytest.approx(2e-3, rel=0.4)


def test_a_row_tells_overconfidence():
    rng = np.random.default_rng(2)
    e = 2.0 * rng.normal(size=(400, 3))
    answers = [[*x, 1.0, 1.0, 1.0, float(x @ x)] for x in e]
    contacts = {"height": 1e-5, "tilt": 1e-3, "lasts": 1e-3}
    row = row_of("sphere", "verification", [{"answers": answers, "late": 500, "contacts": contacts}])
    assert row["observed"] == 0.8
    assert row["z_rms_K11"] == pytest.approx(2.0, rel=0.1)
    assert row["coverage"] < 0.75
    assert any("sphere" in line for line in findings([row]))


@pytest.mark.timeout(600)  # a second of a whole cell takes long where many share a processor
def test_a_short_scan_with_the_whole_sensor(tmp_path, capsys):
    """One cylinder, a seed that nothing was set on. The answers of 25 mm share one memory: one draw of the error.

    So its region holds the truth most of the way; how often regions do is for the whole study, not for one draw.
    """
    assert main(["study", "pipeline", "--quick", "--out", str(tmp_path), "--json"]) == 0
    row = json.loads(capsys.readouterr().out)["rows"][0]
    assert row["answers"] >= 20
    assert row["observed"] > 0.9
    assert row["coverage"] > 0.5
    assert all(row[f"z_rms_{entry}"] < 2.0 for entry in ("K11", "K12", "K22"))
    assert 5 < row["height_um"] < 40
    assert 0.5 < row["tilt_mrad"] < 3
    assert (tmp_path / "pipeline.png").stat().st_size > 10_000
