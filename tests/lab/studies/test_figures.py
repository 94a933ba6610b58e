"""Every picture can be read where it is shown: in a column of 800 pixels, with nothing over anything else."""

import itertools
from dataclasses import replace

import matplotlib.image
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection, PolyCollection
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from matplotlib.transforms import Bbox

import canprobe
from canprobe.cell.results.figures import draw_run
from canprobe.cell.results.plan_figure import draw_plan
from canprobe.lab.studies import fault_cases, workprec
from canprobe.lab.studies import faults as faults_study
from canprobe.lab.studies.bound import NOISES, SIZES_M, draw_bound
from canprobe.lab.studies.ground import SURFACES
from canprobe.lab.studies.realtime_soak import draw_soak
from canprobe.lab.studies.workprec import draw_workprec

COLUMN_PX, WIDEST_PX, LEAST_TYPE_PX, LEAST_BAR_PX = 800, 1400, 9.0, 4.0
FILLED, TILES = 0.3, 3
"""Share of a panel's height that nine tenths of its data take; parts of a sheet across and down, none is empty."""


def draw_scene(scene, seconds, **summary):
    def drawing(path):
        result = canprobe.run(scene, {"cycle.rate_hz": 200.0}, bus="direct", duration_s=seconds, files=False)
        draw_run(replace(result.data, summary=result.summary | summary), path)

    return drawing


def bound(path):
    rng, rows = np.random.default_rng(0), []
    cases = itertools.product(("ml", "recursive"), SURFACES, SIZES_M, NOISES, ("weave", "circle"))
    for method, surface, size, noise, way in cases:
        far = surface == "torus" and size < 0.1
        rows.append({
            "method": method, "surface": surface, "size_mm": 1e3 * size, "sigma_point_um": 1e6 * noise[0], "path": way,
            "inside": not far, "ratio": rng.normal(1.0, 0.1) + far,
            "coverage": min(1.0, rng.normal(0.96, 0.02)) - 0.3 * far,
        })  # fmt: skip
    draw_bound(rows, path)


def plant(path):
    stiffnesses = workprec.STIFFNESSES[:2]
    floors = {k: {"force_percent": 1e-6, "position_um": 1e-6, "taxel_counts": 1e-6} for k in stiffnesses}
    rows = [
        {"stiffness_n_m3": k, "method": method, "step_us": step, "held": held, "stands": i > 0,
         "cost_us": 2e5 / step * (1 + i), **{key: 1e-6 * step**2 / (1 + i) for key in floors[k]}}
        for k in stiffnesses
        for i, method in enumerate(workprec.METHODS)
        for step in workprec.STEPS_US[1:3]
        for held in (True, False)
    ]  # fmt: skip
    draw_workprec(rows, floors, path)


def faults(path):
    rng = np.random.default_rng(0)
    ends = ("completed", "stopped for safety", "bus or node failure", "bring-up refused")
    runs = [
        {"kind": kind.name, "outcome": rng.choice(ends), "failures": [], "force_share": rng.lognormal(-0.7, 0.3)}
        for kind in fault_cases.KINDS[:8]
    ]
    faults_study.draw_runs(runs, path)


def soak(path):
    still = {"master_mib": 128.0, "nodes_mib": 84.0, "monitor_mib": 86.0, "missed_pdos": 0}
    samples = [still | {"t_s": 60.0 * k, "overruns": k // 9, "latency_us": 400.0 + 90 * np.sin(k)} for k in range(61)]
    draw_soak(samples, path)


def plan_with_a_pdo_that_is_not_used():
    """As of a drive that sends a TPDO of a fixed identifier beside the one that the cell needs."""
    plan = canprobe.plan(canprobe.load_scene("cylinder"))
    first, *others = plan.pdos
    assert first.part == "feedback"
    return replace(plan, pdos=(replace(first, used=False), *others))


FOUND = {"tool_centre_mm": [0.394, None, 80.478], "sigma_mm": [0.05, None, 0.08], "believed_mm": [0.0, 0.0, 80.0],
         "true_mm": [0.4, -0.3, 80.5], "error_mm": [0.006, None, 0.022], "touches": 13}  # fmt: skip
REASON = (
    "node 3 lost: $no frame^^$, no heartbeat for 250 ms; " + "quick stop of every drive, the probe was lifted off; " * 3
)
PICTURES = {
    "plane, stopped": draw_scene("plane", 1.5, completed=False, stop_reason=REASON),
    "free": draw_scene("free", 1.0),
    "press, calibrate": draw_scene("press", 0.5, calibration=FOUND),
    "listen": draw_scene("listen", 1.0),
    "plan": lambda path: draw_plan(plan_with_a_pdo_that_is_not_used(), path),
    "bound": bound,
    "workprec": plant,
    "faults": faults,
    "soak": soak,
}
OF_OTHER_TASKS = pytest.mark.slow(reason="the picture of one more task")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[OF_OTHER_TASKS] * (name[:4] in ("free", "pres", "list"))) for name in PICTURES]
)
def test_a_picture_can_be_read(name, tmp_path, monkeypatch):
    sheet, texts = drawn(PICTURES[name], tmp_path / "picture.png", monkeypatch)
    wrong = list(defects(sheet, texts, matplotlib.image.imread(tmp_path / "picture.png")[..., :3]))
    assert not wrong, "\n".join(wrong)


def defects(sheet, texts, image):
    """What is wrong with a sheet, in words."""
    high, wide, _ = image.shape
    if wide > WIDEST_PX:
        yield f"{wide} px wide"
    least = min(text.get_fontsize() * sheet.dpi / 72 * COLUMN_PX / wide for text, _ in texts)
    if least < LEAST_TYPE_PX:
        yield f"type of {least:.1f} px in a column"
    for text, box in texts:
        if box.x0 < 0 or box.y0 < 0 or box.x1 > wide or box.y1 > high:
            yield f"{text.get_text()!r} is cut off"
    yield from (f"{one!r} and {other!r} overlap" for one, other in overlapping(texts))
    yield from (f"tile {i} of the sheet is empty" for i in empty_tiles(image))
    panels = [axes for axes in sheet.axes if axes.get_visible()]
    for axes in panels:
        name = f"{axes.get_title('left')} {axes.get_title()} over {axes.get_xlabel()}"
        if any(box.overlaps(axes.get_window_extent()) for box in legends(sheet)):
            yield f"{name}: a legend lies on it"
        if axes.name == "rectilinear" and not filled(axes):
            yield f"{name}: data in a small part of it"
        yield from (f"{name}: a line hides another" for _ in hidden_lines(axes))
        yield from (f"{name}: a bar cannot be seen" for _ in invisible_bars(axes))


def drawn(draw, path, monkeypatch):
    """The sheet as it was saved, and what is written on it with the places."""
    sheets, texts = [], {}
    write, save = Text.draw, FigureCanvasAgg.print_png

    def writing(self, renderer):
        if self.get_visible() and self.get_text().strip():
            texts[id(self)] = self, self.get_window_extent(renderer)
        write(self, renderer)

    def saving(self, *args, **options):
        with monkeypatch.context() as patch:
            patch.setattr(Text, "draw", writing)
            save(self, *args, **options)
        sheets.append(self.figure)

    monkeypatch.setattr(FigureCanvasAgg, "print_png", saving)
    draw(path)
    return sheets[0], list(texts.values())


def overlapping(texts):
    """Pairs of level or upright texts of which one covers the other."""
    level = [(text.get_text(), box.padded(-1.0)) for text, box in texts if text.get_rotation() % 90.0 == 0.0]
    return [(a, b) for (a, one), (b, other) in itertools.combinations(level, 2) if one.overlaps(other)]


def parts_of(sheet):
    return [sheet, *(inner for part in sheet.subfigs for inner in parts_of(part))]


def legends(sheet):
    own = [axes.get_legend() for axes in sheet.axes if axes.get_legend() is not None]
    return [legend.get_window_extent() for legend in (*own, *(one for part in parts_of(sheet) for one in part.legends))]


def empty_tiles(image):
    """Parts of the sheet, counted from its upper left, with next to nothing on them."""
    ink = (image < 0.9).any(axis=2)
    tiles = [tile for line in np.array_split(ink, TILES) for tile in np.array_split(line, TILES, axis=1)]
    return [i for i, tile in enumerate(tiles) if tile.mean() < 0.003]


def data_of(axes):
    """What lines, marks and bands show on a panel, px."""
    shown = [line.get_xydata() for line in axes.lines if line.get_transform() == axes.transData]
    shown += [np.asarray(marks.get_offsets()) for marks in axes.collections if isinstance(marks, PathCollection)]
    shown += [way.vertices for band in axes.collections if isinstance(band, PolyCollection) for way in band.get_paths()]
    points = np.concatenate([np.asarray(values, float).reshape(-1, 2) for values in [*shown, np.empty((0, 2))]])
    with np.errstate(invalid="ignore"):
        return axes.transData.transform(points[np.isfinite(points).all(axis=1)])


def filled(axes):
    """Data take their share of the height of those panels that have one scale, unless they are few or to scale."""
    like = axes.get_shared_y_axes().get_siblings(axes)
    y = np.concatenate([np.clip(data_of(one)[:, 1], *one.bbox.intervaly) - one.bbox.y0 for one in like])
    return len(y) < 5 or axes.get_aspect() != "auto" or np.ptp(np.percentile(y, (5, 95))) >= FILLED * axes.bbox.height


def hidden_lines(axes):
    """Pairs of whole lines of which one lies on the other."""
    solid = [line for line in axes.lines if line.get_linestyle() == "-" and axes.name == "rectilinear"]
    lines = [axes.transData.transform(line.get_xydata()) for line in solid]
    pairs = [pair for pair in itertools.combinations(lines, 2) if len(pair[0]) == len(pair[1]) > 2]
    return [pair for pair in pairs if np.nanmax(np.abs(pair[0] - pair[1])) < 3.0]


def invisible_bars(axes):
    bars = [bar for bar in itertools.chain(*axes.containers) if isinstance(bar, Rectangle)]
    seen = [Bbox.intersection(bar.get_window_extent(), axes.bbox) for bar in bars if bar.get_width() * bar.get_height()]
    return [box for box in seen if box is None or min(box.size) < LEAST_BAR_PX]
