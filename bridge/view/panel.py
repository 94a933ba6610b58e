"""Beside the scene: what the task does in figures, the taxel image, plots over time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from canprobe.bridge.view.colours import scale
from canprobe.bridge.view.curves import Curves
from canprobe.bridge.view.moments import Moment
from canprobe.bridge.view.server import import_viser
from canprobe.bridge.view.taxels import taxel_image
from canprobe.bridge.view.trail import ErrorScale
from canprobe.scene import Scene

INK, FIRST, SECOND, FAINT = "#1f2933", "#c2410c", "#0f6e84", "#9aa5b1"
HEIGHT = 130
PIXELS = 8
"""Of a taxel in its image."""


class Panel:
    """What a browser shows beside the scene.

    Args:
        server: a `viser.ViserServer`.
        scene: that is shown.
        errors: what the path's colours mean.
        kappa_true: principal curvatures of the true object, 1/m; None where it is not known.
    """

    def __init__(self, server: Any, scene: Scene, errors: ErrorScale, kappa_true: tuple[float, float] | None) -> None:
        gui = server.gui
        gui.configure_theme(control_layout="fixed", control_width="medium", show_logo=False, brand_color=(15, 110, 132))
        gui.set_panel_label(f"canprobe · {scene.name}")
        self._target = scene.task.force_n if scene.task.kind in ("scan", "press") else None
        self._kappa_true = kappa_true
        self._status = gui.add_markdown("")
        self._plots: list[tuple[Any, tuple[str, ...]]] = []
        self._taxels = None
        if scene.shape is not None:
            bar = np.broadcast_to(scale(np.linspace(0.0, 1.0, 256), 0.0, 1.0), (14, 256, 3))
            gui.add_image(np.ascontiguousarray(bar), label=f"path: 0 … {errors.high:.2g}  {errors.text}", format="png")
        if scene.sensor is not None:
            blank = np.zeros((16, 16), np.uint8)
            self._taxels = gui.add_image(taxel_image(blank, PIXELS), label="taxel image", format="png")
            self._add_plot(gui, "force (N)", ("force", "target"), (FIRST, FAINT))
        if scene.shape is not None:
            names = ("kappa1", "low1", "high1", "kappa2", "low2", "high2")
            self._add_plot(gui, "principal curvatures, 95 % bands (1/m)", names, (FIRST, *2 * (FIRST,), *3 * (SECOND,)))
            self._add_plot(gui, "error and stated std. deviation of K (1/m)", ("error", "sigma"), (INK, FAINT))

    def _add_plot(self, gui: Any, title: str, names: tuple[str, ...], colours: tuple[str, ...]) -> None:
        uplot = import_viser().uplot
        series = [uplot.Series(label="t (s)")]
        for name, colour in zip(names, colours, strict=True):
            thin = name.startswith(("low", "high")) or name in ("target", "sigma")
            series.append(uplot.Series(label=name, stroke=colour, width=1.0 if thin else 2.0))
        empty = tuple(np.array([0.0, 1.0]) if i == 0 else np.full(2, np.nan) for i in range(len(series)))
        handle = gui.add_uplot(
            empty, tuple(series), title=title, height=HEIGHT, scales=_scales(empty[0], []),
            legend=uplot.Legend(show=False),
        )  # fmt: skip
        self._plots.append((handle, names))

    def show(self, moment: Moment, curves: Curves | None = None) -> None:
        """Show a moment, and curves where there are new ones."""
        self._status.content = self._text(moment)
        if self._taxels is not None and moment.taxels is not None:
            self._taxels.image = taxel_image(moment.taxels, PIXELS)
        if curves is None or len(curves["t_s"]) < 2:
            return
        for handle, names in self._plots:
            columns = [self._column(curves, name) for name in names]
            handle.scales = _scales(curves["t_s"], columns)
            handle.data = (curves["t_s"], *columns)

    def _column(self, curves: Curves, name: str) -> Any:
        if name == "target":
            return np.full(len(curves["t_s"]), math.nan if self._target is None else self._target)
        return curves[name]

    def _text(self, moment: Moment) -> str:
        rows = [("time", f"{moment.t_s:.2f} s")]
        if moment.phase is not None:
            rows.append(("phase", moment.phase))
        if math.isfinite(moment.force):
            rows.append(("force", f"{moment.force:.2f} N"))
        if moment.patch is not None:
            kappa = ", ".join("not observed" if math.isnan(k) else f"{k:.2f}" for k in moment.patch.kappa)
            rows.append(("κ", f"{kappa} 1/m"))
            if self._kappa_true is not None:
                rows.append(("κ true", f"{self._kappa_true[0]:.2f}, {self._kappa_true[1]:.2f} 1/m"))
            rows.append(("error of K", "–" if math.isnan(moment.error) else f"{moment.error:.2f} 1/m"))
        if moment.dropped:
            rows.append(("samples dropped", str(moment.dropped)))
        return "| | |\n|:--|:--|\n" + "\n".join(f"| {name} | **{text}** |" for name, text in rows)


def _scales(times: Any, columns: list[Any]) -> dict[str, Any]:
    """Fixed ends of the axes: uPlot finds none of its own where a value is missing (NaN)."""
    scale_of = import_viser().uplot.Scale
    values = np.concatenate([column[np.isfinite(column)] for column in columns]) if columns else np.empty(0)
    low, high = np.percentile(values, (1.0, 99.0)).tolist() if len(values) else (0.0, 1.0)
    low = min(low, 0.0)
    spare = 0.08 * (high - low) or 1.0
    ends = (low - spare if low < 0.0 else 0.0, high + spare)
    span = (float(times[0]), max(float(times[-1]), float(times[0]) + 1e-3))
    return {"x": scale_of(time=False, auto=False, range=span), "y": scale_of(auto=False, range=ends)}
