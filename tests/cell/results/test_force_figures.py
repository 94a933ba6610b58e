"""The force in summary and text: held against its target, measured against the truth where there is one."""

import numpy as np
import pytest

import canprobe
from canprobe.cell.results.scores import score_measured_force
from canprobe.cell.results.text import force_lines, summary_text


@pytest.fixture(scope="module")
def result():
    return canprobe.run("press", {"task.clearance_mm": 0.3}, bus="direct", duration_s=1.0, files=False)


def test_the_error_of_the_force_is_measured_less_true(result):
    """At the instants of the samples: a truth of another cycle would be off by the motion in between."""
    contact, log = result.summary["contact"], result.log
    hold = log["phase"] == 3
    error = log["force_n"][hold] - result.truth["force_n"][log["sample_cycle"][hold].astype(int)]
    assert contact["force_true_bias_n"] == pytest.approx(error.mean(), abs=2e-3)
    assert contact["force_true_rms_error_n"] == pytest.approx(np.sqrt(np.mean(error**2)), abs=2e-3)
    # the servo brings what it sees to the target: its distance from it says nothing about the error of the array
    assert contact["force_measured_rms_error_n"] < contact["force_true_rms_error_n"]
    assert contact["force_sigma_n"] == pytest.approx(np.sqrt(np.mean(np.square(log["force_sigma_n"][hold]))), rel=1e-2)
    parts = contact["force_sigma_parts_n"]
    assert np.linalg.norm([*parts.values()]) == pytest.approx(contact["force_sigma_n"])
    assert 0.0 < parts["reference"] < parts["array"] and contact["force_lower_bound_fraction"] == 0.0


def test_the_score_takes_the_truth_of_each_sample_s_cycle():
    truth = {"force_n": np.arange(10.0)}
    log = {"force_n": np.array([9.0, np.nan, 3.0, 4.0]), "sample_cycle": np.array([np.nan, 1.0, 2.0, 2.0])}
    assert score_measured_force(log, truth, 0, 4) == {
        "force_true_bias_n": 1.5,
        "force_true_rms_error_n": pytest.approx(np.sqrt(2.5)),
    }
    assert score_measured_force(log, truth, 0, 1) == {}


def test_the_text_tells_both_apart(result):
    lines = summary_text(result.summary, None).splitlines()
    i = next(i for i, line in enumerate(lines) if line.startswith("  force "))
    assert "target 2 N, true force off it by" in lines[i] and "error" not in lines[i]
    assert "measured to ± " in lines[i + 1] and "reference 0.5 %, array 1." in lines[i + 1]
    assert "measured less true: mean" in lines[i + 2] and "within 2σ in 100 % of the seconds" in lines[i + 2]


def test_without_a_truth_nothing_is_called_an_error_of_force(result):
    """As on a real cell: the figures are those of the measured force against its target."""
    contact = result.summary["contact"] | {
        "force_rms_error_n": result.summary["contact"]["force_measured_rms_error_n"],
        "force_true_bias_n": None,
        "force_true_rms_error_n": None,
    }
    text = "\n".join(force_lines(contact))
    assert "measured force off it by" in text and "no true force is known here" in text
    assert "error" not in text
