"""Study `arrays`: how well forty touches calibrate an unknown emulated array.

Each cell is an array drawn at random: stiffness of its layer, full scale, blur, crosstalk, hysteresis, creep, gains. It
is touched as `canprobe calibrate array` touches it, directly and without a bus: a plane at 4 places with 3 forces, a
ball at 9 places with 2 forces, three reference loads, short rolls to and fro, a rod to verify. Then quadrics with
curvatures, forces, places and dwell times by chance are pressed on it, and its calibration says what they are;
`array_forces` holds some of them for up to a minute.

The images come from `canprobe.cell.plant.taxels`, whose pressure is that of the exact sphere, sampled nine times a
taxel, with hysteresis, creep and noise; the calibration knows none of its formulas.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from canprobe.cell.emulated.image_processing import follow
from canprobe.cell.plant.elastic_contact import depth_for_force
from canprobe.cell.plant.taxels import TaxelArray, TaxelConfig
from canprobe.cell.results.picture import BLUE, INK, picture
from canprobe.lab.studies.array_forces import GROUPS, HOLD_S, HOLDS, result_of, score_holds
from canprobe.lab.studies.result import Column, Row, StudyResult, measuring_facts
from canprobe.lab.studies.sweep import Sweep
from canprobe.mechanics.touch.linear_algebra import rms
from canprobe.mechanics.touch.pad import Pad
from canprobe.mechanics.touch.patch.array_models import make_image_model, make_patch_calibration
from canprobe.mechanics.touch.patch.calibrate import ArrayFit, calibrate_array
from canprobe.mechanics.touch.patch.image import PatchCalibration
from canprobe.mechanics.touch.patch.image_fit import Dwell, what_is_shown
from canprobe.mechanics.touch.patch.parameter_fit import curvature_errors, moment_errors
from canprobe.mechanics.types import Floats

RADIUS_M = 0.040
BALL_PER_M = 40.0
FIRST_ARRAY, ARRAYS, QUICK_ARRAYS = 100, 20, 2
"""Seed of the first array of draw 0, and number of arrays of a draw."""
DEVELOPMENT_DRAW, TEST_DRAW = 0, 1
"""Draws: settings of calibration and force come from the first, and the second was only looked at."""
OTHER_ARRAY = 10_000
"""Distance of the seed of the array whose calibration is taken for that of a make."""
PRESSES = 20
WINDOW = 8
FRAME_S, LOADING_S, DWELL_S, APART_S = 0.02, 0.5, 3.0, 2.5
REFERENCE_S = 9.0
"""Time of a reference load, s: creep has ended by then."""
REFERENCE_SIGMA = 0.005
FORCE_RELATIVE_SIGMA, FORCE_CORRELATION_S = 0.03, 0.1
"""The force wanders under a servo: relative standard deviation, and correlation time."""
ENCODER_M = 3e-6
EIGHT_M, STROKE_M, STROKE_HZ = (1.5e-3, 0.6e-3), (0.5e-3, 0.0), (0.5, 1.5)
GOALS = {"force_percent": 2.0, "stiffness_percent": 3.0, "curvature_percent": 5.0}
MODEL = ("mechanics/touch", "cell/plant", "lab/studies/arrays.py", "lab/studies/array_forces.py")
COLUMNS = (
    Column("array", "array"),
    Column("full_scale_kpa", "kPa", ".0f"),
    Column("stiffness_n_m3", "K/h N/m³", ".3g"),
    Column("blur", "blur pitches", ".2f"),
    Column("crosstalk", "crosstalk", ".3f"),
    Column("left_out", "left out"),
    Column("force_percent", "force %", ".1f"),
    Column("stiffness_percent", "stiffness %", ".1f"),
    Column("by_depth_percent", "by depth %", ".1f"),
    Column("moments_percent", "moments %", ".1f"),
    Column("curvature_percent", "curvature %", ".1f"),
)


def run(*, quick: bool, sweep: Sweep, draw: int = TEST_DRAW) -> StudyResult:
    """Calibrate the arrays of a draw and press on them."""
    first = FIRST_ARRAY + ARRAYS * draw
    seeds = range(first, first + (QUICK_ARRAYS if quick else ARRAYS))
    sweep.say(f"{len(seeds)} arrays, draw {draw}: seeds {seeds[0]} to {seeds[-1]}")
    rows: list[Row] = list(sweep.map(measure, list(seeds), model=MODEL))
    forces = [row for each in sweep.map(measure_forces, list(seeds), model=MODEL) for row in each]
    facts = measuring_facts(quick, len(seeds), MODEL)
    more = (result_of(forces, facts),)
    return StudyResult("arrays", COLUMNS, rows, findings(rows), facts, partial(draw_arrays, rows), more)


def random_array(seed: int) -> tuple[TaxelConfig, float, np.random.Generator]:
    """A random array, the stiffness of its layer (N/m³), and the generator of its gains and noise."""
    rng = np.random.default_rng(seed)
    stiffness = 1.27e8 * math.exp(rng.uniform(-0.5, 0.5))
    config = TaxelConfig(
        full_scale_pa=math.exp(rng.uniform(math.log(90e3), math.log(300e3))),
        blur_pitch=rng.uniform(0.45, 0.85),
        crosstalk=rng.uniform(0.0, 0.05),
        hysteresis=rng.uniform(0.05, 0.15),
        creep_per_decade=rng.uniform(0.02, 0.08),
    )
    return config, stiffness, rng


class Presses:
    """Presses known shapes on one array, one after the other: it remembers, until it is left to `rest`.

    Args:
        config, stiffness: the array, and the stiffness of its layer, N/m³.
        rng: generator of gains and noise.

    Attributes:
        forces: (n,) true force at each image of the last touch, N.
    """

    def __init__(self, config: TaxelConfig, stiffness: float, rng: np.random.Generator) -> None:
        self._config, self._stiffness, self._rng = config, stiffness, rng
        self.forces: Floats = np.empty(0)
        self._array, self._t = TaxelArray(config, rng, radius_m=RADIUS_M, stiffness_n_m3=stiffness), 0.0

    def dwell(  # noqa: PLR0917
        self,
        name: str,
        force: float,
        kappa: tuple[float, float],
        number: int = 0,
        at: tuple[float, float] = (0.0, 0.0),
        angle: float = 0.0,
        *,
        seconds: float = DWELL_S,
        heading: float = 0.0,
        roll: tuple[float, float] = EIGHT_M,
        hz: Sequence[float] = (0.35,),
        measured: bool = False,
    ) -> Dwell:
        """One touch, pressed for half a second and rolled over the pad.

        Args:
            name: name of the object.
            force: normal force, N.
            kappa: principal curvatures, larger first, 1/m.
            number: number of the place.
            at: place on the pad, m.
            angle: angle of the first principal direction on the pad, rad.
            seconds: duration of the roll.
            heading: heading of the roll on the pad, rad.
            roll: half-widths along and across the heading, m.
            hz: rates of the roll, one after the other.
            measured: whether the true force is given, with the error of a scale.
        """
        array, began = self._array, self._t
        rng, depth = self._rng, depth_for_force(force, kappa, RADIUS_M, self._stiffness)
        c, s = math.cos(angle), math.sin(angle)
        axes, origin = np.array([[c, s], [-s, c]]), (4, 4)
        c, s = math.cos(heading), math.sin(heading)
        unrest = phase = 0.0
        kept = math.exp(-FRAME_S / FORCE_CORRELATION_S)
        rows = []
        for t in np.arange(0.0, LOADING_S + seconds, FRAME_S).tolist():
            unrest = kept * unrest + FORCE_RELATIVE_SIGMA * math.sqrt(1.0 - kept**2) * float(rng.standard_normal())
            share = max(0.0, t - LOADING_S) / seconds
            phase += 2.0 * math.pi * FRAME_S * hz[min(int(share * len(hz)), len(hz) - 1)] * (share > 0.0)
            x, y = roll[0] * math.sin(phase), roll[1] * math.sin(2.0 * phase)
            uv = (at[0] + c * x - s * y, at[1] + s * x + c * y)
            now = force * min(1.0, t / LOADING_S) * max(1.0 + unrest, 0.0)
            sunk = depth * math.sqrt(now / force)
            image = array.image(uv, sunk, kappa, axes, began + t)
            origin = follow(image, origin)
            seen = np.zeros_like(image)
            part = np.s_[origin[0] : origin[0] + WINDOW, origin[1] : origin[1] + WINDOW]
            seen[part] = image[part]
            rows.append((t, seen, (*origin, WINDOW, WINDOW), uv, sunk + rng.normal(0.0, ENCODER_M), now))
        t_s, images, windows, places, push, forces = zip(*rows, strict=True)
        self._t = began + t_s[-1]
        for _ in range(round(APART_S / FRAME_S)):
            self._t += FRAME_S
            array.image((0.0, 0.0), 0.0, kappa, axes, self._t)
        mean, self.forces = float(np.mean(forces[len(forces) // 3 :])), np.array(forces)
        return Dwell(
            name=name,
            kappa=kappa,
            angle=angle,
            place=number,
            t_s=np.array(t_s),
            images=images,
            windows=windows,
            expected=np.array(places),
            push=np.array(push),
            force=mean * (1.0 + float(rng.normal(0.0, REFERENCE_SIGMA))) if measured else None,
            to_and_fro=len(hz) > 1,
        )

    def rest(self) -> None:
        """Wait until the array has recovered from the presses before."""
        array = TaxelArray(self._config, self._rng, radius_m=RADIUS_M, stiffness_n_m3=self._stiffness)
        array.take_gains(self._array)
        self._array, self._t = array, 0.0

    def protocol(self) -> Iterator[Dwell]:
        """The touches of `canprobe calibrate array`, with a rest where it changes the object."""
        flat, ball = (0.0, 0.0), (BALL_PER_M, BALL_PER_M)
        corners = [(x, y) for x in (-2e-3, 2e-3) for y in (-2e-3, 2e-3)]
        for force in (0.7, 1.5, 3.0):
            if force == 3.0:
                for number, heading in enumerate((0.0, 0.5 * math.pi), start=20):
                    yield self.dwell(
                        "plane", 2.0, flat, number, seconds=8.0, heading=heading, roll=STROKE_M, hz=STROKE_HZ
                    )
            for number, at in enumerate(corners):
                yield self.dwell("plane", force, flat, number, at, heading=0.8 * number)
        self.rest()
        for force in (1.0, 2.0, 3.0):
            yield self.dwell("plane", force, flat, 10, seconds=REFERENCE_S, measured=True)
        self.rest()
        grid = [(x, y) for x in (-2e-3, 0.0, 2e-3) for y in (-2e-3, 0.0, 2e-3)]
        for force in (0.8, 2.0):
            for number, at in enumerate(grid):
                yield self.dwell("ball", force, ball, number, at, heading=0.7 * number)
        for number, angle in enumerate((0.0, 0.25 * math.pi)):
            self.rest()
            heading = angle + 0.5 * math.pi
            yield self.dwell("rod", 2.0, (BALL_PER_M, 0.0), number, angle=angle, heading=heading, roll=(1.5e-3, 0.0))

    def by_chance(self) -> Dwell:
        """A random quadric, force, place and time; the true force is given exactly."""
        self.rest()
        rng = self._rng
        k1, k2 = sorted(rng.uniform(-12.0, 60.0, 2).tolist(), reverse=True)
        x, y = rng.uniform(-2e-3, 2e-3, 2).tolist()
        angle, heading = rng.uniform(0.0, math.pi), rng.uniform(0.0, 2.0 * math.pi)
        hz, seconds = (float(rng.choice((0.35, 1.0))),), float(rng.uniform(3.0, 8.0))
        force = float(rng.uniform(0.7, 3.0))
        dwell = self.dwell("quadric", force, (k1, k2), 0, (x, y), angle, seconds=seconds, heading=heading, hz=hz)
        return replace(dwell, force=force)

    def held(self) -> tuple[Dwell, Floats]:
        """A random quadric, held for some time, and its true forces (n,), N."""
        self.rest()
        rng = self._rng
        k1, k2 = sorted(rng.uniform(-12.0, 60.0, 2).tolist(), reverse=True)
        x, y = rng.uniform(-1.5e-3, 1.5e-3, 2).tolist()
        half = float(rng.uniform(0.0, 1.5e-3))
        dwell = self.dwell(
            "quadric",
            float(rng.uniform(0.5, 3.0)),
            (k1, k2),
            0,
            (x, y),
            float(rng.uniform(0.0, math.pi)),
            seconds=float(rng.choice(HOLD_S)),
            heading=float(rng.uniform(0.0, 2.0 * math.pi)),
            roll=(half, 0.4 * half),
            hz=(float(rng.uniform(0.05, 0.5)),),
        )
        return dwell, self.forces


def _calibrated(seed: int, *, own_gains: bool) -> tuple[ArrayFit, TaxelConfig, float, Presses, Pad]:
    """The fit of a random array, the array, the stiffness of its layer (N/m³), its presses and its pad."""
    config, stiffness, rng = random_array(seed)
    presses, pad = Presses(config, stiffness, rng), Pad(full_scale_pa=config.full_scale_pa, mount_radius_m=RADIUS_M)
    fit = calibrate_array(
        list(presses.protocol()),
        pad=pad,
        reference="scale",
        reference_sigma=REFERENCE_SIGMA,
        array=f"emulated, seed {seed}",
        date="",
        made_on="study arrays",
        own_gains=own_gains,
    )
    return fit, config, stiffness, presses, pad


def measure_forces(seed: int) -> list[Row]:
    """Hold quadrics on one array, and read their forces with its own calibration and with another one: two rows."""
    own, config, _, presses, pad = _calibrated(seed, own_gains=True)
    other = _calibrated(seed + OTHER_ARRAY, own_gains=False)[0]
    holds = [presses.held() for _ in range(HOLDS)]
    return [
        {
            "array": seed,
            "calibration": group,
            "creep_percent": 100.0 * config.creep_per_decade,
            "creep_found_percent": 100.0 * fit.calibration.force.creep,
            **score_holds(fit.calibration, pad, holds),
        }
        for group, fit in zip(GROUPS, (own, other), strict=True)
    ]


def measure(seed: int) -> dict[str, Any]:
    """Calibrate one array and press on it: a row of the table."""
    fit, config, stiffness, presses, pad = _calibrated(seed, own_gains=True)
    found = fit.calibration
    patch = make_patch_calibration(found, pad)
    model = make_image_model(found, patch, seen=WINDOW)
    plain = PatchCalibration(pad, gains=found.gains)
    forces, curvatures, moments = [], [], []
    for _ in range(PRESSES):
        dwell = presses.by_chance()
        shown = what_is_shown(dwell, plain)
        force = patch.force_gain * shown.total + patch.edge_gain * math.sqrt(shown.total)
        assert dwell.force is not None
        if not shown.usable or model.trust((dwell.kappa[0], 0.0, dwell.kappa[1]), force) < 1.0:
            continue
        forces.append(force / dwell.force - 1.0)
        curvatures.append(curvature_errors(model, [dwell], [shown], [force])[0])
        moments.append(moment_errors(model, [dwell], [shown], [force])[0, :2])
    return {
        "array": seed,
        "full_scale_kpa": 1e-3 * config.full_scale_pa,
        "stiffness_n_m3": stiffness,
        "blur": config.blur_pitch,
        "crosstalk": config.crosstalk,
        "left_out": fit.left_out,
        "force_percent": 100.0 * rms(np.array(forces)),
        "stiffness_percent": 100.0 * (found.stiffness.moments / stiffness - 1.0),
        "by_depth_percent": 100.0 * (found.stiffness.depth / stiffness - 1.0),
        "moments_percent": 100.0 * rms(np.array(moments)),
        "curvature_percent": 100.0 * rms(np.array(curvatures)),
    }


def findings(rows: Sequence[Row]) -> list[str]:
    """RMS over the arrays, beside the goals."""
    rms = {key: math.sqrt(float(np.mean([row[key] ** 2 for row in rows]))) for key in GOALS}
    worst = {key: max(abs(row[key]) for row in rows) for key in GOALS}
    return [
        f"{key.removesuffix('_percent')}: RMS {rms[key]:.1f} % over {len(rows)} arrays, worst {worst[key]:.1f} %, goal"
        f" {goal:g} %."
        for key, goal in GOALS.items()
    ]


def draw_arrays(rows: Sequence[Row], path: Path) -> None:
    """The three errors of each array beside their goals."""
    title = (
        "What a calibration by forty touches leaves: error of each of some emulated arrays, drawn at random; line: goal"
    )
    with picture(path, title, 3.6) as figure:
        for axes, (key, goal) in zip(figure.subplots(1, 3), GOALS.items(), strict=True):
            axes.bar([str(row["array"]) for row in rows], [abs(row[key]) for row in rows], color=BLUE)
            axes.axhline(goal, color=INK, linewidth=0.8)
            axes.set(title=key.removesuffix("_percent"), ylabel="%", xlabel="array")
            axes.tick_params(axis="x", rotation=90)
            axes.grid(visible=False, axis="x")
