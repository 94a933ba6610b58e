"""What a scene does not need, and why: one table."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

from canprobe.planning.bridges import bridge_outputs
from canprobe.planning.contact_window import patch_across_taxels
from canprobe.planning.cut_patch import measured_share
from canprobe.scene import TOUCH_KINDS, Scene

_Reason = Callable[[Scene], str | None]


def _no_arm(scene: Scene) -> str | None:
    return None if scene.arm else f'no [arm]: task.kind = "{scene.task.kind}" moves nothing'


def _no_sensor(scene: Scene) -> str | None:
    return None if scene.sensor else f'no [sensor]: task.kind = "{scene.task.kind}" feels nothing'


def _no_image(scene: Scene) -> str | None:
    if scene.sensor is None or scene.sensor.mode == "image":
        return None
    return _by_window(scene) if scene.sensor.mode == "window" else _by_sensor(scene)


def _by_window(scene: Scene) -> str:
    assert scene.sensor is not None
    side = scene.sensor.window
    name = f"the {side}×{side} window round the contact"
    if scene.probe is None or scene.task.kind not in TOUCH_KINDS or isinstance(side, str):
        return f"{name} is sent"
    if side >= patch_across_taxels(scene.task.force_n, scene.probe):
        return f"{name} holds the patch"
    outside = 1.0 - measured_share(scene.task.force_n, scene.probe, side)
    return f"{name} is sent, with up to {100 * outside:.0f} % of the force outside"


def _no_window(scene: Scene) -> str | None:
    if scene.sensor is None or scene.sensor.mode == "window":
        return None
    return "the full image is sent" if scene.sensor.mode == "image" else _by_sensor(scene)


def _by_sensor(scene: Scene) -> str | None:
    if scene.sensor is None or scene.sensor.mode != "features":
        return None
    return 'sensor.mode = "features": the sensor computes force, centroid and moments itself'


def _no_shape(scene: Scene) -> str | None:
    if scene.shape is not None:
        return None
    why = {
        "press": "one touch without motion shows no shape",
        "calibrate": "the ball is known",
        "listen": "nothing moves",
        "free": "nothing is touched",
    }
    return why.get(scene.task.kind, "no [shape]")


def _no_patch(scene: Scene) -> str | None:
    if scene.shape is None:
        return None
    return "shape.patch = false" if not scene.shape.patch else _by_sensor(scene)


def _no_strategy(scene: Scene) -> str | None:
    why = {
        "press": "the probe holds still",
        "calibrate": "no surface is followed",
        "listen": "nothing moves",
        "free": "the joints swing, no surface is followed",
    }
    return why.get(scene.task.kind)


def _no_servo(scene: Scene) -> str | None:
    return None if scene.servo is not None else f'task.kind = "{scene.task.kind}" controls no force'


def _no_emulator(scene: Scene) -> str | None:
    return None if scene.emulated_node_ids else "every node is real"


def _no_truth(scene: Scene) -> str | None:
    if scene.emulated_node_ids and (scene.object is not None or scene.task.kind == "free"):
        return None
    return "no emulated node" if not scene.emulated_node_ids else "no [object]: nothing to compare with"


def _no_dynamics(scene: Scene) -> str | None:
    ideal = scene.plant is not None and scene.plant.fidelity == "ideal"
    emulated_arm = scene.arm is not None and scene.arm.emulated and ideal
    return 'plant.fidelity = "ideal": each drive tracks as a second-order system' if emulated_arm else None


def _no_figure(scene: Scene) -> str | None:
    if not scene.scene.figures:
        return "scene.figures = false"
    if importlib.util.find_spec("matplotlib") is not None:
        return None
    return "the study extra is not installed: pip install 'canprobe[study]'"


def _no_page(scene: Scene) -> str | None:
    if not scene.scene.figures:
        return "scene.figures = false"
    if scene.task.kind == "listen":
        return 'task.kind = "listen": nothing moves'
    if importlib.util.find_spec("viser") is not None:
        return None
    return "the view extra is not installed: pip install 'canprobe[view]'"


def _no_bridge(scene: Scene) -> str | None:
    return None if scene.bridge is not None and scene.bridge.use else "no [bridge]: no other tool is fed"


def _switch(name: str) -> _Reason:
    def reason(scene: Scene) -> str | None:
        off = scene.plant is not None and scene.sensor is not None and not getattr(scene.plant, name)
        return f"plant.{name} = false" if off else None

    return reason


_TABLE: tuple[tuple[str, _Reason], ...] = (
    ("six drives, their PDOs, joint limits", _no_arm),
    ("tactile node and its PDOs", _no_sensor),
    ("full image (32 PDOs)", _no_image),
    ("window (8 PDOs)", _no_window),
    ("taxels and patch features in the master", _by_sensor),
    ("surface estimator", _no_shape),
    ("curvature from the patch", _no_patch),
    ("exploration strategy", _no_strategy),
    ("tactile servo", _no_servo),
    ("emulator", _no_emulator),
    ("truth and scores against it", _no_truth),
    ("arm dynamics", _no_dynamics),
    ("taxel noise", _switch("noise")),
    ("taxel gain error", _switch("gain_error")),
    ("cover blur", _switch("blur")),
    ("taxel hysteresis", _switch("hysteresis")),
    ("taxel creep", _switch("creep")),
    ("taxel crosstalk", _switch("crosstalk")),
    ("taxel saturation", _switch("saturation")),
    ("the array's own threshold", _switch("threshold")),
    ("figure", _no_figure),
    ("replay to share (report.html)", _no_page),
    ("bridges to other tools", _no_bridge),
)


def left_out(scene: Scene) -> tuple[tuple[str, str], ...]:
    """Everything that this scene leaves out, as (what, why)."""
    reasons = ((what, reason(scene)) for what, reason in _TABLE)
    return tuple((what, why) for what, why in reasons if why is not None)


def outputs(scene: Scene) -> tuple[str, ...]:
    """The files that a run of this scene writes."""
    files = ["summary.json", "log.npz", "bus.log", "scene.toml"]
    if _no_truth(scene) is None:
        files.append("truth.npz")
    if scene.task.kind == "calibrate":
        files.append("tool.toml")
    mapped = _no_shape(scene) is None
    if mapped:
        files.append("surface.npz")
    if _no_figure(scene) is None:
        files += ["report.png", "surface.png"] if mapped else ["report.png"]
    if _no_page(scene) is None:
        files.append("report.html")
    return (*files, *bridge_outputs(scene))
