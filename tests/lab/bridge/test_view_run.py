"""A recorded run as the 3-D view reads it, live and from its folder, and the page that replays it."""

from __future__ import annotations

import base64
import json
import math
import re
import shutil

import numpy as np
import pytest
from msgspec import msgpack
from puma_arm import UPENN
from zstandard import ZstdDecompressor

import canprobe
from canprobe.cell.results.result import write_page_of
from canprobe.cell.scene.geometry import true_object
from canprobe.errors import CanprobeError
from canprobe.lab.bridge.sample import ContactFrame, Sample, SurfacePatch
from canprobe.lab.bridge.view.instants import SILENT_NS, Follower, Moment, curves_of, judge, kappa_sigmas, row_of
from canprobe.lab.bridge.view.path import GAP_M, LIFT_M, Trail, deviation_scale
from canprobe.lab.bridge.view.recorded import read_run
from canprobe.lab.bridge.view.stage import FORCE_HEAD_M, FORCE_M_PER_N
from canprobe.mechanics.robot.chain import forward
from canprobe.mechanics.touch.objects import make_object
from canprobe.mechanics.touch.tangent_frames import homogeneous, tangent_rotation


@pytest.fixture(scope="module")
def run(recorded):
    return read_run(recorded.folder)


# what is read


def test_every_answer_and_every_tactile_frame_of_the_cell_is_found_once(run, recorded):
    said = recorded.result.estimates["recursive"]
    assert len(run.answers) == len(said) > 5
    for answer, record in zip(run.answers, said, strict=True):
        assert np.array_equal(answer.patch.K, record.estimate.K)
        assert np.array_equal(answer.patch.T_base_contact, record.estimate.T_frame_contact)
    seen = [o for o in recorded.observations if o.measurement and o.measurement.tactile]
    assert len(run.taxels) == len(seen) > 100
    for (t_s, taxels), observation in zip(run.taxels, seen, strict=True):
        assert t_s == pytest.approx(observation.t_ns * 1e-9, abs=1e-9)
        assert np.array_equal(taxels, observation.measurement.tactile.frame.taxels)


def test_a_moment_is_the_row_of_the_log(run, recorded):
    for row in (10, 700, len(recorded.log("t_s")) - 1):
        moment = run.at(float(recorded.log("t_s")[row]))
        assert np.array_equal(moment.q, recorded.log("q_rad")[row])
        assert np.array_equal([moment.force], recorded.log("force_n")[[row]], equal_nan=True)
        point = recorded.log("contact_mm")[row]
        if np.isfinite(point).all():
            assert moment.contact.point * 1e3 == pytest.approx(point)
            assert moment.contact.normal == pytest.approx(recorded.log("normal")[row])
        else:
            assert moment.contact is None


def test_live_and_recorded_show_the_same(run, recorded, samples):
    """The samples of the bridge, followed, against what was read from the folder, at every answer."""
    follower = Follower(true_object(recorded.result.plan.scene.object))
    compared, touched = 0, None
    for sample in samples:
        live = follower.take(sample)
        touched = (sample.touch and sample.touch.contact) or touched
        if sample.patch is None:
            continue
        kept = run.at(live.t_s)
        assert live.q.tolist() == kept.q.tolist() and live.phase in {kept.phase, "retreat"}
        assert live.force == pytest.approx(kept.force) and live.answer.error == pytest.approx(
            kept.answer.error, nan_ok=True
        )
        assert live.contact is touched
        apart, normal = live.contact.point - kept.contact.point, kept.contact.normal
        assert np.linalg.norm(apart - (apart @ normal) * normal) < 5e-6  # its height is the sample's business
        assert live.contact.T_base_contact[:3, 2] == pytest.approx(kept.contact.T_base_contact[:3, 2], abs=1e-6)
        compared += 1
    assert compared == len(run.answers)


def test_contact_ends_when_nothing_more_is_felt():
    contact = ContactFrame(np.eye(4))
    follower = Follower()
    follower.moment = Moment(contact=contact)
    follower._felt_ns = 0
    assert follower.take(Sample(SILENT_NS)).contact is contact
    assert follower.take(Sample(SILENT_NS + 1)).contact is None


# errors of curvature

AXES = homogeneous(tangent_rotation(np.array([0.0, 0.6, -0.8])), np.zeros(3))


def cylinder_patch(turn, scale=1.0, observed=(True, True), covariance=None):
    """The exact patch of a cylinder of 36 mm at a point of it, in axes turned about the normal."""
    pose = homogeneous(tangent_rotation(np.array([0.1, -0.2, math.sqrt(0.95)])), np.array([0.1, 0.2, 0.3]))
    shape = make_object("cylinder", T_base_object=pose, radius=0.036)
    foot = shape.closest(pose[:3, 3] + 0.01 * pose[:3, 1] + 0.003 * pose[:3, 2])
    c, s = math.cos(turn), math.sin(turn)
    x = c * foot.directions[0] + s * foot.directions[1]
    T = homogeneous(np.column_stack([x, np.cross(-foot.normal, x), -foot.normal]), foot.point)
    first = np.array([foot.directions[0] @ x, foot.directions[0] @ T[:3, 1]])
    K = scale * np.outer(first, first) / 0.036
    return SurfacePatch(0, T, K, np.eye(3) if covariance is None else covariance, observed), shape


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0])
def test_the_error_of_an_exact_patch_is_zero_in_any_axes_and_its_own_size_otherwise(turn):
    assert judge(*cylinder_patch(turn)).error < 1e-10
    assert judge(*cylinder_patch(turn, 1.1)).error == pytest.approx(0.1 / 0.036)
    assert judge(*cylinder_patch(turn, -1.0)).error == pytest.approx(2.0 / 0.036)
    assert math.isnan(judge(*cylinder_patch(turn, observed=(True, False))).error)
    assert math.isnan(judge(cylinder_patch(turn)[0], None).error)


def test_the_stated_deviation_is_the_expected_size_of_an_error():
    C = np.array([[0.4, 0.1, 0.0], [0.1, 0.2, -0.05], [0.0, -0.05, 0.3]])
    patch, _ = cylinder_patch(0.3, covariance=C)
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(3), C, 40_000)
    errors = draws[:, 0] ** 2 + 2 * draws[:, 1] ** 2 + draws[:, 2] ** 2
    assert judge(patch, None).sigma == pytest.approx(math.sqrt(errors.mean()), rel=0.02)
    K = patch.K + 1e-4 * np.stack([draws[:, :2], draws[:, 1:]], axis=1)
    kappas = np.linalg.eigvalsh(K)[:, ::-1] - np.linalg.eigvalsh(patch.K)[::-1]
    assert kappa_sigmas(patch) == pytest.approx(1e4 * kappas.std(axis=0), rel=0.03)
    open_ = np.where(np.eye(3) > 0, np.nan, C)
    assert judge(*cylinder_patch(0.0, covariance=open_)).sigma == math.inf
    assert kappa_sigmas(cylinder_patch(0.0, covariance=open_)[0]) == (math.inf, math.inf)


def test_curves_hold_the_bands_of_the_answers(run):
    curves = curves_of(row_of(run.at(t)) for t in run.times(0.04))
    last = run.answers[-1].patch
    assert (curves["kappa1"][-1], curves["kappa2"][-1]) == pytest.approx(last.kappa)
    s1, s2 = kappa_sigmas(last)
    assert curves["high1"][-1] - curves["low1"][-1] == pytest.approx(2 * 1.96 * s1)
    assert curves["high2"][-1] - curves["low2"][-1] == pytest.approx(2 * 1.96 * s2)
    assert (curves["true1"][-1], curves["true2"][-1]) == pytest.approx((1 / 0.036, 0.0), abs=1e-6)
    assert all(math.isnan(x) for x in row_of(Moment())[1:])


# the path


def test_the_trail_is_thinned_lifted_and_broken_where_the_probe_was():
    trail, up = Trail(), np.array([0.0, 0.0, 1.0])
    for i in range(101):
        trail.add(0.01 * i, np.array([1.01e-4 * i, 0.0, 0.0]), up)
    points = np.array(trail.segments)
    assert len(trail) == 25 and np.ptp(points[..., 0]) == pytest.approx(0.0101)
    assert points[..., 2] == pytest.approx(LIFT_M)
    assert np.array_equal(points[1:, 0], points[:-1, 1])
    assert not trail.add(2.0, np.array([0.01 + 2 * GAP_M, 0.0, 0.0]), up)
    assert trail.add(2.1, np.array([0.011 + 2 * GAP_M, 0.0, 0.0]), up)
    chunks = trail.chunks(most=10)
    assert [i for c in chunks for i in range(c.start, c.stop)] == list(range(len(trail))) and len(chunks) <= 11


def test_colours_of_the_surface_span_five_per_cent_of_the_curvature():
    shape = make_object("sphere", T_base_object=np.eye(4), radius=0.05)
    assert deviation_scale(shape, None).high == pytest.approx(0.05 * math.sqrt(2) / 0.05)
    assert deviation_scale(make_object("plane", T_base_object=np.eye(4)), None).high == 0.5
    assert "stated" in deviation_scale(None, None).text
    known, unsure = deviation_scale(shape, None).colours(np.array([0.0, 9.0])).tolist()
    assert sum(known) > sum(unsure)


def test_the_true_curvature_is_that_under_the_contact():
    """A torus of 60 and 20 mm, felt on its outside, where the larger ring has a radius of 80 mm."""
    shape = make_object("torus", T_base_object=np.eye(4), ring_radius=0.06, radius=0.02)
    outside = homogeneous(tangent_rotation(np.array([-1.0, 0.0, 0.0])), np.array([0.02, 0.0, -0.02]))
    patch = SurfacePatch(0, outside, np.diag([12.5, 50.0]), np.eye(3), (True, True))
    assert judge(patch, shape).kappa_true == pytest.approx((50.0, 12.5))


# the page


def inside(page):
    """The recording in a page and its arrays, by the published layout: msgpack behind its size, then aligned bytes."""
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', page)[1])
    inner = ZstdDecompressor().decompress(data[8:], max_output_size=int.from_bytes(data[:8], "little"))
    end = 8 + int.from_bytes(inner[:8], "little")
    recording, arrays = msgpack.decode(inner[8:end]), []
    for length in recording["binaryBufferLengths"]:
        end += -end % 8
        arrays.append(inner[end : end + length])
        end += length
    return recording, arrays


def panel_data(page):
    return json.loads(re.search(r"const run = (\{.*\});\n", page)[1])


def page_of_run(folder, plan):
    write_page_of(folder, plan.setup)
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(recorded):
    return page_of_run(recorded.folder, recorded.result.plan)


def test_a_run_has_a_page_that_loads_nothing(page):
    assert len(page) < 10e6
    loads = r"""(?:src|href|action)\s*=\s*["']?(?:https?:)?//|@import\s+["'u]|url\(\s*["']?(?:https?:)?//"""
    assert re.findall(loads, page) == []
    assert "<title>canprobe: Weave over a cylinder" in page
    opacity = {m["name"]: m["props"]["opacity"] for _, m in inside(page)[0]["messages"] if m["type"] == "MeshMessage"}
    links = {value for name, value in opacity.items() if name.startswith("/arm/")}
    assert links == {0.35} and opacity["/probe/holder"] is None, "the arm beside an object is seen through"


def test_the_page_holds_the_whole_run(page, run):
    scene = inside(page)[0]
    names = {message.get("name") for _, message in scene["messages"]}
    assert scene["durationSeconds"] == pytest.approx(run.duration_s)
    assert {f"/arm/{i}" for i in range(7)} | {"/object/ghost", "/probe/dome", "/contact", "/contact/force"} <= names
    assert {"/probe/taxels", "/path/000"} <= names and any(str(name).startswith("/surface/") for name in names)
    data = panel_data(page)
    assert data["curves"]["t_s"][-1] == pytest.approx(run.duration_s, rel=1e-4)
    frames = base64.b64decode(data["taxels"])
    assert frames[-256:] == run.at(run.duration_s).taxels.tobytes()
    assert len(frames) == 256 * len(data["phases"]) and data["truth"] is True


def test_scene_and_panel_of_the_page_have_one_clock(page, run):
    """What viser plays at an instant of its slider is what the panel shows there: the run at that instant."""

    def flange(t):
        return pytest.approx(forward(UPENN.chain, run.at(t).q)[:3, 3].tolist(), abs=1e-6)

    placed = {
        round(t, 6): m["position"]
        for t, m in inside(page)[0]["messages"]
        if m["type"] == "SetPositionMessage" and m["name"] == "/arm/6"
    }
    assert min(placed) == 0.0
    for t in panel_data(page)["curves"]["t_s"][1::10]:
        shown = placed[max(known for known in placed if known <= t + 1e-4)]
        assert shown == flange(t + 1e-4)
    assert placed[max(placed)] == flange(run.duration_s)


def test_the_arrow_is_seen_wherever_a_contact_is_known(page, run):
    """As long as the force says, and never shorter than its head."""
    recording, arrays = inside(page)
    seen, length = {}, math.nan
    shown = False
    for t, message in recording["messages"]:
        if message.get("name") == "/contact/force" and message["type"] == "SetSceneNodeVisibilityMessage":
            shown = message["visible"]
        elif message.get("name") == "/contact/force" and message["type"] == "SceneNodeUpdateMessage":
            foot, tip = np.frombuffer(arrays[message["updates"]["points"]["__binary_index"]], "<f4").reshape(2, 3)
            length = np.linalg.norm(tip - foot)
        seen[t] = length if shown else math.nan
    touched = 0
    for t in panel_data(page)["curves"]["t_s"][1:]:
        moment = run.at(t + 1e-4)
        arrow = seen[max(known for known in seen if known <= t + 1e-4)]
        if moment.contact is None:
            assert math.isnan(arrow)
        else:
            touched += 1
            assert arrow == pytest.approx(FORCE_HEAD_M + FORCE_M_PER_N * moment.force, rel=1e-3)
    assert touched > 20


def test_taxels_are_never_built_anew(page):
    """A new opacity would make viser's client build all taxels anew, with GL errors and pictures without them."""
    changed = {
        name
        for _, m in inside(page)[0]["messages"]
        if m["type"] == "SceneNodeUpdateMessage" and m["name"] == "/probe/taxels"
        for name in m["updates"]
    }
    assert changed == {"batched_colors", "batched_scales"}


def test_a_scene_without_a_shape_has_a_page_too(tmp_path):
    result = canprobe.run(canprobe.load_scene("press", {"outputs.figures": False}), out=tmp_path, duration_s=0.1)
    assert not (tmp_path / "report.html").exists()
    data = panel_data(page_of_run(tmp_path, result.plan))
    assert data["shape"] is False and data["sensor"] is True
    assert data["taxels"] != ""


# what cannot be read


def test_a_folder_that_is_no_run_is_told_apart(recorded, tmp_path):
    """tests/cell/results/test_run_files.py has all that may be wrong in one file."""
    with pytest.raises(CanprobeError, match="no such folder"):
        read_run(tmp_path / "nothing")
    for file in ("scene.toml", "summary.json"):
        shutil.copy(recorded.folder / file, tmp_path / file)
    with pytest.raises(CanprobeError, match=r"no log\.npz in this folder; expected one that `canprobe run --out DIR`"):
        read_run(tmp_path)
    np.savez(tmp_path / "log.npz", t_s=np.arange(3.0))
    with pytest.raises(CanprobeError, match=r"log\.npz: expected t_s on the clock of bus\.log, .* run the scene again"):
        read_run(tmp_path)
