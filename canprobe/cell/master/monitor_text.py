"""A monitored cell as lines for a terminal, in plain ANSI."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from canprobe.cell.master.monitor import LATE_HEARTBEAT_S, CellView, NodeView

HOME, CLEAR_LINE, CLEAR_BELOW = "\x1b[H", "\x1b[K", "\x1b[J"
SHADES = " ·░▒▓█"


def screen(view: CellView) -> str:
    """The view in the place of the one before, on a terminal."""
    return HOME + "".join(f"{line}{CLEAR_LINE}\r\n" for line in lines(view)) + CLEAR_BELOW


def lines(view: CellView) -> Iterator[str]:
    """The view, line by line."""
    jitter = (
        "–"
        if view.sync_jitter_us is None
        else f"p99 {view.sync_jitter_us[0]:.0f} µs, max {view.sync_jitter_us[1]:.0f} µs"
    )
    names = len(view.load) > 1
    load = ", ".join(f"{name + ' ' if names else ''}{100 * share:4.1f} %" for name, share in view.load.items())
    yield f"{view.channel}  {view.t_s:8.1f} s   load {load}   {view.frames_per_s:6.0f} frames/s"
    yield f"SYNC {view.sync_hz:6.1f} Hz   jitter {jitter}"
    yield ""
    for node in view.nodes:
        yield _node_line(node)
    if view.events:
        yield ""
        yield from view.events
    if view.q is not None:
        yield ""
        yield "joints  " + "  ".join(f"{q:8.2f} {unit}" for q, unit in zip(view.q, view.units, strict=True))
    if view.taxels is not None:
        force = "–" if view.force_n is None else f"{view.force_n:.2f} N"
        yield ""
        yield f"force   {force}   torn frames {view.torn_frames}"
        if view.array is not None:
            yield f"array   {view.array}"
        yield from image_lines(view.taxels)


def _node_line(node: NodeView) -> str:
    late = "" if node.heard_s is None or node.heard_s <= LATE_HEARTBEAT_S else f"  SILENT for {node.heard_s:.1f} s"
    drive = node.drive or ""
    emcy = f"  EMCY {node.emcy}" if node.emcy else ""
    return f"node {node.node_id:3d}  {node.role:<14} {node.state or 'not heard':<16} {drive:<20}{late}{emcy}".rstrip()


def image_lines(taxels: NDArray[np.uint8]) -> Iterator[str]:
    """A taxel image, two characters a taxel, the highest count in the darkest shade."""
    top = max(int(taxels.max()), 1)
    steps = np.ceil(taxels.astype(float) * (len(SHADES) - 1) / top).astype(int)
    for row in steps:
        yield "  " + "".join(SHADES[step] * 2 for step in row)
