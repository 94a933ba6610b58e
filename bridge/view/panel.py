"""The panel beside the scene: figures of the task, the taxel image, plots over time."""

from __future__ import annotations

import html
import importlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from canprobe.cell.scene.model import Scene
from canprobe.lab.bridge.view.array_dome import taxel_image
from canprobe.lab.bridge.view.instants import Curves, Moment
from canprobe.lab.bridge.view.path import DeviationScale
from canprobe.lab.bridge.view.stage import Stage, legend_of

INK, FIRST_INK, SECOND_INK, FAINT = "#1f2933", "#c2410c", "#0f6e84", "#9aa5b1"
HEIGHT = 96
TAXEL_PIXELS = 5
"""Side of a taxel in its image."""


class Panel:
    """The panel that a browser shows beside the scene.

    Args:
        server: a `viser.ViserServer`.
        scene: scene that is shown.
        errors: scale of the surface's colours.
        stage: stage beside the panel, with lines about parts that cannot be drawn.
    """

    def __init__(self, server: Any, scene: Scene, errors: DeviationScale, stage: Stage) -> None:
        gui = server.gui
        gui.configure_theme(control_layout="fixed", control_width="medium", show_logo=False, brand_color=(15, 110, 132))
        gui.set_panel_label(f"canprobe · {scene.name}")
        force = scene.task.force_n if scene.task.kind in ("scan", "press") else math.nan
        self._target = math.nan if isinstance(force, Mapping) else force
        self._status = gui.add_html("")
        rows = [_KEY.format(colour, html.escape(text)) for colour, text in legend_of(scene)]
        gui.add_html(_PHONE + _STYLED.format("<br>".join([" &ensp; ".join(rows), *map(html.escape, stage.notes)])))
        stage.add_switches(gui)
        self._plots: list[tuple[Any, tuple[str, ...]]] = []
        self._taxels = None
        if scene.shape is not None:
            bar = np.broadcast_to(errors.colours(np.linspace(0.0, errors.high, 256)), (14, 256, 3))
            gui.add_image(
                np.ascontiguousarray(bar), label=f"surface: 0 … {errors.high:.2g}  {errors.text}", format="png"
            )
        if scene.sensor is not None:
            blank = np.zeros((scene.sensor.rows, scene.sensor.columns), np.uint8)
            self._taxels = gui.add_image(taxel_image(blank, TAXEL_PIXELS), label="taxel image", format="png")
            self._add_plot(gui, "force (N)", ("force", "target"), (FIRST_INK, FAINT))
        if scene.shape is not None:
            names = ("true1", "true2", "low1", "high1", "low2", "high2", "kappa1", "kappa2")
            colours = (FAINT, FAINT, FIRST_INK, FIRST_INK, SECOND_INK, SECOND_INK, FIRST_INK, SECOND_INK)
            self._add_plot(gui, "κ1, κ2 with 95 % bands; grey: true (1/m)", names, colours)
            self._add_plot(gui, "error of K; grey: stated deviation (1/m)", ("error", "sigma"), (INK, FAINT))

    def _add_plot(self, gui: Any, title: str, names: tuple[str, ...], colours: tuple[str, ...]) -> None:
        uplot = importlib.import_module("viser").uplot
        series = [uplot.Series(label="t (s)")]
        for name, colour in zip(names, colours, strict=True):
            thin = name.startswith(("low", "high", "true")) or name in ("target", "sigma")
            series.append(uplot.Series(label=name, stroke=colour, width=1.0 if thin else 2.0))
        empty = tuple(np.array([0.0, 1.0]) if i == 0 else np.full(2, np.nan) for i in range(len(series)))
        handle = gui.add_uplot(
            empty, tuple(series), title=title, height=HEIGHT, scales=_scales(empty[0], []),
            legend=uplot.Legend(show=False),
        )  # fmt: skip
        self._plots.append((handle, names))

    def show(self, moment: Moment, curves: Curves | None = None) -> None:
        """Show a moment, and curves where there are new ones."""
        self._status.content = _STYLED.format("<br>".join(self._lines(moment)))
        if self._taxels is not None and moment.taxels is not None:
            self._taxels.image = taxel_image(moment.taxels, TAXEL_PIXELS)
        if curves is None or len(curves["t_s"]) < 2:
            return
        times = curves["t_s"]
        known = curves | {"target": np.full(len(times), self._target)}
        for handle, names in self._plots:
            columns = [known[name] for name in names]
            handle.scales = _scales(times, columns)
            handle.data = (times, *columns)

    def _lines(self, moment: Moment) -> Iterator[str]:
        force = f" · <b>{moment.force:.2f} N</b>" if math.isfinite(moment.force) else ""
        yield f"<b>{moment.t_s:.2f} s</b> {moment.phase or ''}{force}"
        if (answer := moment.answer) is not None:
            kappa = ", ".join("not observed" if math.isnan(k) else f"{k:.2f}" for k in answer.patch.kappa)
            error = "" if math.isnan(answer.error) else f" · error of K <b>{answer.error:.2f}</b>"
            yield f"κ <b>{kappa} 1/m</b>{error}"
            if math.isfinite(answer.kappa_true[0]):
                yield f"true κ {answer.kappa_true[0]:.2f}, {answer.kappa_true[1]:.2f} 1/m"
        if moment.dropped:
            yield f"samples dropped: {moment.dropped}"


_PHONE = """<style>
@media (max-width: 36em) { /* viser lays its panel over the picture there: below it, and as wide */
  #root:has([aria-hidden="false"] .mantine-InputWrapper-root) > div { height: 58vh !important; }
  .mantine-Paper-root[style*="position: fixed"] { max-height: 42vh !important; width: 100% !important; }
  .mantine-Paper-root[style*="position: fixed"] .mantine-ScrollArea-content > div { width: 100% !important; }
}
</style>"""
_STYLED = '<div style="padding: 0 0.6em 0.4em; font-size: 0.9em; line-height: 1.5">{}</div>'
_KEY = '<span style="white-space: nowrap"><span style="color: rgb{}">&#9632;</span> {}</span>'


def _scales(times: Any, columns: list[Any]) -> dict[str, Any]:
    """Fixed ends of the axes: uPlot cannot find them where a value is missing (NaN)."""
    scale_of = importlib.import_module("viser").uplot.Scale
    values = np.concatenate([column[np.isfinite(column)] for column in columns]) if columns else np.empty(0)
    low, high = np.percentile(values, (1.0, 99.0)).tolist() if len(values) else (0.0, 1.0)
    low = min(low, 0.0)
    spare = 0.08 * (high - low) or 1.0
    ends = (low - spare if low < 0.0 else 0.0, high + spare)
    span = (float(times[0]), max(float(times[-1]), float(times[0]) + 1e-3))
    return {"x": scale_of(time=False, auto=False, range=span), "y": scale_of(auto=False, range=ends)}
