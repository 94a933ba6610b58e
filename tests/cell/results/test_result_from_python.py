"""What a result offers in Python: contacts as arrays, scores of own estimators, the figure, the page, its print."""

from collections import deque
from dataclasses import replace

import numpy as np
import pytest

import canprobe
from canprobe.cell.results import result as page
from canprobe.cell.results.scores import contacts_of
from canprobe.errors import UsageError
from canprobe.mechanics.touch.contact import Doubt


@pytest.fixture(scope="module")
def result():
    quick = {"task.clearance_mm": 0.2, "shape.also": ["ml"], "cycle.rate_hz": 200.0}
    return canprobe.run("cylinder", quick, bus="direct", duration_s=1.7, files=False)


class LastSphere:
    """Takes every object for a ball of 36 mm; a new one is made wherever the loop would reset ours."""

    made = 0

    def __init__(self):
        type(self).made += 1
        self.last = deque(maxlen=1)

    def add(self, sample):
        self.last.append(sample)

    def estimate(self):
        z = -self.last[-1].n_base
        x = np.cross([0.0, 1.0, 0.0], z)
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), self.last[-1].p_base
        return canprobe.SurfaceEstimate.of(T, np.eye(2) / 0.036)


def test_contacts_lie_on_the_true_object_within_their_covariances(result):
    contacts = result.contacts
    n = len(contacts)
    assert result.contacts is contacts
    assert n == len(contacts.samples) > 300 and f"{n} contacts over " in repr(contacts)
    shapes = [a.shape for a in (contacts.t_s, contacts.points, contacts.normals, contacts.forces)]
    assert shapes == [(n,), (n, 3), (n, 3), (n,)]
    assert contacts.covariances.shape == contacts.normal_covariances.shape == (n, 3, 3)
    rows = np.searchsorted(result.truth["t_s"], contacts.t_s - 1e-6)
    off = contacts.points - result.truth["contact_point_m"][rows]
    assert np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(contacts.covariances), off)) < 5.0
    true_normals = result.truth["contact_normal"][rows]
    assert np.degrees(np.arccos(np.sum(contacts.normals * true_normals, axis=1))).max() < 0.5
    np.testing.assert_allclose(np.einsum("nij,nj->ni", contacts.normal_covariances, contacts.normals), 0.0, atol=1e-18)
    height = np.einsum("ni,nij,nj->n", contacts.normals, contacts.covariances, contacts.normals)
    np.testing.assert_allclose(height, [s.sigma_height**2 for s in contacts.samples])
    sigma_p = np.sqrt((np.einsum("nii->n", contacts.covariances) - height) / 2)
    assert sigma_p.min() > 2.0 * np.sqrt(height.max())
    both = np.einsum("nii->n", contacts.normal_covariances) / 2
    np.testing.assert_allclose(both, contacts.sigma_normal**2 + (contacts.coupling * sigma_p) ** 2)
    np.testing.assert_allclose(contacts.forces.mean(), 2.0, rtol=0.05)


def test_a_contact_in_doubt_is_worth_less(result):
    sure = result.contacts.samples[0]
    doubted = replace(sure, doubts=(Doubt.CUT,), sigma_motion=1e-3)
    one, other = contacts_of([sure, doubted], result.plan.setup.task, 0.0).covariances
    across = np.eye(3) - np.outer(sure.n_base, sure.n_base)  # a wrong instant displaces along the surface
    np.testing.assert_allclose(other, 9 * (one + 1e-6 * across))


def test_fit_surface_takes_them(result):
    c = result.contacts
    fitted = canprobe.fit_surface(
        c.points, c.normals, sigma_point=c.covariances, sigma_normal=c.sigma_normal, coupling=c.coupling
    )
    np.testing.assert_allclose(fitted.kappa, [1 / 0.036, 0.0], atol=0.5)


def test_an_own_estimator_stands_beside_ours(result):
    scores = result.score(sphere=LastSphere)
    assert list(scores) == ["recursive", "ml", "sphere"] and LastSphere.made == 1
    assert scores["ml"]["kappa_rms_error_per_m"] == result.summary["shape"]["methods"]["ml"]["kappa_rms_error_per_m"]
    # a ball in the place of a cylinder is wrong by the curvature along the axis, and by nothing else
    assert scores["sphere"]["kappa_rms_error_per_m"] == pytest.approx(1 / 0.036)
    assert scores["sphere"]["normal_rms_deg"] < 0.2 and scores["sphere"]["position_rms_mm"] < 0.1
    assert min(score["us_per_contact"] for score in scores.values()) > 0
    printed = repr(scores)
    assert printed.count("\n") == 3 and "sphere" in printed and "27.78" in printed
    assert "<td>sphere" in scores._repr_html_()
    assert list(result.score("chord")) == ["chord"]


def test_what_cannot_be_scored(result):
    with pytest.raises(UsageError, match=r"expected one of chen1996, .* did you mean ml"):
        result.score("mll")
    press = canprobe.run("press", {"task.clearance_mm": 0.5}, bus="direct", duration_s=0.05, files=False)
    assert press.contacts is None
    with pytest.raises(UsageError, match="score: expected a scan that touched its object"):
        press.score(sphere=LastSphere)


def test_it_prints_as_its_summary(result):
    assert repr(result) == result.text() and repr(result).startswith("cylinder on direct, seed 0: done\n")
    cell = canprobe.open_cell("free", {"task.duration_s": 0.02}, bus="direct")
    with cell:
        under_way = cell.run(lambda m: canprobe.Command(done=True))
        assert "under way" in repr(under_way)
    assert repr(under_way).startswith("free on direct")


def test_the_figure_is_that_of_the_report(result):
    figure = result.plot()
    assert figure._repr_png_().startswith(b"\x89PNG")
    titles = {axes.get_title(loc="left") for axes in figure.axes}
    assert {"contact force", "principal curvatures"} <= titles
    nothing = canprobe.run("free", {"task.duration_s": 0.02}, bus="direct", files=False)
    assert nothing.plot().axes  # its joints


def test_the_page_is_written_once_and_opened_where_there_is_a_browser(result, monkeypatch, tmp_path):
    opened = []
    monkeypatch.setattr(page.webbrowser, "open", opened.append)
    monkeypatch.setenv("DISPLAY", ":0")
    shown = result.view()
    assert opened == [shown.path.as_uri()] and shown.path.name == "report.html"
    assert shown._repr_html_().startswith('<iframe srcdoc="&lt;!')
    (tmp_path / "report.html").write_text("<p>kept")
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    setup = canprobe.plan("listen").setup
    assert page.page_of(tmp_path, setup)._repr_html_().startswith('<iframe srcdoc="&lt;p&gt;kept"') and len(opened) == 1


# What a cell tells a controller of one's own.


def test_a_controller_is_told_the_force_and_the_pose_of_the_probe():
    """Pressed down along the pole: the force that the array feels is that of the plant, the pose that of the probe."""
    felt, q = [], None

    def press(measurement):
        nonlocal q
        T_base_probe, J = cell.probe(measurement.q if q is None else q)
        assert J.shape == (6, 6)
        down = np.linalg.lstsq(J, np.concatenate([5e-6 * T_base_probe[:3, 2], np.zeros(3)]), rcond=None)[0]
        q = (measurement.q if q is None else q) + down
        if measurement.tactile is not None:
            felt.append(cell.patch(measurement.tactile))
        return canprobe.Command(q_target=q, done=bool(felt) and felt[-1].force > 0.5)

    with canprobe.open_cell("press", bus="direct") as cell:
        result = cell.run(press)
    assert felt[-1].good
    late = result.truth["force_n"][-40:]
    assert late.min() * 0.9 < felt[-1].force < late.max() * 1.1
    T_base_probe, _ = cell.probe(result.truth["q_rad"][-1])
    assert T_base_probe[:3, 3] == pytest.approx(result.truth["probe_centre_m"][-1], abs=1e-9)


@pytest.mark.parametrize(("scene", "method", "lacks"), [("free", "patch", "an array"), ("listen", "probe", "an arm")])
def test_a_cell_without_array_or_arm_says_so(scene, method, lacks):
    cell = canprobe.open_cell(scene)
    with pytest.raises(UsageError, match=f"^{scene}: expected a scene with {lacks}; got one without$"):
        getattr(cell, method)(None)
