"""Show what the array measures: force, place and the taxels. No drive is touched, no arm is commanded.

On a terminal the image is renewed ten times a second. Elsewhere each line is one image, with --json a JSON document.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from canprobe.cli.argument_types import seconds
from canprobe.cli.hands import opened
from canprobe.cli.parser import Parser
from canprobe.errors import UsageError
from canprobe.fieldbus.bus.clock import Pace

if TYPE_CHECKING:
    from canprobe.cell.master.controller import Command, Measurement
    from canprobe.cell.results.open_cell import OpenCell
    from canprobe.cell.scene.model import Scene

HELP = "show what the array measures"
EXAMPLE = """\
examples:
  canprobe listen puma260
  canprobe listen cell.toml --bus socketcan --channel can0
  canprobe listen cell.toml --bus socketcan --channel can0 --json --every 0.01
  canprobe listen puma260 --record images.csv
"""
_CLEAR = "\x1b[H\x1b[J"


def add_arguments(parser: Parser) -> None:
    parser.add_shared("SCENE", "BUS", "--realtime", "--patient")
    parser.add_option("--duration S", "end after S seconds [10]", seconds, default=10.0)
    parser.add_option("--every S", "time between two images [0.1]", seconds, default=0.1)
    parser.add_option(
        "--record FILE.csv",
        "write each image with its time into this file, one a line; with the pose of the probe where the arm has an"
        " address (arm.address)",
        Path,
    )
    parser.add_option("--json", "print one JSON document a line")
    parser.add_shared("-v")


def array_only(scene: Scene) -> Scene:
    """The scene with its array alone, and with an arm whose poses come over a socket.

    Raises:
        UsageError: it has none.
    """
    if scene.sensor is None:
        raise UsageError(f"{scene.name}: has no array ([sensor])")
    alone = replace(scene, keep_out=None, carrier=None, object=None, shape=None, servo=None)
    if scene.arm is not None and scene.arm.address is not None and not scene.arm.emulated:
        return replace(alone, task=replace(scene.task, kind="free"))
    return replace(alone, arm=None, joints={}, postures={}, task=replace(scene.task, kind="listen"))


def run(args: argparse.Namespace) -> None:
    """Print images until the time is over, or Ctrl-C."""
    from canprobe.cell.master.controller import Command
    from canprobe.cell.master.monitor import image_lines
    from canprobe.cell.results.recording import recording

    duration_s, args.duration = args.duration, None
    on_terminal = sys.stdout.isatty() and not args.json
    next_s, pace = 0.0, Pace()
    file = contextlib.nullcontext() if args.record is None else recording(args.record)
    with file as record, opened(args, prepared=array_only) as cell:
        history = None
        if cell.plan.setup.arm is not None:
            from canprobe.cell.tasks.sensing import JointHistory

            history = JointHistory()

        def step(measurement: Measurement) -> Command:
            nonlocal next_s
            t_s = 1e-9 * measurement.t_ns
            if history is not None and measurement.q is not None:
                history.add(measurement.t_ns, measurement.q)
            if record is not None and (sample := measurement.tactile) is not None:
                q = None if history is None else history.at(sample.t_sample_ns)
                if history is None or q is not None:
                    record(1e-9 * sample.t_sample_ns, sample.frame.taxels, None if q is None else cell.probe(q)[0])
            if measurement.tactile is not None and t_s >= next_s:
                next_s = t_s + args.every
                if args.json:
                    print(json.dumps({"t_s": round(t_s, 6), **array_values(cell, measurement)}), flush=True)
                else:
                    text = f"{t_s:7.2f} s  {array_line(cell, measurement)}"
                    image = "\n".join(image_lines(measurement.tactile.frame.taxels))
                    print(f"{_CLEAR}{text}\n{image}" if on_terminal else text, flush=True)
                if cell.session.virtual and on_terminal:
                    pace.keep(measurement.t_ns)
            return Command(done=t_s >= duration_s)

        if history is None:
            cell.run(step)
        else:
            while not step(cell.cell.idle(0.0)).done:  # it is never enabled
                pass


def array_values(cell: OpenCell, measurement: Measurement) -> dict[str, Any]:
    """The figures of an image: force and its standard deviation, place, highest taxel."""
    sample = measurement.tactile
    if sample is None:
        return {"force_n": None}
    patch = cell.patch(sample)
    return {
        "force_n": round(patch.force, 4),
        "force_sigma_n": round(patch.sigma.total, 4) if patch.sigma.total < float("inf") else None,
        "u_mm": None if math.isnan(patch.u) else round(1e3 * patch.u, 3),
        "v_mm": None if math.isnan(patch.v) else round(1e3 * patch.v, 3),
        "highest_count": int(sample.frame.taxels.max(initial=0)),
        "age_cycles": measurement.tactile_age,
    }


def array_line(cell: OpenCell, measurement: Measurement) -> str:
    """The figures of an image in a line."""
    if measurement.tactile is None:
        return "no image"
    at = array_values(cell, measurement)
    sigma = "unknown error" if at["force_sigma_n"] is None else f"± {at['force_sigma_n']:.3f} N"
    place = "no contact" if at["u_mm"] is None else f"at u {at['u_mm']:+.1f}, v {at['v_mm']:+.1f} mm"
    return f"{at['force_n']:.3f} N {sigma}, {place}, highest taxel {at['highest_count']} of 255"
