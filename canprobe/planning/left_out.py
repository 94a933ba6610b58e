"""What a scene does not need, and why: one table."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

from canprobe.planning.bridges import bridge_outputs
from canprobe.planning.contact_window import patch_across_taxels
from canprobe.planning.cut_patch import measured_share
from canprobe.scene_setup import Setup, Touch

_Reason = Callable[[Setup], str | None]


def _no_arm(setup: Setup) -> str | None:
    return None if setup.arm else f'no [arm]: task.kind = "{setup.kind}" moves nothing'


def _no_sensor(setup: Setup) -> str | None:
    return None if setup.array else f'no [sensor]: task.kind = "{setup.kind}" feels nothing'


def _no_image(setup: Setup) -> str | None:
    if setup.array is None or setup.array.mode == "image":
        return None
    return _by_window(setup, setup.array.window) if setup.array.mode == "window" else _by_sensor(setup)


def _by_window(setup: Setup, side: int | str) -> str:
    touch = setup.touch
    name = f"the {side}×{side} window round the contact"
    if touch is None or isinstance(side, str):
        return f"{name} is sent"
    if side >= patch_across_taxels(touch.force, touch.probe):
        return f"{name} holds the patch"
    outside = 1.0 - measured_share(touch.force, touch.probe, side)
    return f"{name} is sent, with up to {100 * outside:.0f} % of the force outside"


def _no_window(setup: Setup) -> str | None:
    if setup.array is None or setup.array.mode == "window":
        return None
    return "the full image is sent" if setup.array.mode == "image" else _by_sensor(setup)


def _by_sensor(setup: Setup) -> str | None:
    if setup.array is None or setup.array.mode != "features":
        return None
    return 'sensor.mode = "features": the sensor computes force, centroid and moments itself'


def _no_shape(setup: Setup) -> str | None:
    if setup.shape is not None:
        return None
    why = {
        "press": "one touch without motion shows no shape",
        "calibrate": "the ball is known",
        "listen": "nothing moves",
        "free": "nothing is touched",
    }
    return why.get(setup.kind, "no [shape]")


def _no_patch(setup: Setup) -> str | None:
    if setup.shape is None:
        return None
    return "shape.patch = false" if not setup.shape.patch else _by_sensor(setup)


def _no_strategy(setup: Setup) -> str | None:
    why = {
        "press": "the probe holds still",
        "calibrate": "no surface is followed",
        "listen": "nothing moves",
        "free": "the joints swing, no surface is followed",
    }
    return why.get(setup.kind)


def _no_servo(setup: Setup) -> str | None:
    return None if isinstance(setup.task, Touch) else f'task.kind = "{setup.kind}" controls no force'


def _no_emulator(setup: Setup) -> str | None:
    return None if setup.emulated_node_ids else "every node is real"


def _no_truth(setup: Setup) -> str | None:
    if setup.emulated_node_ids and (setup.truth.object is not None or setup.kind == "free"):
        return None
    return "no emulated node" if not setup.emulated_node_ids else "no [object]: nothing to compare with"


def _no_dynamics(setup: Setup) -> str | None:
    emulated_arm = setup.arm is not None and setup.arm.drives[0].emulated and setup.truth.fidelity == "ideal"
    return 'plant.fidelity = "ideal": each drive tracks as a second-order system' if emulated_arm else None


def _no_figure(setup: Setup) -> str | None:
    if not setup.figures:
        return "scene.figures = false"
    if importlib.util.find_spec("matplotlib") is not None:
        return None
    return "the study extra is not installed: pip install 'canprobe[study]'"


def _no_page(setup: Setup) -> str | None:
    if not setup.figures:
        return "scene.figures = false"
    if setup.kind == "listen":
        return 'task.kind = "listen": nothing moves'
    if importlib.util.find_spec("viser") is not None:
        return None
    return "the view extra is not installed: pip install 'canprobe[view]'"


def _no_bridge(setup: Setup) -> str | None:
    return None if setup.bridge is not None and setup.bridge.use else "no [bridge]: no other tool is fed"


def _switch(name: str) -> _Reason:
    def reason(setup: Setup) -> str | None:
        off = setup.array is not None and name in setup.truth.without
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


def left_out(setup: Setup) -> tuple[tuple[str, str], ...]:
    """Everything that this scene leaves out, as (what, why)."""
    reasons = ((what, reason(setup)) for what, reason in _TABLE)
    return tuple((what, why) for what, why in reasons if why is not None)


def outputs(setup: Setup) -> tuple[str, ...]:
    """The files that a run of this scene writes."""
    files = ["summary.json", "log.npz", "bus.log", "scene.toml"]
    if _no_truth(setup) is None:
        files.append("truth.npz")
    if setup.kind == "calibrate":
        files.append("tool.toml")
    mapped = _no_shape(setup) is None
    if mapped:
        files.append("surface.npz")
    if _no_figure(setup) is None:
        files += ["report.png", "surface.png"] if mapped else ["report.png"]
    if _no_page(setup) is None:
        files.append("report.html")
    return (*files, *bridge_outputs(setup))
