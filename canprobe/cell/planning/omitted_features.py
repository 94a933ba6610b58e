"""Parts that a scene does not need, and the files that its run writes."""

from __future__ import annotations

import importlib.util
from collections.abc import Container, Iterator

from canprobe.cell.planning.array import measured_share, patch_across_taxels, support_of
from canprobe.cell.planning.bridges import bridge_outputs
from canprobe.cell.planning.free_parameters import MODES
from canprobe.cell.scene.setup import Setup, Touch, Touching
from canprobe.errors import install_line

_NO_SHAPE = {
    "press": "one touch without motion shows no shape",
    "calibrate": "the ball is known",
    "listen": "nothing moves",
    "free": "nothing is touched",
}
_NO_STRATEGY = {
    "press": "the probe holds still",
    "calibrate": "no surface is followed",
    "listen": "nothing moves",
    "free": "the joints swing, no surface is followed",
}
_EFFECTS = {
    "noise": "taxel noise",
    "gain_error": "taxel gain error",
    "blur": "cover blur",
    "hysteresis": "taxel hysteresis",
    "creep": "taxel creep",
    "crosstalk": "taxel crosstalk",
    "saturation": "taxel saturation",
    "threshold": "the array's own threshold",
}
_BY_ARRAY = f'sensor.mode = "features": {MODES["features"]}'
IMAGE, OWN_WINDOW = "full image (32 PDOs)", "window (8 PDOs)"
ARRAY_NODE_PARTS = "node of the array, its PDOs and its supervision by heartbeat"
ESTIMATOR, FIGURE = "surface estimator", "figure"
BUS_PARTS = "bus, bring-up by SDO and their log (bus.log)"
TRUTH_PARTS = "truth and scores against it"


def omitted_features(setup: Setup) -> tuple[tuple[str, str], ...]:
    """Everything that a closed setup leaves out, as (what, why)."""
    return *_not_sent(setup), *_not_computed(setup), *_not_emulated(setup), *_not_shown(setup)


def _not_sent(setup: Setup) -> Iterator[tuple[str, str]]:
    array, kind = setup.array, setup.kind
    if setup.bus.direct:
        yield BUS_PARTS, 'bus.interface = "direct": counts and images pass in the place of frames'
    if setup.arm is None:
        yield "drives, their PDOs, joint limits", f'no [arm]: task.kind = "{kind}" moves nothing'
    elif not setup.arm.torque:
        yield "motor torque (6077h)", "arm.torque is false, or the bus has no room for it beside what the task needs"
    if array is None:
        yield "tactile node and its PDOs", f'no [sensor]: task.kind = "{kind}" touches nothing'
    elif array.raw is not None:
        yield ARRAY_NODE_PARTS, 'wire.kind = "frames": the device knows no CANopen'
    elif array.mode == "window":
        yield IMAGE, _by_window(setup.touch, int(array.window))
    elif array.mode == "image":
        yield OWN_WINDOW, "the full image is sent"
    else:
        yield from ((what, _BY_ARRAY) for what in (IMAGE, OWN_WINDOW, "taxels and patch features in the master"))


def _not_computed(setup: Setup) -> Iterator[tuple[str, str]]:
    array, shape, kind = setup.array, setup.shape, setup.kind
    if shape is None:
        yield ESTIMATOR, _NO_SHAPE.get(kind, "no [shape]")
    elif not shape.patch or (array is not None and array.mode == "features"):
        support = support_of(setup)
        lacking = support is not None and not support.curvature
        off = f"the array: {support}" if lacking else "shape.patch = false"
        yield "curvature from the patch", _BY_ARRAY if shape.patch else off
    if kind in _NO_STRATEGY:
        yield "exploration strategy", _NO_STRATEGY[kind]
    if not isinstance(setup.task, Touch):
        yield "tactile servo", f'task.kind = "{kind}" controls no force'


def _not_emulated(setup: Setup) -> Iterator[tuple[str, str]]:
    array, kind = setup.array, setup.kind
    if not setup.emulates:
        yield "emulator", "every node is real"
        yield TRUTH_PARTS, "no emulated node"
    elif setup.truth.object is None and kind != "free":
        yield TRUTH_PARTS, "no [object]: nothing to compare with"
    if setup.truth.fidelity == "ideal" and any(drive.emulated for drive in setup.drives):
        yield "arm dynamics", 'plant.fidelity = "ideal": each drive tracks as a second-order system'
    for effect, what in _EFFECTS.items():
        if array is not None and effect in setup.truth.without:
            yield what, f"plant.{effect} = false"


def _not_shown(setup: Setup) -> Iterator[tuple[str, str]]:
    if not setup.figures:
        yield FIGURE, "scene.figures = false"
    elif importlib.util.find_spec("matplotlib") is None:
        yield FIGURE, f"the study extra is not installed: {install_line('study')}"
    if not setup.bridge.use:
        yield "bridges to other tools", "no [bridge]: no other tool is fed"


def _by_window(touch: Touching | None, side: int) -> str:
    name = f"the {side}×{side} window round the contact"
    if touch is None:
        return f"{name} is sent"
    pitch = touch.array.pad.pitch_m
    if side >= patch_across_taxels(touch.force, touch.probe, pitch):
        return f"{name} holds the patch"
    outside = 1.0 - measured_share(touch.force, touch.probe, side, pitch)
    return f"{name} is sent, with up to {100 * outside:.0f} % of the force outside"


def outputs(setup: Setup, absent: Container[str]) -> tuple[str, ...]:
    """The files that a run of this scene writes.

    Args:
        setup: closed setup of the scene.
        absent: names of the parts that the plan leaves out.
    """
    written = {
        "summary.json": True,
        "log.npz": True,
        "tactile.npz": setup.array is not None,
        "bus.log": BUS_PARTS not in absent,
        "scene.toml": True,
        "truth.npz": TRUTH_PARTS not in absent,
        "tool.toml": setup.kind == "calibrate",
        "surface.npz": ESTIMATOR not in absent,
        "report.png": FIGURE not in absent,
        "surface.png": FIGURE not in absent and ESTIMATOR not in absent,
    }
    return (*(file for file, is_written in written.items() if is_written), *bridge_outputs(setup))
