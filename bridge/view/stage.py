"""The scene in the browser: a viser server, its nodes for arm, probe, object, contact and path, and the panel beside
them.
"""

from __future__ import annotations

import contextlib
import html
import importlib
import io
import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.scene.geometry import T_flange_probe, true_object
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.resolve import resolve
from canprobe.errors import InterfaceError
from canprobe.fieldbus.bus.port import MonotonicClock
from canprobe.lab.bridge.database import need
from canprobe.lab.bridge.sample import quaternion_of
from canprobe.lab.bridge.view.bodies import (
    link_frames,
    object_lines,
    object_mesh,
    probe_parts,
    taxel_colours,
    taxel_image,
    taxel_poses,
    tile,
)
from canprobe.lab.bridge.view.instants import Curves, Moment
from canprobe.lab.bridge.view.links import arm_links
from canprobe.lab.bridge.view.meshes import Array, Mesh, linear_light
from canprobe.lab.bridge.view.path import PATH, DeviationScale
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.patch.array_calibration import NOMINAL
from canprobe.mechanics.touch.shapes import PlacedShape

# The scene in the browser: arm, probe, object, contact, force, patch and path as viser's nodes.

OBJECT, PROBE, FORCE = (126, 150, 176), (78, 88, 104), (214, 40, 30)
FORCE_M_PER_N = 0.012
"""Length of the shaft of the force arrow; its head is added, so that the smallest force has an arrow, too."""
FORCE_HEAD_M = 0.007
LOOK_ASIDE = math.radians(55.0)
"""Of the camera, from the line that leads from base to contact, seen from above: the arm hides nothing there."""
FOLLOW_M = 4e-3
"""The camera of a browser follows the contact in steps of this size: between them it is the user's."""
ARRIVING_S = 3.0
"""From the first time that it was moved; until then a page may set its camera anew while it is laid out."""
ALONE = (0.0, 0.0, 0.12)
"""Where the probe stands, pole up, in a scene without an arm, m."""


def legend_of(scene: Scene) -> list[tuple[tuple[int, int, int], str]]:
    """Colours of what is drawn, and what it is."""
    rows = []
    if scene.object is not None:
        rows.append((OBJECT, "true object"))
    if scene.probe is not None:
        rows += [(PATH, "path of the contact"), (FORCE, "contact force")]
    return rows


def place_of(scene: Scene) -> Array:
    """(3,) where the object's surface is, or where it is looked for, base frame, m."""
    if scene.object is None:
        return np.array(scene.task.start_mm) * 1e-3
    return true_object(scene.object).T_base_object[:3, 3]


class Stage:
    """All nodes of one scene on a viser server.

    Args:
        server: a `viser.ViserServer`, or a client handle; only its `scene` and `initial_camera` are used.
        scene: which arm, probe and object.

    Attributes:
        notes: lines about what cannot be drawn, and what the newtons are.
    """

    def __init__(self, server: Any, scene: Scene) -> None:
        self._api = server.scene
        setup = resolve(scene)
        arm, array = setup.arm, setup.array
        self._model = None if arm is None else arm.model
        self._shape = None if scene.object is None else true_object(scene.object)
        self._probe = None
        self._tool = np.eye(4) if scene.probe is None else T_flange_probe(scene.probe)
        self.notes: list[str] = [] if array is None or array.newtons != NOMINAL else [f"force in {NOMINAL}"]
        self._place, self._moved, self._met = place_of(scene), dict[int, Array](), dict[int, float]()
        self._clock = MonotonicClock()
        self._truth: list[Any] = []
        self._follows = None
        self._server = server
        self._light()
        if self._shape is not None:
            self._add_object(self._shape)
        if self._model is not None and scene.arm is not None:
            parts, undrawn = arm_links(scene.arm, self._model.chain)
            self.notes += undrawn
            self._links = [self._api.add_frame(f"/arm/{i}", show_axes=False) for i in range(self._model.n + 1)]
            for part in parts:
                self._add(f"/arm/{part.frame}/{part.name}", part.mesh, part.colour, flat_shading=part.flat)
        if scene.probe is not None:
            self._add_probe(scene.probe.radius_mm * 1e-3, array.pad if array is not None else None)
        self._add_contact()
        self._look(server, scene)

    # building

    def _add(self, name: str, mesh: Mesh, colour: tuple[int, int, int], **settings: Any) -> Any:
        return self._api.add_mesh_simple(
            name, mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), color=colour, **settings
        )

    def _light(self) -> None:
        api = self._api
        api.configure_default_lights(enabled=False)
        api.configure_environment_map(None)
        api.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(176, 168, 156), intensity=1.6)
        for name, place, intensity, shadow in (
            ("sun", (-0.9, -1.2, 2.0), 2.2, True),
            ("fill", (1.5, -0.4, 0.8), 0.9, False),
        ):
            api.add_light_directional(f"/light/{name}", position=place, intensity=intensity, cast_shadow=shadow)
        api.add_grid(
            "/floor", width=1.6, height=1.6, cell_size=0.05, section_size=0.2, cell_color=(226, 229, 233),
            section_color=(200, 206, 212), plane_color=(247, 248, 250), plane_opacity=1.0, shadow_opacity=0.25,
        )  # fmt: skip

    def _add_object(self, shape: PlacedShape) -> None:
        ghost = self._add("/object/ghost", object_mesh(shape), OBJECT, opacity=0.3, side="double", cast_shadow=False)
        lines = self._api.add_line_segments(
            "/object/lines", object_lines(shape).astype(np.float32), (150, 165, 184), thickness=1.0,
            thickness_units="screen",
        )  # fmt: skip
        self._truth = [ghost, lines]

    def _add_probe(self, radius: float, pad: Pad | None) -> None:
        self._probe = self._api.add_frame("/probe", show_axes=False, position=ALONE)
        holder, elastic = probe_parts(radius, self._tool)
        self._add("/probe/holder", holder, PROBE)
        self._add("/probe/dome", elastic, (120, 128, 140), opacity=0.14, side="double", cast_shadow=False)
        if pad is not None:
            places, turns = taxel_poses(pad, radius)
            vertices, faces = tile(pad)
            blank = np.zeros(len(places), np.uint8)
            self._taxels = self._api.add_batched_meshes_simple(
                "/probe/taxels", vertices.astype(np.float32), faces.astype(np.uint32), turns, places,
                batched_colors=linear_light(taxel_colours(blank)), batched_scales=_taxel_scales(blank),
                opacity=0.85, side="double", cast_shadow=False, lod="off",
            )  # fmt: skip
        else:
            self._taxels = None

    def _add_contact(self) -> None:
        api = self._api
        self._contact = api.add_frame(
            "/contact", axes_length=0.012, axes_radius=0.0004, origin_radius=0.0008, visible=False
        )
        self._force = api.add_arrows(
            "/force", np.zeros((1, 2, 3), np.float32), FORCE, shaft_radius=0.0012, head_radius=0.003,
            head_length=FORCE_HEAD_M, visible=False,
        )  # fmt: skip
        self._label = api.add_label("/force/label", "", anchor="bottom-center", visible=False)

    def _look(self, server: Any, scene: Scene) -> None:
        """At probe and contact, across the line from the base to them: there the arm hides nothing."""
        camera = server.initial_camera
        if self._shape is not None or scene.task.kind in ("scan", "press"):
            place = place_of(scene)
            out, heading = math.atan2(place[1], place[0]), math.radians(scene.task.heading_deg)
            across = max((out - LOOK_ASIDE, out + LOOK_ASIDE), key=lambda angle: abs(math.sin(angle - heading)))
            target = place + np.array((0.0, 0.0, 0.012))
            away = 0.21 * np.array((math.cos(across), math.sin(across), 0.5))
        elif self._model is not None:
            target, away = np.array((0.0, 0.0, 0.32)), np.array((-1.0, 0.55, 0.3))
        else:
            target, away = np.array(ALONE), np.array((-0.12, -0.16, 0.16))
        self._view = target + away, target
        camera.position, camera.look_at, camera.up = *self._view, (0.0, 0.0, 1.0)
        camera.fov = math.radians(34.0)

    def add_switches(self, gui: Any) -> None:
        """Add what decides whether the camera follows, and whether the true object is shown."""
        self._follows = gui.add_checkbox("follow", True)
        if self._truth:
            gui.add_checkbox("true object", True).on_update(self._show_truth)

    def _show_truth(self, event: Any) -> None:
        for node in self._truth:
            node.visible = event.target.value

    # showing

    def show(self, moment: Moment) -> None:
        """Move everything to a moment."""
        if moment.q is not None and self._model is not None:
            self._move_arm(self._model, moment.q)
        if moment.taxels is not None and self._taxels is not None:
            counts = moment.taxels.reshape(-1)
            self._taxels.batched_colors = linear_light(taxel_colours(counts))
            self._taxels.batched_scales = _taxel_scales(counts)
        self._show_contact(moment)
        if moment.contact is not None and self._follows is not None and self._follows.value:
            self._follow(moment.contact.point - self._place)

    def _follow(self, away: Array) -> None:
        """Carry every browser's camera along, in steps; how it was turned by hand stays."""
        now = 1e-9 * self._clock.now_ns()
        for number, client in self._server.get_clients().items():
            camera = client.camera
            if now - self._met.setdefault(number, now) < ARRIVING_S:  # a page that is being laid out has other places
                position, look_at, step = *self._view, away
            else:
                position, look_at, step = camera.position, camera.look_at, away - self._moved[number]
            if number not in self._moved or float(np.linalg.norm(step)) > FOLLOW_M:
                self._moved[number] = away
                camera.position, camera.look_at = position + step, look_at + step

    def _move_arm(self, model: ArmModel, q: Array) -> None:
        frames = link_frames(model.chain, q)
        for handle, T in zip(self._links[1:], frames[1:], strict=True):  # the base stands still
            _place(handle, T)
        if self._probe is not None:
            _place(self._probe, frames[-1] @ self._tool)

    def _show_contact(self, moment: Moment) -> None:
        contact = moment.contact
        self._contact.visible = self._force.visible = self._label.visible = contact is not None
        if contact is None:
            return
        _place(self._contact, contact.T_base_contact)
        tip = contact.point + (FORCE_M_PER_N * moment.force + FORCE_HEAD_M) * contact.normal
        self._force.points = np.array([[contact.point, tip]], np.float32)
        self._label.position = tuple(tip)
        self._label.text = f"{moment.force:.2f} N"


def _taxel_scales(counts: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Taxels without pressure are dots.

    Not by their opacity: a browser builds all taxels anew when one opacity changes, and draws none of them meanwhile.
    """
    return np.where(counts > 0, 1.0, 0.12).astype(np.float32)


def _place(handle: Any, T: Array) -> None:
    x, y, z, w = quaternion_of(T[:3, :3])
    handle.wxyz = (w, x, y, z)
    handle.position = T[:3, 3]


# A viser server that says nothing on stdout and leaves nothing behind.


@contextlib.contextmanager
def open_server(port: int, host: str = "127.0.0.1") -> Iterator[Any]:
    """A server for browsers, stopped on leaving.

    Args:
        port: 0 lets the system choose; where it is taken, the next free one.
        host: 0.0.0.0 for other machines too.

    Raises:
        UsageError: viser is not installed.
        InterfaceError: no port can be had.
    """
    viser = need("viser", "view", "the view")
    with contextlib.redirect_stdout(io.StringIO()):  # viser greets and leaves with a box on stdout
        try:
            server = viser.ViserServer(host=host, port=port, label="canprobe", verbose=False)
        except OSError as error:
            raise InterfaceError(f"{host}:{port}: no port to show the cell on: {error.strerror or error}") from error
    try:
        yield server
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def address(server: Any) -> str:
    """Where a browser finds a server."""
    host = server.get_host()
    return f"http://{'localhost' if host == '0.0.0.0' else host}:{server.get_port()}"


# Beside the scene: what the task does in figures, the taxel image, plots over time.

INK, FIRST, SECOND, FAINT = "#1f2933", "#c2410c", "#0f6e84", "#9aa5b1"
HEIGHT = 96
PIXELS = 5
"""Of a taxel in its image."""


class Panel:
    """What a browser shows beside the scene.

    Args:
        server: a `viser.ViserServer`.
        scene: that is shown.
        errors: what the path's colours mean.
        stage: what is beside, with lines about what cannot be drawn.
    """

    def __init__(self, server: Any, scene: Scene, errors: DeviationScale, stage: Stage) -> None:
        gui = server.gui
        gui.configure_theme(control_layout="fixed", control_width="medium", show_logo=False, brand_color=(15, 110, 132))
        gui.set_panel_label(f"canprobe · {scene.name}")
        self._target = scene.task.force_n if scene.task.kind in ("scan", "press") else None
        self._status = gui.add_html("")
        gui.add_html(_PHONE + _legend(scene, stage.notes))
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
            self._taxels = gui.add_image(taxel_image(blank, PIXELS), label="taxel image", format="png")
            self._add_plot(gui, "force (N)", ("force", "target"), (FIRST, FAINT))
        if scene.shape is not None:
            names = ("true1", "true2", "low1", "high1", "low2", "high2", "kappa1", "kappa2")
            colours = (FAINT, FAINT, FIRST, FIRST, SECOND, SECOND, FIRST, SECOND)
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


def _legend(scene: Scene, notes: Sequence[str]) -> str:
    rows = [_KEY.format(colour, html.escape(text)) for colour, text in legend_of(scene)]
    return _STYLED.format("<br>".join([" &ensp; ".join(rows), *map(html.escape, notes)]))


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
