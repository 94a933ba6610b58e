"""The scene in the browser: arm, probe, object, contact, force, patch and path as viser's nodes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.scene.geometry import T_flange_probe
from canprobe.cell.scene.model import Scene
from canprobe.cell.scene.setup import Setup
from canprobe.fieldbus.bus.clock import MonotonicClock
from canprobe.lab.bridge.description import quaternion_of
from canprobe.lab.bridge.view.array_dome import probe_parts, taxel_colours, taxel_poses, tile
from canprobe.lab.bridge.view.colours import linear_light
from canprobe.lab.bridge.view.instants import Moment
from canprobe.lab.bridge.view.links import arm_links
from canprobe.lab.bridge.view.object_sheet import object_lines, object_mesh
from canprobe.lab.bridge.view.path import AHEAD, PATH
from canprobe.mechanics.robot.chain import link_frames
from canprobe.mechanics.robot.model import ArmModel
from canprobe.mechanics.touch.image.calibration import NO_FORCE_REFERENCE
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.shapes import PlacedShape
from canprobe.mechanics.types import Floats

OBJECT, PROBE, FORCE = (126, 150, 176), (78, 88, 104), (214, 40, 30)
ARM_OPACITY = 0.35
"""Opacity of the links beside an object: they may stand between it and the eye."""
FORCE_M_PER_N = 0.012
"""Length of the shaft of the force arrow; its head is added, so that the smallest force has an arrow, too."""
FORCE_HEAD_M = 0.007
LOOK_ASIDE_RAD = math.radians(55.0)
"""Angle of the camera from the line that leads from base to contact, seen from above: the arm hides nothing there."""
FOLLOW_M = 4e-3
"""Step in which the camera follows the contact, m: between steps the user may move it."""
ARRIVING_S = 3.0
"""Time after its first motion in which a page may set its camera anew while it is laid out, s."""
LONE_PROBE_M = (0.0, 0.0, 0.12)
"""Place of the probe, pole up, in a scene without an arm, m."""


def legend_of(scene: Scene) -> list[tuple[tuple[int, int, int], str]]:
    """Colours of the drawn parts, and their names."""
    rows = []
    if scene.object is not None:
        rows.append((OBJECT, "true object"))
    if scene.probe is not None:
        rows += [(PATH, "path of the contact"), (FORCE, "contact force")]
    if scene.task.strategy == "explore":
        rows.append((AHEAD, "path ahead"))
    return rows


def place_of(setup: Setup) -> Floats:
    """Place of the object's surface (3,), or the place where it is searched for, base frame, m."""
    if setup.truth.object is None:
        return np.array(setup.scene.task.start_mm) * 1e-3
    return setup.truth.object.T_base_object[:3, 3]


class Stage:
    """All nodes of one scene on a viser server.

    Args:
        server: a `viser.ViserServer`, or a client handle; only its `scene` and `initial_camera` are used.
        setup: setup with arm, probe and object.

    Attributes:
        notes: lines about parts that cannot be drawn, and about the unit of force.
    """

    def __init__(self, server: Any, setup: Setup) -> None:
        self._api = server.scene
        scene, arm, array = setup.scene, setup.arm, setup.array
        self._model = None if arm is None else arm.model
        self._shape = setup.truth.object
        self._probe = self._taxels = None
        self._tool = np.eye(4) if scene.probe is None else T_flange_probe(scene.probe)
        no_newtons = array is not None and array.newtons == NO_FORCE_REFERENCE
        self.notes = [f"force in {NO_FORCE_REFERENCE}"] if no_newtons else []
        self._place, self._moved, self._met = place_of(setup), dict[int, Floats](), dict[int, float]()
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
            opacity = ARM_OPACITY if self._shape is not None else None
            for part in parts:
                self._add(f"/arm/{part.frame}/{part.name}", part.mesh, part.colour, flat_shading=True, opacity=opacity)
        if scene.probe is not None:
            self._add_probe(scene.probe.radius_mm * 1e-3, array.pad if array is not None else None)
        self._add_contact()
        self._look(server, scene)

    # building

    def _add(self, name: str, mesh: Any, colour: tuple[int, int, int], **settings: Any) -> Any:
        return self._api.add_mesh_simple(
            name, mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), color=colour, **settings
        )

    def _light(self) -> None:
        api = self._api
        api.configure_default_lights(enabled=False)
        api.configure_environment_map(None)
        api.add_light_hemisphere("/light/sky", sky_color=(255, 255, 255), ground_color=(176, 168, 156), intensity=1.6)
        api.add_light_directional("/light/sun", position=(-0.9, -1.2, 2.0), intensity=2.2, cast_shadow=True)
        api.add_light_directional("/light/fill", position=(1.5, -0.4, 0.8), intensity=0.9, cast_shadow=False)
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
        self._probe = self._api.add_frame("/probe", show_axes=False, position=LONE_PROBE_M)
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

    def _add_contact(self) -> None:
        api = self._api
        self._contact = api.add_frame(
            "/contact", axes_length=0.012, axes_radius=0.0004, origin_radius=0.0008, visible=False
        )
        self._force = api.add_arrows(
            "/contact/force", np.zeros((1, 2, 3), np.float32), FORCE, shaft_radius=0.0012, head_radius=0.003,
            head_length=FORCE_HEAD_M, visible=False,
        )  # fmt: skip
        self._label = api.add_label("/contact/force/label", "", anchor="bottom-center", visible=False)

    def _look(self, server: Any, scene: Scene) -> None:
        """Look at probe and contact, across the line from the base to them: there the arm hides nothing."""
        camera = server.initial_camera
        if self._shape is not None or scene.task.kind in ("scan", "press"):
            place = self._place
            out, heading = math.atan2(place[1], place[0]), math.radians(scene.task.heading_deg)
            across = max((out - LOOK_ASIDE_RAD, out + LOOK_ASIDE_RAD), key=lambda angle: abs(math.sin(angle - heading)))
            target = place + np.array((0.0, 0.0, 0.012))
            away = 0.21 * np.array((math.cos(across), math.sin(across), 0.5))
        elif self._model is not None:
            target, away = np.array((0.0, 0.0, 0.32)), np.array((-1.0, 0.55, 0.3))
        else:
            target, away = np.array(LONE_PROBE_M), np.array((-0.12, -0.16, 0.16))
        self._view = target + away, target
        camera.position, camera.look_at, camera.up = *self._view, (0.0, 0.0, 1.0)
        camera.fov = math.radians(34.0)

    def add_switches(self, gui: Any) -> None:
        """Add switches for the camera that follows, and for the true object."""
        self._follows = gui.add_checkbox("follow", True)
        if self._truth:
            gui.add_checkbox("true object", True).on_update(self._show_truth)

    def _show_truth(self, event: Any) -> None:
        for node in self._truth:
            node.visible = event.target.value

    # showing

    def show(self, moment: Moment) -> None:
        """Show a moment."""
        if moment.q is not None and self._model is not None:
            self._move_arm(self._model, moment.q, moment.T_base_carrier)
        if moment.taxels is not None and self._taxels is not None:
            counts = moment.taxels.reshape(-1)
            self._taxels.batched_colors = linear_light(taxel_colours(counts))
            self._taxels.batched_scales = _taxel_scales(counts)
        self._show_contact(moment)
        if moment.contact is not None and self._follows is not None and self._follows.value:
            self._follow(moment.contact.point - self._place)

    def _follow(self, away: Floats) -> None:
        """Move every browser's camera along, in steps, without changing its view."""
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

    def _move_arm(self, model: ArmModel, q: Floats, T_base_carrier: Floats | None) -> None:
        frames, moved = link_frames(model.chain, q), 1  # the base stands still
        if T_base_carrier is not None:  # the object does, and what is drawn on it: the arm goes round it
            frames, moved = np.linalg.inv(T_base_carrier) @ frames, 0
        for handle, T in zip(self._links[moved:], frames[moved:], strict=True):
            _place(handle, T)
        if self._probe is not None:
            _place(self._probe, frames[-1] @ self._tool)

    def _show_contact(self, moment: Moment) -> None:
        contact = moment.contact
        self._contact.visible = self._force.visible = self._label.visible = contact is not None
        if contact is None:
            return
        _place(self._contact, contact.T_base_contact)
        # in the contact frame, whose z points inward: a browser that draws slowly moves arrow and frame at one time
        tip = (0.0, 0.0, -(FORCE_M_PER_N * moment.force + FORCE_HEAD_M))
        self._force.points = np.array([[(0.0, 0.0, 0.0), tip]], np.float32)
        self._label.position = tip
        self._label.text = f"{moment.force:.2f} N"


def _taxel_scales(counts: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Scales of the drawn taxels: those without pressure are dots.

    Opacity is not used: a browser builds all taxels anew when one opacity changes, and draws none of them meanwhile.
    """
    return np.where(counts > 0, 1.0, 0.12).astype(np.float32)


def _place(handle: Any, T: Floats) -> None:
    x, y, z, w = quaternion_of(T[:3, :3])
    handle.wxyz = (w, x, y, z)
    handle.position = T[:3, 3]
