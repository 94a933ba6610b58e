"""The patch as a second sensor in the whole cell: a path along the axis of a cylinder, full sensor pipeline."""

from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.results.scores import score_shape, summarise_shape
from canprobe.cell.results.text import shape_lines
from canprobe.cell.session.session import Session
from canprobe.cell.tasks.from_plan import make_shape_estimator, make_task
from canprobe.cell.tasks.shape import replay_samples


@pytest.fixture(scope="module")
def axial():
    """The session and its controller after 2 s (50 mm) on the axial scene."""
    session = Session(
        canprobe.load_scene("axial", {"task.duration_s": 2.0, "task.clearance_mm": 0.3, "cycle.rate_hz": 200.0})
    )
    controller = make_task(session.plan)
    with session:
        session.run(controller)
    return session, controller


def score(session, records):
    return score_shape(records, session.buses.truth, session.cell.log.arrays()["t_s"])


def test_curvature_across_an_axial_path_is_observed_within_ten_percent(axial):
    session, controller = axial
    found = score(session, controller.shape.records)
    assert found.estimates >= 20
    assert found.observed_fraction == 1.0
    assert found.patch_fraction == 1.0
    assert found.kappa_true_per_m == pytest.approx((1 / 0.036, 0.0), abs=1e-6)
    assert found.kappa_rms_error_percent < 10.0
    last = controller.shape.records[-1].estimate
    assert last.method == "recursive+patch"
    truth = session.buses.truth["direction1"][-1]
    assert abs(last.directions[0] @ truth) > 0.99
    first, last = controller.record().scan_cycles
    force = session.buses.truth["force_n"][first:last]
    assert force.max() < 2.35, "the first answer, which tells the depth for 2 N in one instant, gives no knock"


def test_without_the_patch_the_same_contacts_leave_it_unobserved(axial):
    session, controller = axial
    task = session.plan.setup.task
    off = replace(task, shape=replace(task.shape, patch=False))
    records = replay_samples(make_shape_estimator(off, "recursive"), controller.shape.samples, 8)
    found = score(session, records)
    assert found.observed_fraction == 0.0
    assert list(records[-1].estimate.observed) == [True, False]
    assert records[-1].estimate.kappa[0] == pytest.approx(0.0, abs=1.0)
    assert np.isnan(records[-1].estimate.kappa[1])
    shape = summarise_shape(off, None, {"recursive": records}, session.buses.truth, session.cell.log.arrays()["t_s"])
    first, second = shape_lines(shape)
    assert first.endswith("1/m, the other one not observed; true 27.78, 0.00 1/m"), "it is known all the same"
    assert "not scored: no estimate of both curvatures" in second
